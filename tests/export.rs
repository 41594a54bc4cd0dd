//! Exported files, read back by other means than they were written, against what they came from.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use noctule::export::{
    CLOUD_COLUMNS, DepthFormat, DepthOptions, EVENT_COLUMNS, ExportError, Exported, Layer,
    LidarOptions, NPY_RECORD_LEN, PCD_RECORD_LEN, Request, Stream, export,
};
use noctule_depth::{Canvas, INVALID_RGB, Ramp, Scale, load_depth_png16};
use noctule_evk4::RawFile;
use noctule_hesai::Returns;
use noctule_sensor::Event;

mod sources;

fn run(request: &Request) -> Result<Exported, ExportError> {
    export(request, &|_| {})
}

fn error(from: &Path, to: &Path) -> String {
    run(&Request::new(from, to)).unwrap_err().to_string()
}

/// `t_us,x,y,p` of every event.
fn event_rows(events: &[Event]) -> Vec<[u64; 4]> {
    let row = |e: &Event| [e.t.as_micros(), e.x.into(), e.y.into(), e.on.into()];
    events.iter().map(row).collect()
}

fn csv_rows(path: &Path) -> Vec<[u64; 4]> {
    let text = fs::read_to_string(path).unwrap();
    let mut lines = text.lines();
    assert_eq!(lines.next(), Some(EVENT_COLUMNS));
    let row = |line: &str| {
        let fields: Vec<u64> = line.split(',').map(|f| f.parse().unwrap()).collect();
        fields.try_into().unwrap()
    };
    lines.map(row).collect()
}

/// The header is read by a crate that writes none of ours.
fn npy_rows(path: &Path) -> Vec<[u64; 4]> {
    let bytes = fs::read(path).unwrap();
    let header = npyz::NpyHeader::from_reader(&bytes[..]).unwrap();
    let descr = "[('t', '<u8'), ('x', '<u2'), ('y', '<u2'), ('p', '|u1')]";
    // Its own rendering leaves a comma before the bracket.
    assert_eq!(header.dtype().descr().replace(", ]", "]"), descr);
    let start = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let records = bytes[start..].chunks_exact(NPY_RECORD_LEN);
    assert!(records.remainder().is_empty());
    let number = |b: &[u8]| b.iter().rev().fold(0, |n, &b| n << 8 | u64::from(b));
    let row = |r: &[u8]| [&r[..8], &r[8..10], &r[10..12], &r[12..]].map(number);
    let rows: Vec<_> = records.map(row).collect();
    assert_eq!(header.shape(), [rows.len() as u64]);
    rows
}

#[test]
fn events_come_back_from_csv_and_npy() {
    let dir = tempfile::tempdir().unwrap();
    let raw = dir.path().join("a.raw");
    sources::write_raw(&raw);
    let mut files = vec![(raw, event_rows(&sources::events()))];
    if let Some(folder) = sources::data("events", "events_come_back") {
        let path = folder.join("derived_padding.raw");
        let mut events = Vec::new();
        RawFile::open(&path, None)
            .unwrap()
            .decode_all(&mut events)
            .unwrap();
        files.push((path, event_rows(&events)));
    }
    for (raw, expected) in files {
        let (csv, npy) = (dir.path().join("a.csv"), dir.path().join("a.NPY"));
        let exported = run(&Request::new(&raw, &csv)).unwrap();
        assert_eq!(exported.written, expected.len() as u64);
        assert_eq!(csv_rows(&csv), expected);
        run(&Request::new(&raw, &npy)).unwrap();
        assert_eq!(npy_rows(&npy), expected);
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Point {
    xyz: [f32; 3],
    intensity: u64,
    ring: u64,
    block: u64,
    t_ns: u64,
}

fn cloud_rows(path: &Path) -> Vec<Point> {
    let text = fs::read_to_string(path).unwrap();
    let mut lines = text.lines();
    assert_eq!(lines.next(), Some(CLOUD_COLUMNS));
    let point = |line: &str| {
        let f: Vec<&str> = line.split(',').collect();
        assert_eq!(f.len(), 7, "{line}");
        let number = |k: usize| f[k].parse().unwrap();
        Point {
            xyz: [0, 1, 2].map(|k| f[k].parse().unwrap()),
            intensity: number(3),
            ring: number(4),
            block: number(5),
            t_ns: number(6),
        }
    };
    lines.map(point).collect()
}

fn pcd_body<'a>(bytes: &'a [u8], fields: &str) -> &'a [u8] {
    let marker = b"DATA binary\n";
    let start = bytes
        .windows(marker.len())
        .position(|w| w == marker)
        .unwrap()
        + marker.len();
    let header = std::str::from_utf8(&bytes[..start]).unwrap();
    assert!(header.contains(&format!("\nFIELDS {fields}\n")), "{header}");
    &bytes[start..]
}

fn pcd_points(path: &Path) -> Vec<Point> {
    let bytes = fs::read(path).unwrap();
    let body = pcd_body(&bytes, "x y z intensity ring block t_ns");
    let float = |r: &[u8]| f32::from_le_bytes(r.try_into().unwrap());
    let number = |b: &[u8]| b.iter().rev().fold(0, |n, &b| n << 8 | u64::from(b));
    let point = |r: &[u8]| Point {
        xyz: [0, 4, 8].map(|k| float(&r[k..k + 4])),
        intensity: format!("{}", float(&r[12..16])).parse().unwrap(),
        ring: number(&r[16..18]),
        block: number(&r[18..20]),
        t_ns: number(&r[20..]),
    };
    let points: Vec<_> = body.chunks_exact(PCD_RECORD_LEN).map(point).collect();
    let text = String::from_utf8_lossy(&bytes[..512]).into_owned();
    assert!(
        text.contains(&format!("\nPOINTS {}\n", points.len())),
        "{text}"
    );
    assert_eq!(body.len(), points.len() * PCD_RECORD_LEN);
    points
}

fn with(from: &Path, to: &Path, lidar: LidarOptions) -> Request {
    Request {
        lidar,
        ..Request::new(from, to)
    }
}

#[test]
fn a_made_up_cloud_lies_where_its_echoes_were_put() {
    let dir = tempfile::tempdir().unwrap();
    let [pcap, csv, pcd] = ["a.pcap", "a.csv", "a.pcd"].map(|name| dir.path().join(name));
    sources::write_pcap(&pcap);
    let (all, unique) = sources::returns(sources::PACKETS - 1);
    for (returns, expected) in [(Returns::All, all), (Returns::Unique, unique)] {
        let lidar = LidarOptions {
            returns,
            ..LidarOptions::default()
        };
        let exported = run(&with(&pcap, &csv, lidar.clone())).unwrap();
        assert_eq!((exported.written, exported.unit), (expected, "points"));
        assert_eq!(exported.undecoded, [("lost", 1)]);
        let points = cloud_rows(&csv);
        assert_eq!(points.len() as u64, expected);
        for point in &points {
            let ring = usize::try_from(point.ring).unwrap();
            let second = point.block % 2 == 1 && ring % 2 == 1;
            let expected = sources::distance_m(ring) + f32::from(u8::from(second));
            let [x, y, z] = point.xyz;
            assert!(
                ((x * x + y * y + z * z).sqrt() - expected).abs() < 1e-4,
                "{point:?}"
            );
            assert_eq!(point.intensity, point.ring);
        }
        run(&with(&pcap, &pcd, lidar)).unwrap();
        assert_eq!(
            pcd_points(&pcd),
            points,
            "digits of the text give the same floats"
        );
    }
}

#[test]
fn sweeps_are_chosen_by_number_and_divide_the_whole() {
    let dir = tempfile::tempdir().unwrap();
    let [pcap, csv] = ["a.pcap", "a.csv"].map(|name| dir.path().join(name));
    sources::write_pcap(&pcap);
    let of = |sweep| {
        with(
            &pcap,
            &csv,
            LidarOptions {
                sweep: Some(sweep),
                ..Default::default()
            },
        )
    };
    let (mut points, mut sweep) = (0, 0);
    let error = loop {
        match run(&of(sweep)) {
            Ok(exported) => points += exported.written,
            Err(error) => break error.to_string(),
        }
        sweep += 1;
    };
    assert_eq!(points, sources::returns(sources::PACKETS - 1).1);
    assert!(sweep >= 3, "2.3 turns, {sweep} sweeps");
    let expected = format!("no return in sweep {sweep}: the {sweep} sweeps begin at 0");
    assert!(error.contains(&expected), "{error}");
}

/// The filter behind the expected clouds: a range gate; an earlier echo of a firing closer than
/// 0.1 m to another dropped, so that of equal ones the last stays.
fn strict(points: &[Point]) -> Vec<Point> {
    let distance = |p: &Point| {
        p.xyz
            .iter()
            .map(|v| f64::from(*v).powi(2))
            .sum::<f64>()
            .sqrt()
    };
    let mut kept = Vec::new();
    for firing in points.chunk_by(|a, b| (a.t_ns, a.ring) == (b.t_ns, b.ring)) {
        for (i, point) in firing.iter().enumerate() {
            let d = distance(point);
            let near = firing[i + 1..]
                .iter()
                .any(|o| (d - distance(o)).abs() < 0.1 - 1e-6);
            if (0.1 - 1e-6..=60.0 + 1e-6).contains(&d) && !near {
                kept.push(*point);
            }
        }
    }
    kept
}

#[test]
fn the_real_qt64_cloud_is_met_point_by_point() {
    let Some(folder) = sources::data("hesai", "the_real_qt64_cloud") else {
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let csv = dir.path().join("qt64.csv");
    let lidar = LidarOptions {
        angles: Some(folder.join("PandarQT64.csv")),
        fire_times: Some(folder.join("PandarQT_firetime_us.csv")),
        returns: Returns::All,
        sweep: Some(3),
    };
    run(&with(&folder.join("qt64.pcap"), &csv, lidar)).unwrap();
    let points = strict(&cloud_rows(&csv));

    let bytes = fs::read(folder.join("qt64_gt.pcd")).unwrap();
    let truth = pcd_body(&bytes, "x y z").chunks_exact(12);
    assert_eq!(points.len(), truth.len());
    for (point, truth) in points.iter().zip(truth) {
        for (value, truth) in point.xyz.iter().zip(truth.chunks_exact(4)) {
            let truth = f32::from_le_bytes(truth.try_into().unwrap());
            assert!((value - truth).abs() < 1e-5, "{point:?}");
        }
    }

    let head = fs::read_to_string(folder.join("expected/qt64_scan_head.csv")).unwrap();
    let rows: Vec<_> = head.lines().skip(1).collect();
    assert_eq!(rows.len(), 2_000);
    for (row, point) in rows.iter().zip(&points) {
        let f: Vec<&str> = row.split(',').collect();
        for (k, value) in point.xyz.iter().enumerate() {
            assert!((value - f[k].parse::<f32>().unwrap()).abs() < 1e-5, "{row}");
        }
        let found = [point.intensity, point.ring, point.block, point.t_ns];
        assert_eq!(
            found,
            [f[3], f[4], f[5], f[8]].map(|f| f.parse::<u64>().unwrap()),
            "{row}"
        );
    }
}

#[test]
fn a_recording_gives_each_of_its_streams() {
    let dir = tempfile::tempdir().unwrap();
    let recording = dir.path().join("rec");
    sources::write_recording(&recording);
    let to = |name: &str| dir.path().join(name);
    run(&Request::new(&recording, to("a.npy"))).unwrap();
    assert_eq!(npy_rows(&to("a.npy")), event_rows(&sources::events()));
    let exported = run(&Request::new(&recording, to("a.pcd"))).unwrap();
    assert_eq!(exported.written, sources::returns(sources::PACKETS).1);
    let text = error(&recording, &to("a.csv"));
    assert!(
        text.contains("say which stream, events, lidar or depth"),
        "{text}"
    );
    for (stream, written) in [(Stream::Events, 1_000), (Stream::Lidar, exported.written)] {
        let request = Request {
            stream: Some(stream),
            ..Request::new(&recording, to("b.csv"))
        };
        assert_eq!(run(&request).unwrap().written, written);
    }
}

#[test]
fn true_and_sparse_depth_become_pictures() {
    let dir = tempfile::tempdir().unwrap();
    let recording = dir.path().join("rec");
    sources::write_recording(&recording);
    let (grey, colour) = (dir.path().join("grey"), dir.path().join("colour"));
    let depth = DepthOptions {
        format: DepthFormat::Png16,
        ..DepthOptions::default()
    };
    let request = Request {
        depth,
        ..Request::new(&recording, &grey)
    };
    assert_eq!(run(&request).unwrap().written, 2);
    assert_eq!(
        load_depth_png16(grey.join("000000_2.png")).unwrap().depth_m,
        sources::DEPTH_M
    );

    // A folder of 16-bit maps in colour, with the colours by hand.
    run(&Request::new(&grey, &colour)).unwrap();
    let canvas = Canvas::load_png(colour.join("000000_1.png")).unwrap();
    assert_eq!((canvas.width(), canvas.height()), (3, 2));
    let rgb = |depth_m: f32| Ramp::depth().at(Scale::DRIVE.position(depth_m));
    assert_eq!(canvas.pixel(0, 0), Some(rgb(1.0)));
    assert_eq!(canvas.pixel(1, 0), Some(INVALID_RGB));
    assert_eq!(canvas.pixel(0, 1), Some(rgb(80.0)));

    let depth = DepthOptions {
        layer: Layer::Sparse,
        ..DepthOptions::default()
    };
    run(&Request {
        depth,
        ..Request::new(&recording, &colour)
    })
    .unwrap();
    let canvas = Canvas::load_png(colour.join("000000_1.png")).unwrap();
    let pixels = [canvas.pixel(0, 0), canvas.pixel(2, 0)];
    assert_eq!(pixels, [Some(INVALID_RGB), Some(rgb(2.5))]);

    let map = grey.join("000000_1.png");
    let single = dir.path().join("single.png");
    assert_eq!(run(&Request::new(&map, &single)).unwrap().written, 1);
    assert!(error(&grey, &single).contains("2 depth maps need a folder"));
    assert!(error(&map, &map).contains("would be written over itself"));
    assert!(error(&single, &map).contains("needs grey of 16 bits"));
}

#[test]
fn what_cannot_be_exported_is_said_and_leaves_no_file() {
    let dir = tempfile::tempdir().unwrap();
    let to = |name: &str| dir.path().join(name);
    let (raw, pcap, empty) = (to("a.raw"), to("a.pcap"), to("empty.raw"));
    sources::write_raw(&raw);
    sources::write_pcap(&pcap);
    fs::write(&empty, "").unwrap();
    fs::write(to("text.raw"), "hello").unwrap();
    let cases: [(&Path, PathBuf, &str); 8] = [
        (
            &raw,
            to("a.mp4"),
            "a.mp4: no format of that extension: events go to .csv or .npy",
        ),
        (&raw, to("a.pcd"), "a.pcd: events cannot go to pcd"),
        (&raw, to("b.png"), "b.png: events cannot go to png"),
        (&pcap, to("a.npy"), "a.npy: lidar cannot go to npy"),
        (&empty, to("e.csv"), "empty.raw: byte 0: the file is empty"),
        (
            &to("text.raw"),
            to("t.csv"),
            "text.raw: byte 0: begins with hell",
        ),
        (
            &to("absent.raw"),
            to("t.csv"),
            "absent.raw: byte 0: cannot read",
        ),
        (&raw, to("no/such/folder/a.csv"), "a.csv.part: cannot write"),
    ];
    for (from, to, part) in cases {
        let text = error(from, &to);
        assert!(text.contains(part), "{part:?} in {text}");
        assert!(!to.exists(), "{}", to.display());
    }
    let request = Request {
        stream: Some(Stream::Lidar),
        ..Request::new(&raw, to("a.csv"))
    };
    assert!(
        run(&request)
            .unwrap_err()
            .to_string()
            .contains("a.raw: holds events, not lidar")
    );
    // A sweep that is not there: the target stays as it was, and nothing is left beside it.
    fs::write(to("kept.csv"), "mine").unwrap();
    let lidar = LidarOptions {
        sweep: Some(99),
        ..LidarOptions::default()
    };
    assert!(run(&with(&pcap, &to("kept.csv"), lidar)).is_err());
    assert_eq!(fs::read_to_string(to("kept.csv")).unwrap(), "mine");
    let names = fs::read_dir(dir.path())
        .unwrap()
        .map(|e| e.unwrap().file_name());
    assert!(
        !names
            .into_iter()
            .any(|name| name.to_string_lossy().ends_with(".part"))
    );
}

#[test]
fn a_truncated_capture_is_exported_up_to_the_cut() {
    let dir = tempfile::tempdir().unwrap();
    let (pcap, csv) = (dir.path().join("a.pcap"), dir.path().join("a.csv"));
    sources::write_pcap(&pcap);
    let whole = fs::read(&pcap).unwrap();
    fs::write(&pcap, &whole[..24 + 5 * (16 + 42 + 1072) + 200]).unwrap();
    let exported = run(&Request::new(&pcap, &csv)).unwrap();
    assert_eq!(exported.written, sources::returns(5).1);
    assert!(exported.faults[0].to_string().contains("a.pcap: byte "));
    fs::write(&pcap, &whole[..24]).unwrap();
    assert!(error(&pcap, &csv).contains("no packet of a known lidar"));
}

#[test]
fn the_command_writes_and_says_how_much() {
    let dir = tempfile::tempdir().unwrap();
    let (raw, csv) = (dir.path().join("a.raw"), dir.path().join("a.csv"));
    sources::write_raw(&raw);
    let noctule = |to: &Path| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_noctule"));
        command
            .arg("export")
            .arg(&raw)
            .arg("--to")
            .arg(to)
            .output()
            .unwrap()
    };
    let output = noctule(&csv);
    assert_eq!(output.status.code(), Some(0));
    assert!(
        String::from_utf8(output.stdout)
            .unwrap()
            .ends_with("a.csv: 1000 events\n")
    );
    assert_eq!(csv_rows(&csv).len(), 1_000);
    let output = noctule(&dir.path().join("a.xyz"));
    assert_eq!(output.status.code(), Some(1));
    assert!(
        String::from_utf8(output.stderr)
            .unwrap()
            .contains("no format of that extension")
    );
}

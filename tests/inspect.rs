//! What `inspect` says of real captures, of made-up files, and of damaged ones.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use noctule::inspect::{InspectError, Inspection, Options, bytes_to_read, inspect};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

mod sources;

fn run(path: &Path) -> Inspection {
    inspect(path, &Options::default(), &|_| {}).unwrap()
}

fn json(inspection: &Inspection) -> Value {
    serde_json::from_str(&serde_json::to_string(inspection).unwrap()).unwrap()
}

fn read(path: &Path) -> Value {
    serde_json::from_str(&fs::read_to_string(path).unwrap()).unwrap()
}

#[test]
fn every_real_raw_file_is_as_expected() {
    let Some(folder) = sources::data("events", "every_real_raw_file") else {
        return;
    };
    let expected = read(&folder.join("expected.json"));
    for (name, expected) in expected["files"].as_object().unwrap() {
        let path = folder.join(name);
        let found = json(&run(&path));
        assert_eq!(found["kind"], "raw", "{name}");
        assert_eq!(found["path"], path.to_str().unwrap());
        let pairs = [
            ("format", "format"),
            ("width", "width"),
            ("height", "height"),
            ("events", "cd_events"),
            ("on", "on"),
            ("first_us", "first_t_us"),
            ("last_us", "last_t_us"),
            ("sum_x", "sum_x"),
            ("sum_y", "sum_y"),
            ("sum_us", "sum_t_mod_2p64"),
            ("nonmonotonic", "cd_nonmonotonic"),
            ("events_sha256", "events_sha256_t8x2y2p1_le"),
        ];
        for (ours, theirs) in pairs {
            assert_eq!(found[ours], expected[theirs], "{name}: {ours}");
        }
        let count = |key: &str| found[key].as_u64().unwrap();
        assert_eq!(count("on") + count("off"), count("events"), "{name}");
        assert_eq!(found["errors"].as_object().unwrap().len(), 7, "{name}");
        assert_eq!(found["errors"]["out_of_bounds"], expected["oob"], "{name}");
        check_triggers(&found["triggers"], &expected["triggers"], name);
    }
}

fn check_triggers(found: &Value, expected: &Value, name: &str) {
    let found = found.as_array().unwrap();
    let sum = |key: &str| found.iter().map(|t| t[key].as_u64().unwrap()).sum::<u64>();
    let of = |key: &str| expected[key].as_u64().unwrap_or(0);
    assert_eq!(
        (sum("rising"), sum("falling")),
        (of("rising"), of("falling")),
        "{name}"
    );
    assert_eq!(sum("sum_us"), of("sum_t"), "{name}");
    let none = serde_json::Map::new();
    let channels = expected["channels"].as_object().unwrap_or(&none);
    let found_channels: Vec<_> = found.iter().map(|t| t["channel"].to_string()).collect();
    assert_eq!(
        found_channels,
        channels.keys().cloned().collect::<Vec<_>>(),
        "{name}"
    );
    if let (Some(first), Some(last)) = (expected["first"][0].get(0), found.first()) {
        assert_eq!(&last["first_us"], first, "{name}");
        let end = expected["last"].as_array().unwrap().last().unwrap();
        assert_eq!(last["last_us"], end[0], "{name}");
    }
}

#[test]
fn every_real_capture_is_as_expected() {
    let Some(folder) = sources::data("hesai", "every_real_capture") else {
        return;
    };
    for (name, table) in [
        ("qt64", "PandarQT64.csv"),
        ("qt128", "PandarQT128.csv"),
        ("xt32", "PandarXT32.csv"),
        ("pandar64", "Pandar64.csv"),
    ] {
        let expected = read(&folder.join(format!("expected/{name}.all.json")));
        let path = folder.join(format!("{name}.pcap"));
        let options = Options {
            angles: Some(folder.join(table)),
            ..Options::default()
        };
        for options in [&Options::default(), &options] {
            let found = json(&inspect(&path, options, &|_| {}).unwrap());
            assert_eq!(
                (&found["kind"], &found["model"]),
                (&json!("lidar"), &json!(name))
            );
            assert_eq!(found["packets"], expected["packets"], "{name}");
            assert_eq!(found["returns"], expected["points"], "{name}");
            let scans = expected["scans"].as_object().unwrap();
            assert_eq!(found["sweeps"], scans.len(), "{name}");
            let time = |key: &'static str| scans.values().map(move |s| s[key].as_u64().unwrap());
            assert_eq!(
                found["first_ns"],
                time("t_first_ns").min().unwrap(),
                "{name}"
            );
            assert_eq!(found["last_ns"], time("t_last_ns").max().unwrap(), "{name}");
            for fault in ["lost", "late", "duplicate"] {
                assert_eq!(found[fault], 0, "{name}: {fault}");
            }
            assert_eq!(
                (&found["rejected"], &found["faults"]),
                (&json!({}), &json!([]))
            );
        }
    }
}

#[test]
fn a_raw_file_is_summed_up() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("no_extension");
    sources::write_raw(&path);
    let found = json(&run(&path));
    let events = sources::events();
    let (mut hash, mut sums) = (Sha256::new(), [0; 3]);
    for event in &events {
        let t_us = event.t.as_micros();
        hash.update(t_us.to_le_bytes());
        hash.update(event.x.to_le_bytes());
        hash.update(event.y.to_le_bytes());
        hash.update([u8::from(event.on)]);
        for (sum, value) in sums.iter_mut().zip([t_us, event.x.into(), event.y.into()]) {
            *sum += value;
        }
    }
    let digest: String = hash.finalize().iter().map(|b| format!("{b:02x}")).collect();
    let on = events.iter().filter(|event| event.on).count();
    let expected = json!({
        "kind": "raw", "format": "EVT3", "width": 1280, "height": 720,
        "events": events.len(), "on": on, "off": events.len() - on,
        "first_us": 1_000, "last_us": 50_950, "sum_x": sums[1], "sum_y": sums[2],
        "events_sha256": digest, "sum_us": sums[0], "nonmonotonic": 0,
        "triggers": [{ "channel": 0, "rising": 2, "falling": 2, "first_us": 2_010,
            "last_us": 42_020, "sum_us": 2_010 + 12_010 + 22_020 + 42_020 }],
        "errors": { "out_of_bounds": 0, "before_first_time_high": 0, "missing_y": 0,
            "missing_vect_base": 0, "time_backwards": 0, "reserved_word": 0,
            "trailing_bytes": 0 },
        "path": path, "faults": [],
    });
    assert_eq!(found, expected);
}

#[test]
fn a_capture_is_summed_up_with_its_lost_packet() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("made_up.pcap");
    sources::write_pcap(&path);
    let found = json(&run(&path));
    let packets = sources::PACKETS - 1;
    let (returns, points) = sources::returns(packets);
    for (key, value) in [
        ("packets", packets),
        ("returns", returns),
        ("points", points),
    ] {
        assert_eq!(found[key], value, "{key}");
    }
    assert_eq!(
        (&found["lost"], &found["late"], &found["duplicate"]),
        (&json!(1), &json!(0), &json!(0))
    );
    assert_eq!(
        (&found["model"], &found["port"]),
        (&json!("qt64"), &json!(sources::PORT))
    );
    assert_eq!(
        found["skipped"],
        json!({"other_port": 0, "not_udp": 0, "fragments": 0, "cut": 0})
    );
}

#[test]
fn a_recording_is_summed_up_stream_by_stream() {
    let dir = tempfile::tempdir().unwrap();
    sources::write_recording(dir.path());
    let inspection = run(dir.path());
    let found = json(&inspection);
    assert_eq!(
        (&found["kind"], &found["schema"]),
        (&json!("recording"), &json!(1))
    );
    assert_eq!(
        found["generator"],
        json!({"name": "tests", "version": "1", "seed": 7})
    );
    assert_eq!(found["events"]["events"], 1_000);
    assert_eq!(found["transfers"]["bytes"], sources::raw().1.len());
    let (returns, points) = sources::returns(sources::PACKETS);
    let lidar = &found["lidar"];
    assert_eq!(
        (&lidar["returns"], &lidar["points"]),
        (&json!(returns), &json!(points))
    );
    assert_eq!(
        (&found["images"]["count"], &found["images"]["lost"]),
        (&json!(3), &json!(1))
    );
    assert_eq!(found["images"]["last_ns"], 1_600_000_000);
    // The first frame of the bus has no partner yet.
    let can = &found["can"];
    assert_eq!((&can["frames"], &can["motion"]), (&json!(10), &json!(9)));
    assert_eq!(
        (&can["used"], &can["unpaired"], &can["errors"]),
        (&json!(10), &json!(1), &json!(0))
    );
    let exposures = json!({
        "strobe_channel": 0, "pulses": 2, "unpaired_edges": 0, "width_us_min": 10_000,
        "width_us_max": 20_000, "width_us_sum": 30_000, "first_us": 2_010, "last_us": 42_020,
        "truth": { "exposures": 2, "images_dropped": 1, "edges_missed": 2, "edges_doubled": 1 },
    });
    assert_eq!(found["exposures"], exposures);
    assert_eq!(
        (
            &found["clocks"]["readings"],
            &found["clocks"]["tai_offset_s"]
        ),
        (&json!(2), &json!(37))
    );
    assert_eq!(
        (&found["samples"], &found["missing"]),
        (&json!(1), &json!(["truth_clocks"]))
    );
    assert_eq!(found["faults"], json!([]));
    let text = inspection.to_string();
    for part in [
        "recording \"made up\"",
        "events       RAW EVT3, 1280x720",
        "missing      truth_clocks",
    ] {
        assert!(text.contains(part), "{part:?} in {text}");
    }
}

#[test]
fn damaged_streams_of_a_recording_leave_the_others_alone() {
    let dir = tempfile::tempdir().unwrap();
    sources::write_recording(dir.path());
    let cut = |name: &str, by: u64| {
        let file = fs::OpenOptions::new()
            .write(true)
            .open(dir.path().join(name))
            .unwrap();
        file.set_len(file.metadata().unwrap().len() - by).unwrap();
    };
    cut("raw/lidar.pcap", 100);
    cut("raw/events.raw", 7);
    fs::write(dir.path().join("raw/can.log"), "no candump line\n").unwrap();
    fs::remove_file(dir.path().join("raw/rgb.csv")).unwrap();
    let found = json(&run(dir.path()));
    assert_eq!(found["lidar"]["packets"], sources::PACKETS - 1);
    assert!(found["events"]["events"].as_u64().unwrap() > 990);
    assert_eq!(
        (&found["images"], &found["can"]["frames"]),
        (&Value::Null, &json!(0))
    );
    assert_eq!(found["missing"], json!(["images", "truth_clocks"]));
    let faults: Vec<_> = found["faults"]
        .as_array()
        .unwrap()
        .iter()
        .map(|f| f.as_str().unwrap())
        .collect();
    for part in ["raw/lidar.pcap: ", "raw/events.raw: ", "raw/can.log:1: "] {
        assert!(
            faults.iter().any(|fault| fault.contains(part)),
            "{part} in {faults:?}"
        );
    }
}

#[test]
fn truncated_files_are_read_as_far_as_they_go_and_the_place_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let (header, payload) = sources::raw();
    let raw = dir.path().join("cut.raw");
    fs::write(&raw, [&header[..], &payload[..101]].concat()).unwrap();
    let found = run(&raw);
    assert_eq!(json(&found)["errors"]["trailing_bytes"], 1);
    let place = header.len() + 100;
    let expected = format!(
        "{}: byte {place}: file ends after 1 bytes of a word",
        raw.display()
    );
    assert_eq!(found.faults[0].to_string(), expected);

    let pcap = dir.path().join("cut.pcap");
    sources::write_pcap(&pcap);
    let whole = fs::read(&pcap).unwrap();
    // A record has 16 bytes of its own and 42 of Ethernet, IP and UDP around the payload.
    let record = 16 + 42 + 1072;
    fs::write(&pcap, &whole[..24 + 5 * record + 200]).unwrap();
    let found = run(&pcap);
    assert_eq!(json(&found)["packets"], 5);
    assert!(matches!(found.faults[..], [InspectError::Capture { .. }]));
    let text = found.faults[0].to_string();
    let place = format!("byte {}: file ends after", 24 + 5 * record + 16);
    assert!(text.contains("cut.pcap") && text.contains(&place), "{text}");
}

/// Files of which nothing can be read: name, contents, and what the error says.
const UNREADABLE: [(&str, &[u8], &str); 6] = [
    ("empty.raw", b"", "empty.raw: byte 0: the file is empty"),
    (
        "notes.txt",
        b"hello world",
        "notes.txt: byte 0: begins with hell, which is neither",
    ),
    (
        "odd.raw",
        b"% evt 9.9\n% end\n",
        "odd.raw: byte 0: raw header names an unknown encoding",
    ),
    (
        "small.raw",
        b"% evt 3.0\n% end\n",
        "raw header gives no geometry",
    ),
    (
        "short.pcap",
        b"\xd4\xc3\xb2\xa1\x02\x00",
        "short.pcap: byte 0: file ends after",
    ),
    (
        "link.pcap",
        b"\xd4\xc3\xb2\xa1\x02\x00\x04\x00\0\0\0\0\0\0\0\0\xff\xff\0\0\xfe\xfe\0\0",
        "link.pcap: byte 20: link type 65278",
    ),
];

#[test]
fn unreadable_files_are_errors_that_name_the_place() {
    let dir = tempfile::tempdir().unwrap();
    for (name, bytes, part) in UNREADABLE {
        let path = dir.path().join(name);
        fs::write(&path, bytes).unwrap();
        let error = inspect(&path, &Options::default(), &|_| {})
            .unwrap_err()
            .to_string();
        assert!(error.contains(part), "{name}: {error}");
    }
    let error = inspect(dir.path(), &Options::default(), &|_| {})
        .unwrap_err()
        .to_string();
    assert!(
        error.ends_with("has no meta.json, so it is no recording"),
        "{error}"
    );
    let absent = dir.path().join("absent.raw");
    let error = inspect(&absent, &Options::default(), &|_| {})
        .unwrap_err()
        .to_string();
    assert!(error.contains("absent.raw: byte 0: cannot read"), "{error}");
    fs::write(dir.path().join("meta.json"), "{\"schema\": 99}").unwrap();
    let error = inspect(dir.path(), &Options::default(), &|_| {})
        .unwrap_err()
        .to_string();
    assert!(error.contains("schema 99"), "{error}");
}

#[test]
fn a_table_of_another_sensor_is_refused_with_its_line() {
    let dir = tempfile::tempdir().unwrap();
    let (pcap, table) = (dir.path().join("a.pcap"), dir.path().join("angles.csv"));
    sources::write_pcap(&pcap);
    fs::write(&table, "Laser id,Elevation,Azimuth\n1,0.5,0.1\n77,1,2\n").unwrap();
    let options = Options {
        angles: Some(table),
        ..Options::default()
    };
    let error = inspect(&pcap, &options, &|_| {}).unwrap_err().to_string();
    assert!(error.contains("angles.csv: line 3: channel 77"), "{error}");
}

#[test]
fn progress_adds_up_to_what_was_announced() {
    let dir = tempfile::tempdir().unwrap();
    let paths: [PathBuf; 2] = ["a.raw", "b.pcap"].map(|name| dir.path().join(name));
    sources::write_raw(&paths[0]);
    sources::write_pcap(&paths[1]);
    for path in paths {
        let read = std::cell::Cell::new(0);
        inspect(&path, &Options::default(), &|len| {
            read.set(read.get() + len)
        })
        .unwrap();
        assert_eq!(read.get(), bytes_to_read(&path));
    }
}

fn noctule(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_noctule"))
        .args(arguments)
        .output()
        .unwrap()
}

#[test]
fn the_command_prints_a_line_per_file_and_fails_for_unreadable_ones() {
    let dir = tempfile::tempdir().unwrap();
    let paths = ["a.raw", "b.pcap", "c.txt"].map(|name| dir.path().join(name));
    sources::write_raw(&paths[0]);
    sources::write_pcap(&paths[1]);
    fs::write(&paths[2], "text").unwrap();
    let [raw, pcap, text] = paths.each_ref().map(|path| path.to_str().unwrap());
    let output = noctule(&["inspect", "--json", raw, text, pcap]);
    assert_eq!(output.status.code(), Some(1));
    let kinds: Vec<_> = String::from_utf8(output.stdout)
        .unwrap()
        .lines()
        .map(|line| serde_json::from_str::<Value>(line).unwrap()["kind"].clone())
        .collect();
    assert_eq!(kinds, ["raw", "lidar"]);
    assert!(
        String::from_utf8(output.stderr)
            .unwrap()
            .contains("c.txt: byte 0: begins with text")
    );

    let output = noctule(&["inspect", raw]);
    assert_eq!(output.status.code(), Some(0));
    assert!(
        String::from_utf8(output.stdout)
            .unwrap()
            .contains("RAW EVT3, 1280x720")
    );
    let geometry = ["inspect", "--geometry", "1280", raw];
    assert_eq!(noctule(&geometry).status.code(), Some(2));
}

#[test]
fn a_header_without_geometry_takes_the_one_given() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("old.raw");
    let payload = sources::raw().1;
    fs::write(&path, [b"% evt 3.0\n% end\n", &payload[..]].concat()).unwrap();
    let output = noctule(&[
        "inspect",
        "--json",
        "--geometry",
        "1280x720",
        path.to_str().unwrap(),
    ]);
    let found: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(
        (&found["events"], &found["width"]),
        (&json!(1_000), &json!(1280))
    );
}

//! What is wrong with a recording is said with file, line and field; what was cut off is counted,
//! and everything before it is read.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod made_up;

use std::fs::{self, File, OpenOptions};
use std::path::Path;

use made_up::{TRANSFERS, begin, calibration, delivered, meta, write};
use noctule_camera::{FrameStamp, StampedAt};
use noctule_can::{Frame, Id};
use noctule_recording::{
    Calibration, Faults, Missing, Recording, RecordingError, RecordingWriter, TruthWriter,
    WriteError,
};
use noctule_sensor::Stamp;
use tempfile::TempDir;

fn recorded() -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), &delivered());
    dir
}

/// Cuts the last `bytes` off a file.
fn cut(dir: &Path, name: &str, bytes: u64) {
    let file = OpenOptions::new().write(true).open(dir.join(name)).unwrap();
    let len = file.metadata().unwrap().len();
    file.set_len(len - bytes).unwrap();
}

/// Replaces text that must be there.
fn edit(dir: &Path, name: &str, from: &str, to: &str) {
    let path = dir.join(name);
    let text = fs::read_to_string(&path).unwrap();
    assert!(text.contains(from), "{name} has no {from:?}:\n{text}");
    fs::write(path, text.replacen(from, to, 1)).unwrap();
}

/// The error's text without the temporary directory.
fn text(dir: &Path, error: &RecordingError) -> String {
    error
        .to_string()
        .replace(&format!("{}/", dir.display()), "")
}

fn transfers(recording: &Recording) -> (usize, usize, Faults) {
    let mut stream = recording.event_transfers().unwrap();
    let (mut count, mut bytes) = (0, 0);
    while let Some(transfer) = stream.next_transfer().unwrap() {
        count += 1;
        bytes += transfer.bytes.len();
    }
    assert_eq!(stream.next_transfer().unwrap(), None);
    (count, bytes, stream.faults())
}

#[test]
fn a_recording_that_was_never_finished_says_so_and_is_read_as_far_as_it_goes() {
    let dir = tempfile::tempdir().unwrap();
    let given = delivered();
    drop(begin(dir.path(), &given));
    let recording = Recording::open(dir.path()).unwrap();
    assert_eq!(recording.counts(), None);
    assert_eq!(recording.missing()[0], Missing::End);
    let (count, _, faults) = transfers(&recording);
    assert_eq!((count, faults), (TRANSFERS, Faults::default()));
    assert_eq!(recording.can_frames().unwrap().count(), given.can.len());
}

/// As after a power cut: nothing that was buffered reached the disk.
#[test]
fn a_recording_whose_buffers_were_lost_still_opens() {
    let dir = tempfile::tempdir().unwrap();
    std::mem::forget(begin(dir.path(), &delivered()));
    let recording = Recording::open(dir.path()).unwrap();
    assert_eq!(recording.missing()[0], Missing::End);
    assert_eq!(transfers(&recording), (0, 0, Faults::default()));
    let mut capture = recording.datagrams().unwrap();
    assert_eq!(capture.next_datagram().unwrap(), None);
    assert_eq!(capture.faults().truncated_rows, 1);
    assert_eq!(recording.images().unwrap().count(), 0);
    assert_eq!(recording.can_frames().unwrap().count(), 0);
    assert_eq!(recording.clock_readings().unwrap().count(), 0);
}

#[test]
fn a_cut_event_file_gives_its_last_transfer_as_far_as_it_goes() {
    let dir = recorded();
    cut(dir.path(), "raw/events.raw", 10);
    let whole: usize = delivered().transfers.iter().map(|t| t.0.len()).sum();
    let (count, bytes, faults) = transfers(&Recording::open(dir.path()).unwrap());
    assert_eq!((count, bytes), (TRANSFERS, whole - 10));
    let expected = Faults {
        truncated_bytes: 10,
        ..Faults::default()
    };
    assert_eq!(faults, expected);
}

#[test]
fn a_transfer_that_is_not_there_at_all_is_absent() {
    let dir = recorded();
    let last = delivered().transfers[TRANSFERS - 1].0.len() as u64;
    cut(dir.path(), "raw/events.raw", last);
    let (count, _, faults) = transfers(&Recording::open(dir.path()).unwrap());
    assert_eq!(count, TRANSFERS - 1);
    assert_eq!((faults.truncated_bytes, faults.absent_rows), (last, 1));
}

#[test]
fn an_event_file_cut_inside_an_earlier_transfer_ends_there() {
    let dir = recorded();
    let last = delivered().transfers[TRANSFERS - 1].0.len();
    let whole: usize = delivered().transfers.iter().map(|t| t.0.len()).sum();
    cut(dir.path(), "raw/events.raw", last as u64 + 10);
    let (count, bytes, faults) = transfers(&Recording::open(dir.path()).unwrap());
    assert_eq!((count, bytes), (TRANSFERS - 1, whole - last - 10));
    let missing = (faults.truncated_bytes, faults.absent_rows);
    assert_eq!(missing, (last as u64 + 10, 1));
}

#[test]
fn a_cut_event_table_leaves_unlisted_bytes() {
    let dir = recorded();
    let last = delivered().transfers[TRANSFERS - 1].0.len() as u64;
    cut(dir.path(), "raw/events.csv", 3);
    let (count, _, faults) = transfers(&Recording::open(dir.path()).unwrap());
    assert_eq!(count, TRANSFERS - 1);
    let expected = Faults {
        truncated_rows: 1,
        truncated_bytes: 0,
        unlisted_bytes: last,
        absent_rows: 1,
    };
    assert_eq!(faults, expected);
}

#[test]
fn a_cut_capture_loses_its_last_datagram_and_no_more() {
    let dir = recorded();
    cut(dir.path(), "raw/lidar.pcap", 7);
    let mut capture = Recording::open(dir.path()).unwrap().datagrams().unwrap();
    let mut count = 0;
    while capture.next_datagram().unwrap().is_some() {
        count += 1;
    }
    assert_eq!(count, delivered().datagrams.len() - 1);
    let faults = capture.faults();
    assert_eq!((faults.truncated_rows, faults.truncated_bytes), (1, 7));
    assert_eq!(faults.absent_rows, 1);
}

#[test]
fn cut_tables_and_logs_lose_their_last_row_and_count_it() {
    let dir = recorded();
    for name in ["raw/rgb.csv", "raw/can.log", "raw/clocks.csv"] {
        cut(dir.path(), name, 1);
    }
    let recording = Recording::open(dir.path()).unwrap();
    let lost = Faults {
        truncated_rows: 1,
        absent_rows: 1,
        ..Faults::default()
    };
    let mut images = recording.images().unwrap();
    assert_eq!((images.by_ref().count(), images.faults()), (2, lost));
    let mut can = recording.can_frames().unwrap();
    assert_eq!((can.by_ref().count(), can.faults()), (3, lost));
    let mut clocks = recording.clock_readings().unwrap();
    assert_eq!((clocks.by_ref().count(), clocks.faults()), (2, lost));
}

/// Edits one file of a good recording and gives the error of opening it.
fn refuse(name: &str, from: &str, to: &str) -> String {
    let dir = recorded();
    edit(dir.path(), name, from, to);
    text(dir.path(), &Recording::open(dir.path()).unwrap_err())
}

#[test]
fn meta_and_calibration_that_do_not_fit_are_refused_with_their_place() {
    assert_eq!(
        refuse("meta.json", "\"schema\": 1", "\"schema\": 2"),
        "meta.json: schema 2, this program reads 1"
    );
    let unknown = refuse("meta.json", "\"steps\": 8", "\"stpes\": 8");
    assert!(unknown.starts_with("meta.json:"), "{unknown}");
    assert!(unknown.contains("unknown field `stpes`"), "{unknown}");
    assert_eq!(
        refuse("meta.json", "\"steps\": 8", "\"steps\": 0"),
        "meta.json: recording.steps = 0: not in 1..=64"
    );
    assert_eq!(
        refuse("meta.json", "\"bit_depth\": 8", "\"bit_depth\": 12"),
        "meta.json: recording.camera.bit_depth = 12: schema 1 has 8"
    );
    assert_eq!(
        refuse("meta.json", "\"x\": 1,", "\"x\": 3,"),
        "meta.json: recording.crop.rectangle = 4x4+3+0: empty or outside the image"
    );
    assert_eq!(
        refuse("meta.json", "\"can0\"", "\"can 0\""),
        "meta.json: recording.can.interface = can 0: not 1 to 15 printable characters"
    );
    let signals = refuse("meta.json", "\"length_bits\": 16", "\"length_bits\": 99");
    assert_eq!(
        signals,
        "meta.json: recording.can.motion = signal speed: length_bits 99 is not in 1..=64: \
         unusable signals"
    );
    assert_eq!(
        refuse("calib.toml", "schema = 1", "schema = 7"),
        "calib.toml: schema 7, this program reads 1"
    );
    let hash = refuse("calib.toml", "cx = 255.5", "cx = 255.6");
    assert!(
        hash.starts_with("meta.json: calibration_sha256 = "),
        "{hash}"
    );
    assert!(hash.ends_with("calib.toml has another hash"), "{hash}");
    let syntax = refuse("calib.toml", "[camera]", "[camera");
    assert!(syntax.starts_with("calib.toml:"), "{syntax}");
}

#[test]
fn a_directory_that_is_no_recording_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let error = Recording::open(dir.path()).unwrap_err();
    assert!(text(dir.path(), &error).starts_with("meta.json: No such file"));
}

#[test]
fn calibrations_that_cannot_be_name_the_number() {
    let refuse = |from: &str, to: &str| {
        let text = include_str!("../../../config/calibration/default.toml");
        assert!(text.contains(from), "{from:?}");
        let path = Path::new("calib.toml");
        let edited = text.replacen(from, to, 1);
        Calibration::parse(&edited, path).unwrap_err().to_string()
    };
    assert_eq!(
        refuse("fx = 5", "fx = -5").split(" = ").next().unwrap(),
        "calib.toml: camera.fx"
    );
    assert_eq!(
        refuse("x = 384", "x = 769"),
        "calib.toml: events.roi.rectangle = 512x512+769+104: empty or outside the image"
    );
    assert_eq!(
        refuse("width = 1280", "width = 0"),
        "calib.toml: events.lens.width = 0: not in 1..=16384"
    );
    assert!(refuse("[[1.0, 0.0, 0.0]", "[[1.1, 0.0, 0.0]").starts_with(
        "calib.toml: camera_from_events.rotation = [[1.1, 0.0, 0.0], [0.0, 1.0, 0.0]"
    ));
    assert_eq!(
        refuse("lidar = 60000", "lidar = 10000000000"),
        "calib.toml: delays_ns.lidar = 10000000000: ten seconds or more"
    );
    assert_eq!(
        refuse("schema = 1", "schema = 1\nlidar_angles = \"../a.csv\""),
        "calib.toml: lidar_angles = ../a.csv: not the name of a .csv file"
    );
    let unknown = refuse("cx = 255.5", "cx = 255.5\nskew = 0.0");
    assert!(
        unknown.starts_with("calib.toml:12: unknown field `skew`"),
        "{unknown}"
    );
}

/// Edits one table of a good recording and gives the error of reading it to the end.
fn refuse_row(name: &str, from: &str, to: &str) -> String {
    let dir = recorded();
    edit(dir.path(), name, from, to);
    let recording = Recording::open(dir.path()).unwrap();
    let error = match name {
        "raw/events.csv" => {
            let read = || {
                let mut stream = recording.event_transfers()?;
                while stream.next_transfer()?.is_some() {}
                Ok(())
            };
            read().unwrap_err()
        }
        "raw/rgb.csv" => match recording.images() {
            Ok(mut rows) => rows.find_map(Result::err).unwrap(),
            Err(error) => error,
        },
        "raw/can.log" => {
            let mut frames = recording.can_frames().unwrap();
            let error = frames.find_map(Result::err).unwrap();
            assert!(frames.next().is_none());
            error
        }
        _ => recording
            .clock_readings()
            .unwrap()
            .find_map(Result::err)
            .unwrap(),
    };
    text(dir.path(), &error)
}

#[test]
fn rows_that_cannot_be_are_located() {
    assert_eq!(
        refuse_row("raw/events.csv", "byte_offset", "offset"),
        "raw/events.csv:1: columns \"offset,length,arrival_realtime_ns\", \
         expected \"byte_offset,length,arrival_realtime_ns\""
    );
    assert_eq!(
        refuse_row("raw/events.csv", "72,27,", "72,28,"),
        "raw/events.csv:3: byte_offset = \"99\": not where the transfer before ends"
    );
    assert_eq!(
        refuse_row("raw/events.csv", "72,27,", "72,99999999,"),
        "raw/events.csv:2: length = \"99999999\": more than 64 MiB"
    );
    assert_eq!(
        refuse_row("raw/events.csv", "72,27,", "99999999,27,"),
        "raw/events.csv:2: byte_offset = \"99999999\": more than 256 KiB of header"
    );
    assert_eq!(
        refuse_row("raw/events.csv", "72,27,", "72,-1,"),
        "raw/events.csv:2: length = \"-1\": not a number of its range"
    );
    assert_eq!(
        refuse_row("raw/rgb.csv", "monotonic", "tai"),
        "raw/rgb.csv:2: driver_clock = \"tai\": the driver's clock must be monotonic"
    );
    assert_eq!(
        refuse_row("raw/rgb.csv", "start_of_exposure", "start"),
        "raw/rgb.csv:2: stamped_at = \"start\": neither start_of_exposure nor end_of_exposure"
    );
    assert_eq!(
        refuse_row("raw/rgb.csv", ",0.1\n", ",NaN\n"),
        "raw/rgb.csv:3: gain_db = \"NaN\": not finite"
    );
    assert_eq!(
        refuse_row("raw/rgb.csv", "0,4294967295,", "0,4294967296,"),
        "raw/rgb.csv:2: sequence = \"4294967296\": not a number of its range"
    );
    let fields = refuse_row("raw/clocks.csv", ",37,", ",37,,");
    assert!(fields.starts_with("raw/clocks.csv:2: row = "), "{fields}");
    assert!(
        fields.ends_with("has not as many fields as there are columns"),
        "{fields}"
    );
    assert_eq!(
        refuse_row("raw/can.log", "can0 200#", "can0 2000#"),
        "raw/can.log:1: identifier \"2000\" is not three or eight hexadecimal digits"
    );
    let long = "x".repeat(5000);
    let text = refuse_row("raw/clocks.csv", "1700000000123456789,", &long);
    assert!(text.ends_with("longer than 4096 bytes"), "{text}");
}

#[test]
fn bytes_that_are_no_text_are_located() {
    let dir = recorded();
    let path = dir.path().join("raw/clocks.csv");
    let mut bytes = fs::read(&path).unwrap();
    let at = bytes.len() - 2;
    bytes[at] = 0xFF;
    fs::write(&path, bytes).unwrap();
    let recording = Recording::open(dir.path()).unwrap();
    let error = recording
        .clock_readings()
        .unwrap()
        .find_map(Result::err)
        .unwrap();
    let text = text(dir.path(), &error);
    assert!(text.starts_with("raw/clocks.csv:4: line = "), "{text}");
    assert!(text.ends_with("not utf-8"), "{text}");
}

#[test]
fn pictures_that_cannot_be_are_named() {
    let dir = recorded();
    let recording = Recording::open(dir.path()).unwrap();
    let mut pixels = Vec::new();
    let mut refuse = |index| {
        text(
            dir.path(),
            &recording.read_image(index, &mut pixels).unwrap_err(),
        )
    };
    assert!(refuse(9).starts_with("raw/rgb/000009.png: No such file"));
    cut(dir.path(), "raw/rgb/000000.png", 40);
    assert!(refuse(0).starts_with("raw/rgb/000000.png: "));
    fs::write(dir.path().join("raw/rgb/000001.png"), b"not a picture").unwrap();
    assert!(refuse(1).starts_with("raw/rgb/000001.png: "));

    let truth = TruthWriter::create(dir.path(), 2).unwrap();
    let sample = truth.sample(0).unwrap();
    sample.blur(2, 2, &[0; 12]).unwrap();
    sample.gt(1, 2, 2, &[0.5, 0.9, 0.0, 0.25]).unwrap();
    sample.gt(2, 2, 2, &[300.0, -1.0, f32::NAN, 2.0]).unwrap();
    let copy = |from: &str, to: &str| {
        let folder = dir.path().join("derived/000000");
        fs::copy(folder.join(from), folder.join(to)).unwrap();
    };
    copy("blur.png", "sparse/1.png");
    copy("gt/1.png", "flow/1.npy");
    fs::copy(
        dir.path().join("derived/000000/blur.png"),
        dir.path().join("raw/rgb/000002.png"),
    )
    .unwrap();
    let size = refuse(2);
    assert_eq!(
        size,
        "raw/rgb/000002.png: size (2, 2), meta.json says (6, 4)"
    );
    let read = recording.sample_truth(0).unwrap();
    let shallow = text(dir.path(), &read.gt(1).unwrap_err());
    assert!(
        shallow.contains("largest value is 230: 8-bit values"),
        "{shallow}"
    );
    // What 16 bits cannot hold is no depth.
    assert_eq!(read.gt(2).unwrap().data, [0.0, 0.0, 0.0, 2.0]);
    let kind = text(dir.path(), &read.sparse(1).unwrap_err());
    assert!(kind.contains("expected (Grayscale, Sixteen)"), "{kind}");
    let flow = text(dir.path(), &read.flow(1).unwrap_err());
    assert!(flow.starts_with("derived/000000/flow/1.npy: "), "{flow}");
    let none = text(dir.path(), &recording.sample_truth(5).unwrap_err());
    assert_eq!(
        none,
        "derived/000005: the recording has no sample of this number"
    );
}

#[test]
fn a_recording_is_never_written_over() {
    let dir = recorded();
    let again = RecordingWriter::create(dir.path(), meta(), &calibration()).unwrap_err();
    assert!(matches!(again, WriteError::Exists { path } if path.ends_with("meta.json")));
    TruthWriter::create(dir.path(), 8).unwrap();
    let again = TruthWriter::create(dir.path(), 8).unwrap_err();
    assert!(matches!(again, WriteError::Exists { path } if path.ends_with("truth")));
}

#[test]
fn what_does_not_belong_is_not_written() {
    let dir = tempfile::tempdir().unwrap();
    let mut bare = meta();
    (bare.events, bare.camera, bare.lidar, bare.can) = (None, None, None, None);
    let rig = Calibration::default_rig();
    let mut writer = RecordingWriter::create(dir.path(), bare, &rig).unwrap();
    let stamp = FrameStamp {
        sequence: 0,
        driver: Stamp::ZERO,
        at: StampedAt::StartOfExposure,
        arrival: Stamp::ZERO,
        exposure_set_ns: 1,
        gain_db: 0.0,
    };
    let frame = Frame::data(Id::standard(1).unwrap(), &[]).unwrap();
    for error in [
        writer.events_header(b"% end\n").unwrap_err(),
        writer.event_transfer(&[], Stamp::ZERO).unwrap_err(),
        writer.datagram(&[], Stamp::ZERO).unwrap_err(),
        writer.image(stamp, 6, 4, &[0; 72]).unwrap_err(),
        writer.can(frame, Stamp::ZERO).unwrap_err(),
        writer.lidar_angles(b"").unwrap_err(),
    ] {
        assert!(matches!(error, WriteError::Undeclared(_)), "{error}");
    }
    let mut writer = RecordingWriter::create(&dir.path().join("b"), meta(), &rig).unwrap();
    let early = writer.event_transfer(&[], Stamp::ZERO).unwrap_err();
    assert_eq!(
        early.to_string(),
        "events header: must be written before the first transfer"
    );
    let none = writer.events_header(b"no header").unwrap_err();
    assert!(none.to_string().contains("no raw header"), "{none}");
    let header = delivered().header;
    let more = writer
        .events_header(&[&header[..], &[1, 2]].concat())
        .unwrap_err();
    assert_eq!(more.to_string(), "events header: 2 bytes follow it");
    writer.events_header(&header).unwrap();
    let twice = writer.events_header(&header).unwrap_err();
    assert_eq!(twice.to_string(), "events header: was written already");
    let size = writer.image(stamp, 4, 6, &[0; 72]).unwrap_err();
    assert!(matches!(
        size,
        WriteError::Size {
            width: 4,
            height: 6,
            ..
        }
    ));
    let short = writer.image(stamp, 6, 4, &[0; 71]).unwrap_err();
    assert!(matches!(
        short,
        WriteError::Size {
            needed: 72,
            actual: 71,
            ..
        }
    ));
    assert!(writer.datagram(&[0; 70_000], Stamp::ZERO).is_err());

    let truth = TruthWriter::create(dir.path(), 2).unwrap();
    let sample = truth.sample(0).unwrap();
    for step in [0, 3] {
        let error = sample.gt(step, 1, 1, &[1.0]).unwrap_err();
        assert!(matches!(error, WriteError::Step { steps: 2, .. }));
    }
    assert!(matches!(
        sample.flow(1, 2, 2, &[0.0; 7]),
        Err(WriteError::Size { needed: 8, .. })
    ));
    assert!(matches!(
        sample.thin(1, 0, 0, &[]),
        Err(WriteError::Size { .. })
    ));
}

#[test]
fn a_description_that_cannot_be_is_not_written() {
    let dir = tempfile::tempdir().unwrap();
    let mut bad = meta();
    bad.steps = 65;
    let rig = Calibration::default_rig();
    let error = RecordingWriter::create(dir.path(), bad, &rig).unwrap_err();
    assert_eq!(error.to_string(), "meta: steps = 65: not in 1..=64");
    let mut bent = rig;
    bent.camera_from_lidar.rotation[0][0] += 1e-3;
    let error = RecordingWriter::create(dir.path(), meta(), &bent).unwrap_err();
    let text = error.to_string();
    assert!(
        text.starts_with("calibration: camera_from_lidar.rotation = "),
        "{text}"
    );
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0);
}

/// A header may promise more than the file holds; nothing is allocated for it.
#[test]
fn a_flow_file_that_promises_too_much_is_refused() {
    let dir = recorded();
    let truth = TruthWriter::create(dir.path(), 1).unwrap();
    truth.sample(0).unwrap();
    let path = dir.path().join("derived/000000/flow/1.npy");
    let header = "{'descr': '<f4', 'fortran_order': False, 'shape': (2, 4000000, 4000000), }";
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((u16::try_from(header.len()).unwrap() + 1).to_le_bytes());
    bytes.extend(header.bytes());
    bytes.push(b'\n');
    std::io::Write::write_all(&mut File::create(path).unwrap(), &bytes).unwrap();
    let sample = Recording::open(dir.path())
        .unwrap()
        .sample_truth(0)
        .unwrap();
    let text = sample.flow(1).unwrap_err().to_string();
    assert!(text.contains("bytes hold no 4000000x4000000"), "{text}");
}

//! Whatever is written to a recording is read back, bit for bit, and the same calls give the same
//! files.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod made_up;

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use made_up::{Delivered, TRANSFERS, delivered, meta, write};
use noctule_recording::{
    Calibration, ClockTruth, Counts, EdgeTruth, ExposureTruth, Faults, Missing, Recording,
    RecordingWriter, TruthClocks, TruthWriter,
};
use noctule_sensor::{Evk4, Stamp};

#[test]
fn every_stream_comes_back_bit_for_bit() {
    let dir = tempfile::tempdir().unwrap();
    let given = delivered();
    let counts = write(dir.path(), &given);
    let recording = Recording::open(dir.path()).unwrap();
    assert_eq!(recording.meta(), &meta());
    assert_eq!(recording.calibration(), Some(&made_up::calibration()));
    assert_eq!(recording.counts(), Some(&counts));
    assert_eq!(
        counts,
        Counts {
            event_transfers: TRANSFERS as u64,
            event_bytes: given.transfers.iter().map(|t| t.0.len() as u64).sum(),
            event_transfer_len_max: given
                .transfers
                .iter()
                .map(|t| t.0.len() as u64)
                .max()
                .unwrap(),
            datagrams: given.datagrams.len() as u64,
            images: given.images.len() as u64,
            can_frames: given.can.len() as u64,
            clock_readings: given.clocks.len() as u64,
        }
    );
    assert_eq!(read_all(&recording), given);
    assert_eq!(recording.lidar_angles().unwrap().unwrap(), made_up::ANGLES);
    let missing = [
        Missing::TruthExposures,
        Missing::TruthClocks,
        Missing::Samples,
    ];
    assert_eq!(recording.missing(), missing);
}

fn read_all(recording: &Recording) -> Delivered {
    let mut transfers = Vec::new();
    let mut stream = recording.event_transfers().unwrap();
    let header = stream.header_bytes().to_vec();
    let mut offset = header.len() as u64;
    while let Some(transfer) = stream.next_transfer().unwrap() {
        assert_eq!(transfer.offset, offset);
        offset += transfer.bytes.len() as u64;
        transfers.push((transfer.bytes.to_vec(), transfer.arrival));
    }
    assert_eq!(stream.faults(), Faults::default());

    let mut datagrams = Vec::new();
    let mut capture = recording.datagrams().unwrap();
    while let Some(datagram) = capture.next_datagram().unwrap() {
        datagrams.push((datagram.payload.to_vec(), datagram.t));
    }
    assert!(capture.faults().is_clean());

    let mut pixels = Vec::new();
    let mut rows = recording.images().unwrap();
    let images = rows.by_ref().enumerate().map(|(index, row)| {
        let row = row.unwrap();
        assert_eq!(row.index as usize, index);
        assert_eq!(
            recording.read_image(row.index, &mut pixels).unwrap(),
            (6, 4)
        );
        (row.stamp, pixels.clone())
    });
    let images = images.collect();
    assert!(rows.faults().is_clean());

    let mut frames = recording.can_frames().unwrap();
    let can = frames.by_ref().map(|record| {
        let record = record.unwrap();
        assert_eq!(record.interface.as_str(), "can0");
        (record.frame, record.arrival)
    });
    let can = can.collect();
    assert!(frames.faults().is_clean());

    let mut readings = recording.clock_readings().unwrap();
    let clocks = readings.by_ref().map(Result::unwrap).collect();
    assert!(readings.faults().is_clean());
    Delivered {
        header,
        transfers,
        datagrams,
        images,
        can,
        clocks,
    }
}

#[test]
fn the_same_calls_give_the_same_bytes_in_every_file() {
    let dirs = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let [first, second] = dirs.each_ref().map(|dir| {
        write(dir.path(), &delivered());
        write_truth(dir.path());
        let mut files = BTreeMap::new();
        collect(dir.path(), dir.path(), &mut files);
        files
    });
    assert!(first.len() > 20);
    assert_eq!(first, second);
}

fn collect(root: &Path, dir: &Path, files: &mut BTreeMap<String, Vec<u8>>) {
    for entry in fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            collect(root, &path, files);
        } else {
            let name = path.strip_prefix(root).unwrap().display().to_string();
            files.insert(name, fs::read(&path).unwrap());
        }
    }
}

const WIDTH: usize = 5;
const HEIGHT: usize = 3;
const PIXELS: usize = WIDTH * HEIGHT;

fn exposure(index: u32) -> ExposureTruth {
    ExposureTruth {
        index,
        open_tai: Stamp::from_nanos(1_700_000_037_000_000_001),
        close_tai: Stamp::from_nanos(1_700_000_037_150_000_002),
        open_evk4: Stamp::from_nanos(1_000_000_003),
        close_evk4: Stamp::from_nanos(1_150_000_004),
        image_sequence: (index != 1).then_some(u32::MAX),
        image_dropped: index == 2,
        open_edge: [EdgeTruth::Once, EdgeTruth::Missed, EdgeTruth::Doubled][index as usize],
        close_edge: EdgeTruth::Doubled,
    }
}

fn clocks() -> TruthClocks {
    let clock = |rate_ppb| ClockTruth {
        clock_ns: 1_000_000_000,
        tai_ns: 1_700_000_037_123_456_789,
        rate_ppb,
    };
    TruthClocks {
        evk4: clock(-50_000),
        lidar: clock(50_000),
        monotonic: clock(3),
        realtime: clock(0),
        phc: Some(clock(-1)),
    }
}

fn depth() -> Vec<f32> {
    (0..PIXELS).map(|k| k as f32 * 5.25).collect()
}

fn flow() -> Vec<f32> {
    (0..2 * PIXELS).map(|k| k as f32 * -0.1).collect()
}

fn mask() -> Vec<bool> {
    (0..PIXELS).map(|k| k % 3 == 0).collect()
}

fn rgb() -> Vec<u8> {
    (0..=255).cycle().take(3 * PIXELS).collect()
}

fn write_truth(dir: &Path) {
    let mut truth = TruthWriter::create(dir, 2).unwrap();
    truth.clocks(&clocks()).unwrap();
    for index in 0..3 {
        truth.exposure(&exposure(index)).unwrap();
    }
    let sample = truth.sample(7).unwrap();
    sample.blur(WIDTH, HEIGHT, &rgb()).unwrap();
    for step in 1..=2 {
        sample.sharp(step, WIDTH, HEIGHT, &rgb()).unwrap();
        sample.sparse(step, WIDTH, HEIGHT, &depth()).unwrap();
        sample.gt(step, WIDTH, HEIGHT, &depth()).unwrap();
        sample.mover(step, WIDTH, HEIGHT, &mask()).unwrap();
        sample.thin(step, WIDTH, HEIGHT, &mask()).unwrap();
        sample.flow(step, WIDTH, HEIGHT, &flow()).unwrap();
    }
    truth.finish().unwrap();
}

#[test]
fn truth_comes_back_exactly() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), &delivered());
    write_truth(dir.path());
    let recording = Recording::open(dir.path()).unwrap();
    assert_eq!(recording.missing(), []);
    assert_eq!(recording.truth_clocks().unwrap(), clocks());
    let exposures: Vec<_> = recording
        .exposures_truth()
        .unwrap()
        .map(Result::unwrap)
        .collect();
    assert_eq!(exposures, [exposure(0), exposure(1), exposure(2)]);
    assert_eq!(recording.samples().unwrap(), [7]);
    let sample = recording.sample_truth(7).unwrap();
    for step in 1..=2 {
        // Multiples of a quarter metre are exact in 1/256 m.
        assert_eq!(sample.gt(step).unwrap().data, depth());
        assert_eq!(sample.sparse(step).unwrap().data, depth());
        assert_eq!(sample.sharp(step).unwrap().data, rgb());
        assert_eq!(sample.mover(step).unwrap().data, mask());
        assert_eq!(sample.thin(step).unwrap().data, mask());
        let read = sample.flow(step).unwrap();
        assert_eq!(
            (read.width, read.height, read.data),
            (WIDTH, HEIGHT, flow())
        );
    }
    let blur = sample.blur().unwrap();
    assert_eq!((blur.width, blur.height, blur.data), (WIDTH, HEIGHT, rgb()));
}

#[test]
fn true_clocks_map_as_the_contract_says() {
    let map = clocks().evk4.to_map::<Evk4>();
    // Two seconds on a counter 50 ppm fast are 100 us short of two true seconds.
    let t = map.apply(Stamp::from_nanos(3_000_000_000));
    assert_eq!(t.as_nanos(), 1_700_000_039_123_356_789);
}

#[test]
fn the_shipped_calibration_loads_from_its_file() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/calibration/default.toml");
    assert_eq!(
        Calibration::load(&path).unwrap(),
        Calibration::default_rig()
    );
}

#[test]
fn any_sensor_may_be_absent() {
    let dir = tempfile::tempdir().unwrap();
    let mut meta = meta();
    (meta.events, meta.camera, meta.lidar, meta.can) = (None, None, None, None);
    let writer = RecordingWriter::create(dir.path(), meta, &Calibration::default_rig()).unwrap();
    writer.finish().unwrap();
    let recording = Recording::open(dir.path()).unwrap();
    let missing = [
        Missing::Events,
        Missing::Images,
        Missing::Lidar,
        Missing::Can,
        Missing::TruthExposures,
        Missing::TruthClocks,
        Missing::Samples,
    ];
    assert_eq!(recording.missing(), missing);
    assert_eq!(recording.clock_readings().unwrap().count(), 0);
    for text in [
        recording.event_transfers().unwrap_err().to_string(),
        recording.images().unwrap_err().to_string(),
        recording.datagrams().unwrap_err().to_string(),
        recording.can_frames().unwrap_err().to_string(),
        recording.truth_clocks().unwrap_err().to_string(),
    ] {
        assert!(text.contains("the recording has no "), "{text}");
    }
}

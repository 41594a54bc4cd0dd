//! A short drive with small images, recorded and read back through the drivers.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "pixel indices of small images"
)]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use noctule_can::{MotionConfig, MotionDecoder};
use noctule_hesai::{Model, Packet};
use noctule_recording::{EdgeTruth, Recording};
use noctule_sensor::{Event, Stamp, TriggerEdge};
use noctule_world::{
    DriveOptions, DriveSummary, Faults, Optics, Rig, Scene, Tier, Timeline, WorldError,
    record_drive,
};
use sha2::{Digest, Sha256};

const SIZE: usize = 64;

fn options(seed: u64, tier: Tier, seconds: f64, faults: Faults) -> DriveOptions {
    DriveOptions {
        seed,
        tier,
        duration: Duration::from_secs_f64(seconds),
        rig: Rig::with_size(seed, tier, SIZE),
        faults,
    }
}

fn record(options: &DriveOptions, dir: &Path) -> DriveSummary {
    record_drive(options, dir, |_| {}).expect("a small drive can be recorded")
}

/// Hash of every file below `dir`, by relative path.
fn hashes(dir: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut all = BTreeMap::new();
    let mut folders = vec![dir.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).expect("folder is there") {
            let path = entry.expect("entry is there").path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let hash = Sha256::digest(fs::read(&path).expect("file is there")).to_vec();
                all.insert(path.strip_prefix(dir).expect("below").to_owned(), hash);
            }
        }
    }
    all
}

#[test]
fn every_file_is_the_same_with_one_thread_and_with_three() {
    let options = options(7, Tier::B, 0.7, Faults::rough());
    let with = |threads| {
        let dir = tempfile::tempdir().expect("temporary folder");
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .expect("threads start");
        let summary = pool.install(|| record(&options, dir.path()));
        (summary, hashes(dir.path()))
    };
    let (one, three) = (with(1), with(3));
    assert!(
        one.0.exposures >= 2 && one.1.len() > 80,
        "{:?} {}",
        one.0,
        one.1.len()
    );
    assert_eq!(one, three);
    let other = tempfile::tempdir().expect("temporary folder");
    record(&DriveOptions { seed: 8, ..options }, other.path());
    assert_ne!(
        hashes(other.path())[Path::new("raw/events.raw")],
        one.1[Path::new("raw/events.raw")]
    );
}

/// Everything of a recording, decoded.
struct Decoded {
    events: Vec<Event>,
    edges: Vec<TriggerEdge>,
    recording: Recording,
}

fn decode(dir: &Path) -> Decoded {
    let recording = Recording::open(dir).expect("a recording");
    let mut transfers = recording.event_transfers().expect("events");
    let header = transfers.header().clone();
    let mut decoder = noctule_evk4::Decoder::new(header.format, header.geometry);
    let (mut events, mut edges) = (Sink::default(), Vec::new());
    while let Some(transfer) = transfers.next_transfer().expect("a transfer") {
        decoder.decode(transfer.bytes, &mut events);
    }
    edges.append(&mut events.edges);
    assert!(decoder.errors().is_clean(), "{:?}", decoder.errors());
    Decoded {
        events: events.events,
        edges,
        recording,
    }
}

#[derive(Default)]
struct Sink {
    events: Vec<Event>,
    edges: Vec<TriggerEdge>,
}

impl noctule_evk4::EventSink for Sink {
    fn event(&mut self, event: Event) {
        self.events.push(event);
    }

    fn trigger(&mut self, edge: TriggerEdge) {
        self.edges.push(edge);
    }
}

#[test]
fn what_was_recorded_reads_back_and_agrees_with_the_timeline() {
    let options = options(11, Tier::A, 1.5, Faults::rough());
    let dir = tempfile::tempdir().expect("temporary folder");
    let summary = record(&options, dir.path());
    let timeline = Timeline::simulate(&options.rig, &options.faults, 11, 1.5);
    let decoded = decode(dir.path());

    assert_eq!(decoded.events.len() as u64, summary.events);
    assert!(decoded.events.is_sorted_by_key(|e| e.t));
    let low = (640 - SIZE as u16 / 2, 360 - SIZE as u16 / 2);
    let inside = |e: &Event| {
        (low.0..low.0 + SIZE as u16).contains(&e.x) && (low.1..low.1 + SIZE as u16).contains(&e.y)
    };
    assert!(decoded.events.iter().all(inside));
    assert_eq!(decoded.edges, timeline.edges);
    assert!(
        decoded.recording.missing().is_empty(),
        "{:?}",
        decoded.recording.missing()
    );

    let truths: Vec<_> = decoded
        .recording
        .exposures_truth()
        .expect("truth")
        .map(|row| row.expect("a row"))
        .collect();
    assert_eq!(truths.len(), timeline.exposures.len());
    for (truth, timed) in truths.iter().zip(&timeline.exposures) {
        assert_eq!(*truth, timed.truth);
        if truth.open_edge == EdgeTruth::Once {
            let at = Stamp::from_micros(truth.open_evk4.as_micros());
            assert!(decoded.edges.contains(&TriggerEdge {
                t: at,
                channel: 0,
                rising: true
            }));
        }
        assert_eq!(truth.close_tai.diff_nanos(truth.open_tai), 60_000_000);
    }

    let mut datagrams = decoded.recording.datagrams().expect("datagrams");
    for timed in &timeline.packets {
        let datagram = datagrams
            .next_datagram()
            .expect("readable")
            .expect("as many as sent");
        let packet = Packet::new(Model::Qt64, datagram.payload).expect("a QT64 packet");
        assert_eq!(packet.sequence(), Some(timed.index as u32));
        assert_eq!(packet.time_ns(), timed.start.as_nanos());
        assert_eq!(datagram.t, timed.arrival);
    }
    assert!(datagrams.next_datagram().expect("readable").is_none());

    let images: Vec<_> = decoded
        .recording
        .images()
        .expect("images")
        .map(|row| row.expect("a row"))
        .collect();
    assert_eq!(images.len(), timeline.images.len());
    for (row, timed) in images.iter().zip(&timeline.images) {
        assert_eq!(
            (row.stamp.sequence, row.stamp.driver),
            (timed.stamp.sequence, timed.stamp.driver)
        );
    }
}

#[test]
fn the_bus_tells_how_the_vehicle_moves() {
    let options = options(5, Tier::B, 0.5, Faults::default());
    let dir = tempfile::tempdir().expect("temporary folder");
    record(&options, dir.path());
    let scene = Scene::new(5, 0.5, true);
    let recording = Recording::open(dir.path()).expect("a recording");
    let mut decoder = MotionDecoder::new(&MotionConfig::default()).expect("default signals");
    let start = options
        .rig
        .clocks
        .realtime
        .inverse()
        .apply(noctule_world::DRIVE_START_TAI);
    let mut count = 0;
    for record in recording.can_frames().expect("frames") {
        let record = record.expect("a frame");
        if let Some(motion) = decoder.push(&record.frame, record.arrival) {
            let (speed, yaw_rate) = scene.ego_motion(motion.t.diff_nanos(start) as f64 * 1e-9);
            assert!((f64::from(motion.speed_mps) - speed).abs() < 0.12);
            assert!((f64::from(motion.yaw_rate_rps) - yaw_rate).abs() < 0.015);
            count += 1;
        }
    }
    assert!(count >= 49, "{count}");
}

#[test]
fn truth_pictures_fit_the_scene() {
    let options = options(3, Tier::B, 0.8, Faults::default());
    let dir = tempfile::tempdir().expect("temporary folder");
    let summary = record(&options, dir.path());
    let recording = Recording::open(dir.path()).expect("a recording");
    assert_eq!(
        recording.samples().expect("samples").len() as u64,
        summary.exposures
    );
    let truth = recording.sample_truth(1).expect("a sample");
    let opening = options.rig.shutter.opening(1);
    let (scene, optics) = (Scene::new(3, 0.8, true), Optics::new(SIZE / 2));
    for k in 0..8 {
        let gt = truth.gt(k + 1).expect("depth");
        let snapshot = noctule_world::Snapshot::new(
            &scene,
            opening.step_centre(k as usize),
            noctule_world::Horizon::CAMERA,
        );
        let off = gt.data.iter().enumerate().filter(|&(i, &depth)| {
            let (x, y) = ((i % (SIZE / 2)) as f32, (i / (SIZE / 2)) as f32);
            let ray = [optics.slope(x), optics.slope(y), 1.0];
            let exact = snapshot
                .cast([0.0; 3], ray, 0.2)
                .map_or(0.0, |(depth, _)| depth);
            // PNG16 holds up to 256 m in steps of 1/256 m.
            exact < 255.0 && (exact - depth).abs() > 1.0 / 256.0 + 1e-4 * exact
        });
        assert_eq!(off.count(), 0, "step {k}");
        let sparse = truth.sparse(k + 1).expect("sparse depth");
        let drawn = sparse.data.iter().filter(|&&d| d > 0.0).count();
        assert!(drawn > 100, "{drawn} returns in step {k}");
    }
    let blur = truth.blur().expect("blur");
    assert_eq!((blur.width, blur.height), (SIZE / 2, SIZE / 2));
    assert!(truth.flow(7).is_ok());
}

#[test]
fn long_exposures_and_a_standing_vehicle_can_be_recorded() {
    for (tier, seconds, exposures) in [(Tier::C, 2.0, 1), (Tier::S, 0.6, 2)] {
        let options = options(4, tier, seconds, Faults::default());
        let dir = tempfile::tempdir().expect("temporary folder");
        let mut last = 0.0;
        let summary = record_drive(&options, dir.path(), |progress| {
            assert!(progress.rendered_s >= last && progress.rendered_s <= progress.total_s);
            last = progress.rendered_s;
        });
        let summary = summary.expect("a small drive can be recorded");
        assert!(summary.exposures >= exposures, "tier {tier:?}: {summary:?}");
        assert!((last - seconds).abs() < 1e-9);
        let recording = Recording::open(dir.path()).expect("a recording");
        for index in recording.samples().expect("samples") {
            let truth = recording.sample_truth(index).expect("a sample");
            for step in 1..=8 {
                let sparse = truth.sparse(step).expect("sparse depth");
                let drawn = sparse.data.iter().filter(|&&d| d > 0.0).count();
                // Before the first turn is over there is no pass to show.
                let turned = options.rig.shutter.opening(u64::from(index)).open_ns > 150_000_000;
                assert!(
                    drawn > 100 || !turned,
                    "tier {tier:?}, sample {index}, step {step}: {drawn}"
                );
            }
        }
    }
}

#[test]
fn nonsense_is_refused_before_anything_is_written() {
    let dir = tempfile::tempdir().expect("temporary folder");
    let target = dir.path().join("recording");
    let refuse = |options: DriveOptions| {
        let error = record_drive(&options, &target, |_| {}).expect_err("refused");
        assert!(!target.exists());
        error
    };
    let good = options(1, Tier::B, 1.0, Faults::default());
    let short = DriveOptions {
        duration: Duration::from_millis(20),
        ..good.clone()
    };
    assert!(matches!(refuse(short), WorldError::Duration(_)));
    let faults = Faults {
        packet_lost: 1.5,
        ..Faults::default()
    };
    let error = refuse(DriveOptions {
        faults,
        ..good.clone()
    });
    assert_eq!(
        error.to_string(),
        "fault packet_lost has probability 1.5, must be 0 to 1"
    );
    let mut rig = good.rig.clone();
    rig.size = 100;
    let error = refuse(DriveOptions { rig, ..good });
    assert_eq!(
        error.to_string(),
        "rig: size is 100, must be a multiple of 32 up to 704"
    );
}

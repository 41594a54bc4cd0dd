//! Recordings through host and inference process: the same bytes out however time treats them,
//! whatever is missing, and no wrong exposure ever.
#![allow(clippy::unwrap_used, reason = "a test may stop where it stands")]

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use std::{fs, thread};

use noctule::config::{Config, Grid};
use noctule::digest::FrameDigest;
use noctule::frame::{ModelId, flag};
use noctule::ingest::Pace;
use noctule::replay::{HostOptions, Prepared, ReplayError, RunReport, Session, SessionOptions};
use noctule_recording::{EdgeTruth, ExposureTruth, Recording};
use serde_json::json;

mod recordings;
use recordings::{
    GRID, clean, copy_of, cut, drop_datagram, edit_meta, flip_event_bit, lone_file, rough, without,
};

/// How a recording is run.
#[derive(Clone, Copy)]
struct How {
    pace: Pace,
    piece_bytes: Option<usize>,
    lossless: bool,
}

const LOSSLESS: How = How {
    pace: Pace::Max,
    piece_bytes: None,
    lossless: true,
};

fn config(name: &str) -> Config {
    let instance = format!("t-{name}-{}", std::process::id());
    Config {
        instance,
        grid: Grid {
            width: GRID,
            height: GRID,
            ..Grid::default()
        },
        ..Config::default()
    }
}

fn run(recording: &Path, name: &str, how: How) -> Result<Session, ReplayError> {
    run_as(ModelId::Fill, recording, name, how)
}

fn run_as(model: ModelId, recording: &Path, name: &str, how: How) -> Result<Session, ReplayError> {
    noctule::bus::silence_transport_log();
    let config = config(name);
    let prepared = Prepared::open(recording, &config)?;
    let folder = tempfile::tempdir().unwrap();
    let config_path = folder.path().join("noctule.toml");
    fs::write(
        &config_path,
        format!("[grid]\nwidth = {GRID}\nheight = {GRID}\n"),
    )
    .unwrap();
    let options = SessionOptions {
        host: HostOptions {
            pace: how.pace,
            piece_bytes: how.piece_bytes,
        },
        lossless: how.lossless,
        model: Some(model),
        config_path: Some(config_path),
        program: env!("CARGO_BIN_EXE_noctule").into(),
        keep: 64,
    };
    let session = Session::run(&prepared, &config, &options, &Arc::default(), &|_, _| {})?;
    assert_eq!(session.report.residue, 0, "{name}");
    assert_eq!(session.report.infer_restarts, 0, "{name}");
    Ok(session)
}

/// A lossless run in which everything that was sent came out.
fn run_whole(recording: &Path, name: &str, how: How) -> RunReport {
    let report = run(recording, name, how).unwrap().report;
    let sent = report.host.bundles.sent;
    assert!(sent > 0, "{name}: no bundle");
    assert_eq!(report.infer.frames_sent, 8 * sent, "{name}");
    assert_eq!(report.frames.len() as u64, 9 * sent, "{name}");
    report
}

/// Keeps the processors busy, in bursts that no two runs share, while `body` runs.
fn under_load<T>(body: impl FnOnce() -> T) -> T {
    let over = AtomicBool::new(false);
    thread::scope(|scope| {
        for burner in 1..=6_u64 {
            let over = &over;
            scope.spawn(move || {
                let mut state = burner.wrapping_mul(0x9e37_79b9_7f4a_7c15);
                while !over.load(Ordering::Relaxed) {
                    for _ in 0..state % 3_000_000 {
                        state = state
                            .wrapping_mul(0x5851_f42d_4c95_7f2d)
                            .wrapping_add(burner);
                        std::hint::spin_loop();
                    }
                    thread::sleep(Duration::from_micros(state >> 54));
                }
            });
        }
        let result = body();
        over.store(true, Ordering::Relaxed);
        result
    })
}

#[test]
fn one_digest_at_any_pace_chunking_and_scheduling() {
    let how = |pace, piece_bytes| How {
        pace,
        piece_bytes,
        lossless: true,
    };
    let plain = run_whole(rough(), "plain", LOSSLESS);
    // A drive without faults would leave the interesting paths out.
    let missed = |truth: &ExposureTruth| truth.close_edge == EdgeTruth::Missed;
    assert!(exposures(rough()).iter().any(missed) && plain.host.streams[1].lost > 0);
    let runs = [
        ("pace", how(Pace::Speed(3.0), None)),
        ("odd", how(Pace::Max, Some(1021))),
        ("page", how(Pace::Max, Some(4096))),
    ];
    for (name, how) in runs {
        let run = run_whole(rough(), name, how);
        assert_eq!(run.frames, plain.frames, "{name}");
        assert_eq!(run.digest, plain.digest, "{name}");
    }
    for (name, how) in [
        ("busy", LOSSLESS),
        ("busy-odd", how(Pace::Speed(6.0), Some(1021))),
    ] {
        let run = under_load(|| run_whole(rough(), name, how));
        assert_eq!(run.digest, plain.digest, "{name}");
    }
}

#[test]
fn one_bit_or_one_datagram_gives_another_digest() {
    let plain = run_whole(rough(), "whole", LOSSLESS);
    let truth = exposures(rough());
    // Half-way through the third exposure, on the host's UTC clock.
    let utc_ns = truth[2].open_tai.as_nanos() + 80_000_000 - 37_000_000_000;
    let changed = |run: &RunReport| -> Vec<u64> {
        let differ = |(a, b): &(&FrameDigest, &FrameDigest)| a.step.is_none() && a != b;
        plain
            .frames
            .iter()
            .zip(&run.frames)
            .filter(differ)
            .map(|(a, _)| a.sequence)
            .collect()
    };

    let flipped = copy_of(rough());
    flip_event_bit(flipped.path(), utc_ns);
    let run = run_whole(flipped.path(), "flipped", LOSSLESS);
    assert_ne!(run.digest, plain.digest);
    assert!(!changed(&run).is_empty());

    let dropped = copy_of(rough());
    drop_datagram(dropped.path(), 1500);
    let run = run_whole(dropped.path(), "dropped", LOSSLESS);
    assert_ne!(run.digest, plain.digest);
    assert!(!changed(&run).is_empty());
    let lost = |report: &RunReport| report.host.streams[1].lost;
    assert!(lost(&run) > lost(&plain));
}

#[test]
fn what_two_runs_both_emit_is_identical_when_frames_may_drop() {
    let how = |pace| How {
        pace,
        piece_bytes: None,
        lossless: false,
    };
    let realtime = run(rough(), "live", how(Pace::REALTIME)).unwrap().report;
    let busy = under_load(|| {
        run(rough(), "live-busy", how(Pace::REALTIME))
            .unwrap()
            .report
    });
    let flooded = run(rough(), "live-flood", how(Pace::Max)).unwrap().report;
    let reference = run_whole(rough(), "live-ref", LOSSLESS);
    let by_key = |report: &RunReport| -> BTreeMap<_, _> {
        report
            .frames
            .iter()
            .map(|f| ((f.sequence, f.step, f.model), f.sha256.clone()))
            .collect()
    };
    let reference = by_key(&reference);
    for (name, report) in [("realtime", realtime), ("busy", busy), ("flooded", flooded)] {
        let frames = by_key(&report);
        let shared = frames
            .iter()
            .filter(|(key, _)| reference.contains_key(*key))
            .count();
        assert!(shared > 0, "{name}: nothing in common of {}", frames.len());
        for (key, sha256) in &frames {
            if let Some(expected) = reference.get(key) {
                assert_eq!(sha256, expected, "{name}: {key:?}");
            }
        }
    }
}

/// Flags that all bundles of a run carry.
fn common_flags(session: &Session) -> u32 {
    assert!(!session.observed.kept.is_empty());
    session
        .observed
        .kept
        .values()
        .fold(u32::MAX, |all, kept| all & kept.header.flags)
}

/// Flags that any bundle of a run carries.
fn any_flags(session: &Session) -> u32 {
    session
        .observed
        .kept
        .values()
        .fold(0, |any, kept| any | kept.header.flags)
}

#[test]
fn a_sensor_that_is_not_there_is_flagged_and_never_waited_for() {
    let all = run(rough(), "all", LOSSLESS).unwrap();
    assert_eq!(common_flags(&all), 0);
    for (sensor, flags) in [
        ("camera", flag::NO_IMAGE),
        ("can", flag::NO_MOTION),
        ("lidar", flag::NO_LIDAR),
        ("events", flag::NO_EVENTS | flag::VIRTUAL),
    ] {
        let copy = without(rough(), sensor);
        let session = run(copy.path(), sensor, LOSSLESS).unwrap();
        let names = flag::names(common_flags(&session));
        assert_eq!(
            common_flags(&session) & flags,
            flags,
            "without {sensor}: {names:?}"
        );
        assert!(!session.report.missing.is_empty(), "without {sensor}");
        if sensor != "events" {
            assert_eq!(
                session.report.host.bundles.exposures,
                all.report.host.bundles.exposures
            );
            assert_eq!(any_flags(&session) & flag::VIRTUAL, 0);
        }
    }
}

#[test]
fn lone_files_run_on_made_up_exposures() {
    for (name, real, rendered, flags) in [
        ("pcap", "hesai/qt64.pcap", "raw/lidar.pcap", flag::NO_EVENTS),
        (
            "raw",
            "events/hd720_trigger2.raw",
            "raw/events.raw",
            flag::NO_LIDAR,
        ),
    ] {
        let (path, _folder) = lone_file(real, rendered);
        let session = run(&path, name, LOSSLESS).unwrap();
        let flags = flags | flag::NO_IMAGE | flag::VIRTUAL;
        let common = common_flags(&session);
        assert_eq!(common & flags, flags, "{name}: {:?}", flag::names(common));
        let header = |f: fn(&noctule::observe::Kept) -> u64| -> u64 {
            session.observed.kept.values().map(f).sum()
        };
        let (events, returns) = (
            header(|k| k.header.events),
            header(|k| k.header.returns.into()),
        );
        assert_eq!(
            (events > 0, returns > 0),
            (name == "raw", name == "pcap"),
            "{name}"
        );
        assert!(
            session.report.missing.iter().any(|m| m == "calibration"),
            "{name}"
        );
    }
}

#[test]
fn recordings_that_cannot_be_understood_are_refused_by_name() {
    let refused = |path: &Path| match Prepared::open(path, &config("refused")) {
        Err(error) => error.to_string(),
        Ok(_) => panic!("{} was accepted", path.display()),
    };
    let no_meta = copy_of(rough());
    fs::remove_file(no_meta.path().join("meta.json")).unwrap();
    let other = copy_of(rough());
    edit_meta(other.path(), |meta| meta["schema"] = json!(99));
    let mixed = copy_of(rough());
    fs::copy(rough().join("raw/can.log"), mixed.path().join("calib.toml")).unwrap();
    let headless = copy_of(rough());
    fs::write(
        headless.path().join("raw/lidar.pcap"),
        b"not a capture at all",
    )
    .unwrap();
    let nothing = copy_of(rough());
    edit_meta(nothing.path(), |meta| {
        for sensor in ["events", "lidar"] {
            meta["recording"].as_object_mut().unwrap().remove(sensor);
        }
    });
    for (copy, words) in [
        (&no_meta, "meta.json"),
        (&other, "99"),
        (&mixed, "calib.toml"),
        (&headless, "lidar.pcap"),
        (&nothing, "neither an event camera nor a LiDAR"),
    ] {
        let error = refused(copy.path());
        assert!(error.contains(words), "{error}");
    }
    let absent = Path::new("/no/such/recording");
    assert!(refused(absent).contains("/no/such/recording"));
}

#[test]
fn what_was_cut_off_is_counted_and_the_rest_is_run() {
    let whole = run(rough(), "uncut", LOSSLESS).unwrap();
    let detail = |session: &Session, stream: &str, name: &str| {
        session.report.host.details[stream]
            .get(name)
            .copied()
            .unwrap_or(0)
    };
    let stream = |session: &Session, name: &str| {
        session
            .report
            .host
            .streams
            .iter()
            .find(|row| row.stream == name)
            .unwrap()
            .clone()
    };

    let copy = copy_of(rough());
    cut(&copy.path().join("raw/events.raw"), |len| len * 2 / 3 + 1);
    let cut_events = run(copy.path(), "cut-raw", LOSSLESS).unwrap();
    let (absent, bytes) = (
        detail(&cut_events, "events", "absent_rows"),
        detail(&cut_events, "events", "truncated_bytes"),
    );
    assert!(absent > 0 && bytes > 0, "{absent} transfers, {bytes} bytes");
    let (few, all) = (
        stream(&cut_events, "events").received,
        stream(&whole, "events").received,
    );
    assert!((1..all).contains(&few));

    let copy = copy_of(rough());
    cut(&copy.path().join("raw/lidar.pcap"), |len| len * 2 / 3);
    let cut_lidar = run(copy.path(), "cut-pcap", LOSSLESS).unwrap();
    assert_eq!(detail(&cut_lidar, "lidar", "truncated_rows"), 1);
    let (few, all) = (stream(&cut_lidar, "lidar"), stream(&whole, "lidar"));
    assert!(
        few.received < all.received && few.lost > all.lost,
        "{few:?} of {all:?}"
    );
    assert_eq!(
        cut_lidar.report.host.bundles.exposures,
        whole.report.host.bundles.exposures
    );

    let copy = copy_of(rough());
    cut(&copy.path().join("raw/rgb/000001.png"), |len| len / 2);
    let cut_image = run(copy.path(), "cut-png", LOSSLESS).unwrap();
    assert_eq!(stream(&cut_image, "images").rejected, 1);
    let without_image = |session: &Session| {
        session
            .observed
            .kept
            .values()
            .filter(|k| k.header.flags & flag::NO_IMAGE != 0)
            .count()
    };
    assert_eq!(without_image(&cut_image), without_image(&whole) + 1);
    assert_eq!(
        cut_image.report.host.bundles.sent,
        whole.report.host.bundles.sent
    );
}

fn exposures(drive: &Path) -> Vec<ExposureTruth> {
    let recording = Recording::open(drive).unwrap();
    recording
        .exposures_truth()
        .unwrap()
        .map(Result::unwrap)
        .collect()
}

#[test]
fn every_image_is_on_the_exposure_that_truth_says() {
    let session = run(clean(), "truth", LOSSLESS).unwrap();
    let truths = exposures(clean());
    assert!(truths.len() >= 4, "{} exposures", truths.len());
    for truth in &truths {
        let mut headers = session
            .observed
            .kept
            .values()
            .map(|kept| &kept.header)
            .filter(|header| {
                let middle = u64::midpoint(truth.open_tai.as_nanos(), truth.close_tai.as_nanos());
                (header.open_tai_ns..header.close_tai_ns).contains(&middle)
            });
        let header = headers.next().unwrap();
        assert!(
            headers.next().is_none(),
            "two bundles of exposure {}",
            truth.index
        );
        assert_eq!(
            header.flags & (flag::NO_IMAGE | flag::NO_EVENTS | flag::NO_MOTION),
            0
        );
        assert_eq!(Some(header.image_sequence), truth.image_sequence);
        for (claimed, true_instant) in [
            (header.open_tai_ns, truth.open_tai),
            (header.close_tai_ns, truth.close_tai),
        ] {
            let error_ns = claimed.abs_diff(true_instant.as_nanos());
            assert!(
                error_ns <= header.uncertainty_ns,
                "exposure {}: {error_ns} ns off, {} ns claimed",
                truth.index,
                header.uncertainty_ns
            );
        }
    }
}

/// Where the ground lies crosses shared memory and reaches the network, and nothing else: of two
/// rigs that differ in how high they stand alone, only the network's depths differ.
#[cfg(feature = "model")]
#[test]
fn the_network_is_told_how_high_the_rig_stands() {
    let raised = recordings::raised_by(1.0, clean());

    let seen = |model, recording: &Path, name: &str| {
        let session = run_as(model, recording, name, LOSSLESS).unwrap();
        let kept = session.observed.kept.into_values();
        kept.map(|kept| (kept.header.ground().unwrap(), kept.sparse, kept.depth))
            .collect::<Vec<_>>()
    };
    for (model, learns) in [(ModelId::Fill, false), (ModelId::Xs, true)] {
        let low = seen(model, clean(), &format!("low-{learns}"));
        let high = seen(model, raised.path(), &format!("high-{learns}"));
        assert!(low.len() >= 4 && low.len() == high.len());
        for (low, high) in low.iter().zip(&high) {
            assert_eq!(low.1, high.1, "returns do not depend on it");
            // A plane 2.5 m below is seen 5/3 as far as one 1.5 m below.
            let ratio = low.0.inverse_depth(64.0, 100.0) / high.0.inverse_depth(64.0, 100.0);
            assert!((ratio - 5.0 / 3.0).abs() < 1e-4, "{ratio}");
            let maps = low.2.values().zip(high.2.values());
            let same = maps.filter(|(low, high)| low.1 == high.1).count();
            assert_eq!(
                same == low.2.len(),
                !learns,
                "{model:?}: {same} maps are the same"
            );
        }
    }
}

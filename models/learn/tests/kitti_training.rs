//! Training on real drives: a small folder in KITTI's layout, made here.
#![allow(clippy::unwrap_used, reason = "a test may fail by panicking")]

use std::fs;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use noctule_depth::Canvas;
use noctule_learn::{
    Cache, CacheError, Examples, KittiClips, KittiDrives, Origin, Part, Run, Settings, Start,
    TrainError, Validation,
};

mod sitting;

const DRIVE: &str = "2011_09_26_drive_0001_sync";
const CAMERAS: &str = "R_rect_00: 1 0 0 0 1 0 0 0 1\nP_rect_02: 60 0 40 0 0 60 24 0 0 0 1 0\n";
const VELODYNE: &str = "R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n";
const WIDTH: u8 = 80;
const HEIGHT: u8 = 48;
const SIDE: usize = 32;
const AREA: usize = SIDE * SIDE;

/// A drive past a pattern, in it two walls that meet ahead, 64 rings on them, and that come nearer by
/// half a metre a frame.
fn drive(root: &Path, name: &str, frames: u8) {
    let day = root.join("raw").join(&name[..10]);
    let pictures = day.join(name).join("image_02/data");
    let scans = day.join(name).join("velodyne_points/data");
    fs::create_dir_all(&pictures).unwrap();
    fs::create_dir_all(&scans).unwrap();
    fs::write(day.join("calib_cam_to_cam.txt"), CAMERAS).unwrap();
    fs::write(day.join("calib_velo_to_cam.txt"), VELODYNE).unwrap();
    for frame in 0..frames {
        let cells = (0..HEIGHT).flat_map(|y| (0..WIDTH).map(move |x| (x + 2 * (frame % 30), y)));
        let code = |(x, y): (u8, u8)| 30 + (x / 3 % 5) * 35 + (y / 4 % 3) * 20;
        let rgb: Vec<u8> = cells.flat_map(|cell| [code(cell); 3]).collect();
        let canvas = Canvas::from_rgb(usize::from(WIDTH), usize::from(HEIGHT), rgb).unwrap();
        canvas
            .save_png(pictures.join(format!("{frame:010}.png")))
            .unwrap();
        let mut scan = Vec::new();
        for ring in 0..64_u8 {
            for column in -20..=20_i8 {
                let x = 10.0 - 0.5 * f32::from(frame % 8) + 0.1 * f32::from(column.abs());
                let slope = 0.12 - 0.008 * f32::from(ring);
                let point = [x, f32::from(column) * -0.03 * x, slope * x, 0.5];
                scan.extend(point.iter().flat_map(|x| x.to_le_bytes()));
            }
        }
        fs::write(scans.join(format!("{frame:010}.bin")), scan).unwrap();
    }
}

fn asked(root: &Path) -> KittiDrives {
    KittiDrives {
        root: root.into(),
        drives: Vec::new(),
        frames: [0, 5],
        validation: Some([6, 7]),
        cuts: 2,
        share: 0.5,
    }
}

fn made(cache: &Cache, asked: &KittiDrives, part: Part) -> Examples {
    let clips = KittiClips::open(asked, part).unwrap();
    let mut rendered = 0;
    let stop = AtomicBool::new(false);
    cache
        .prepare_clips(&clips, &stop, &mut |now| rendered = now.rendered)
        .unwrap();
    assert_eq!(rendered, clips.len() as u64);
    // All is there now.
    cache
        .prepare_clips(&clips, &stop, &mut |now| assert_eq!(now.rendered, 0))
        .unwrap();
    cache.open_clips(&clips).unwrap()
}

/// What a clip is scored on is not even readable here.
fn spoil_scored_frames(root: &Path) {
    let folder = root.join("raw/2011_09_26").join(DRIVE);
    for frame in 8..14 {
        for file in [
            format!("image_02/data/{frame:010}.png"),
            format!("velodyne_points/data/{frame:010}.bin"),
        ] {
            fs::write(folder.join(file), b"not to be looked at").unwrap();
        }
    }
}

#[test]
fn a_clip_gives_squares_with_every_ring_given_once() {
    let root = tempfile::tempdir().unwrap();
    drive(root.path(), DRIVE, 14);
    spoil_scored_frames(root.path());
    let cache = Cache::new(&root.path().join("cache"), SIDE).unwrap();
    let examples = made(&cache, &asked(root.path()), Part::Train);
    // Runs from frames 0, 1 and 2; two squares; four rings to choose from.
    assert_eq!(examples.len(), 3 * 2 * 4);
    assert!(
        examples
            .places()
            .iter()
            .all(|(origin, _)| *origin == Origin::Kitti)
    );
    for run in 0..3_u8 {
        for cut in 0..2 {
            let four: Vec<_> = (0..4)
                .map(|phase| {
                    let index = usize::from(run) * 8 + cut * 4 + phase;
                    examples.read(index, true).unwrap()
                })
                .collect();
            for example in &four {
                assert_eq!(example.exposure_us, 400_000);
                // The horizon is row 24 of the picture, row 8 of the square; 1.65 m, 60 px.
                let ground = example.ground.unwrap();
                assert!((ground.inverse_depth(3.0, 8.0 + 9.9) - 0.1).abs() < 1e-5);
                assert!(example.events.len() > 100, "{}", example.events.len());
                assert_eq!(
                    (&example.events, &example.blur),
                    (&four[0].events, &four[0].blur)
                );
                assert!(example.sharp[..3 * AREA] != example.sharp[4 * 3 * AREA..5 * 3 * AREA]);
            }
            for step in 0..8 {
                let (frame, is_scanned) = (f32::from(run) + (step / 2) as f32, step % 2 == 0);
                let depth = 10.0 - 0.5 * frame;
                let mut given_by = [0; AREA];
                for example in &four {
                    let given = example.step(&example.sparse, step);
                    let truth = example.step(&example.depth, step);
                    assert_eq!(given, example.step(&example.sparse, step / 2 * 2));
                    let walls = depth - 2e-3..depth + 2.0 + 2e-3;
                    assert!(given.iter().all(|d| *d == 0.0 || walls.contains(d)));
                    assert!(truth.iter().all(|d| *d == 0.0 || walls.contains(d)));
                    assert_eq!(truth.iter().any(|d| *d > 0.0), is_scanned);
                    for (cell, count) in given_by.iter_mut().enumerate() {
                        *count += u8::from(given[cell] > 0.0);
                        assert!(given[cell] == 0.0 || truth[cell] == 0.0);
                        // What is given in one is truth in the others.
                        let other = four[0].step(&four[0].sparse, step)[cell];
                        let held = given[cell] + truth[cell];
                        assert!(!is_scanned || other == 0.0 || held > 0.0);
                    }
                }
                assert!(given_by.iter().any(|count| *count > 0));
            }
        }
    }
}

#[test]
fn validation_scores_held_frames_alone() {
    let root = tempfile::tempdir().unwrap();
    drive(root.path(), DRIVE, 14);
    spoil_scored_frames(root.path());
    let cache = Cache::new(&root.path().join("cache"), SIDE).unwrap();
    let mut asked = asked(root.path());
    let examples = made(&cache, &asked, Part::Validation);
    assert_eq!(examples.len(), 3, "frames 4 to 7, three squares");
    for index in 0..3 {
        let example = examples.read(index, false).unwrap();
        for step in 0..8 {
            let has_truth = example.step(&example.depth, step).iter().any(|d| *d > 0.0);
            assert_eq!(has_truth, [4, 6].contains(&step), "step {step}");
            assert!(example.step(&example.sparse, step).iter().any(|d| *d > 0.0));
        }
    }
    asked.validation = None;
    assert!(
        KittiClips::open(&asked, Part::Validation)
            .unwrap()
            .is_empty()
    );
}

#[test]
fn what_must_not_be_trained_on_is_refused() {
    let root = tempfile::tempdir().unwrap();
    drive(root.path(), DRIVE, 14);
    let error = |asked: &KittiDrives| {
        KittiClips::open(asked, Part::Train)
            .unwrap_err()
            .to_string()
    };
    let ours = asked(root.path());
    let scored = KittiDrives {
        frames: [0, 8],
        ..ours.clone()
    };
    assert!(
        error(&scored)
            .contains("a clip of 14 frames is scored on those from 8 on, asked for 0 to 8"),
        "{}",
        error(&scored)
    );
    let mut named = ours.clone();
    named.drives = vec!["2011_09_26_drive_0777_sync".into()];
    assert!(
        error(&named).contains("drive_0777_sync: is not in"),
        "{}",
        error(&named)
    );
    drive(root.path(), "2011_09_26_drive_0002_sync", 14);
    named.drives = vec!["2011_09_26_drive_0002_sync".into()];
    assert!(
        error(&named).contains("held back from training"),
        "{}",
        error(&named)
    );
    // Unnamed it is passed over.
    assert_eq!(KittiClips::open(&ours, Part::Train).unwrap().len(), 24);
    let torn = root.path().join("raw/2011_09_26").join(DRIVE);
    fs::remove_file(torn.join("velodyne_points/data/0000000003.bin")).unwrap();
    assert!(
        error(&ours).contains("has no whole exposure in frames 0 to 5"),
        "{}",
        error(&ours)
    );
    fs::remove_dir_all(torn).unwrap();
    assert!(
        error(&ours).contains("all drives are held back"),
        "{}",
        error(&ours)
    );
}

/// Frames of a drive of 32 or more are steps themselves.
#[test]
fn a_long_drive_gives_runs_of_eight() {
    let root = tempfile::tempdir().unwrap();
    drive(root.path(), DRIVE, 33);
    let long = KittiDrives {
        frames: [3, 20],
        validation: Some([21, 32]),
        cuts: 1,
        ..asked(root.path())
    };
    let cache = Cache::new(&root.path().join("cache"), SIDE).unwrap();
    let examples = made(&cache, &long, Part::Train);
    assert_eq!(examples.len(), 2 * 4, "frames 3 to 10 and 11 to 18");
    let example = examples.read(0, false).unwrap();
    assert_eq!(example.exposure_us, 800_000);
    assert!((0..8).all(|step| example.step(&example.depth, step).iter().any(|d| *d > 0.0)));
    // Frames 25 to 32; 17 to 24, of which the first four are trained on and not scored.
    assert_eq!(KittiClips::open(&long, Part::Validation).unwrap().len(), 6);
    let example = made(&cache, &long, Part::Validation)
        .read(3, false)
        .unwrap();
    for step in 0..8 {
        let has_truth = example.step(&example.depth, step).iter().any(|d| *d > 0.0);
        assert_eq!(has_truth, step >= 4, "step {step}");
    }
}

#[test]
fn a_stop_keeps_what_is_finished() {
    let root = tempfile::tempdir().unwrap();
    drive(root.path(), DRIVE, 14);
    let cache = Cache::new(&root.path().join("cache"), SIDE).unwrap();
    let clips = KittiClips::open(&asked(root.path()), Part::Train).unwrap();
    let stop = AtomicBool::new(false);
    let stopped = cache.prepare_clips(&clips, &stop, &mut |_| stop.store(true, Ordering::Relaxed));
    assert!(matches!(stopped, Err(CacheError::Interrupted)));
    assert!(matches!(
        cache.open_clips(&clips),
        Err(CacheError::File { .. })
    ));
    let (mut rendered, go_on) = (0, AtomicBool::new(false));
    cache
        .prepare_clips(&clips, &go_on, &mut |now| rendered = now.rendered)
        .unwrap();
    assert_eq!(rendered, 16);
    cache.open_clips(&clips).unwrap();
}

fn settings(root: &Path, nights: &str, share: f64) -> Settings {
    let text = format!(
        r#"
        member = "tiny"
        seed = 5
        average = 0.9
        [data]
        cache = "{0}/cache"
        size = 32
        loaders = 2
        {nights}
        [data.kitti]
        root = "{0}"
        frames = [0, 5]
        validation = [6, 7]
        cuts = 1
        share = {share}
        [augment]
        flip = 0.5
        event_drop_max = 0.2
        return_drop_max = 0.2
        [[stages]]
        kind = "2"
        steps = 5
        batch = 2
        crop = 16
        window = 4
        rate = [3e-3, 1e-4]
        validate_every = 3
        checkpoint_every = 2
        [[stages]]
        kind = "3"
        steps = 3
        batch = 2
        crop = 32
        window = 8
        rate = [1e-3, 1e-4]
        validate_every = 3
        checkpoint_every = 2
        "#,
        root.display()
    );
    Settings::from_toml(&text).unwrap()
}

const NIGHTS: &str = "train = [{ tier = \"A\", seeds = [7, 9] }]
        validation = [{ tier = \"A\", seeds = [100000, 100001] }]";

fn open(settings: &Settings, start: Start) -> Run {
    let cache = Cache::new(&settings.data.cache, settings.data.size).unwrap();
    let nights = [settings.train().unwrap(), settings.validation().unwrap()].concat();
    let stop = AtomicBool::new(false);
    cache.prepare(&nights, &stop, &mut |_| {}).unwrap();
    for part in [Part::Train, Part::Validation] {
        let clips = KittiClips::open(settings.data.kitti.as_ref().unwrap(), part).unwrap();
        cache.prepare_clips(&clips, &stop, &mut |_| {}).unwrap();
    }
    Run::new(settings.clone(), start, &cache).unwrap()
}

fn train(run: &mut Run, stop_at: Option<u64>) -> (Vec<f64>, Vec<Validation>) {
    let (losses, validations, outcome) = sitting::train(run, stop_at);
    match stop_at {
        Some(_) => assert!(matches!(outcome, Err(TrainError::Interrupted { .. }))),
        None => outcome.unwrap(),
    }
    (losses, validations)
}

fn start(folder: &Path, resume: bool) -> Start {
    Start {
        folder: folder.into(),
        resume,
        only: None,
    }
}

#[test]
fn a_mixed_run_stopped_anywhere_goes_on_to_the_same_bits() {
    let root = tempfile::tempdir().unwrap();
    drive(root.path(), DRIVE, 14);
    spoil_scored_frames(root.path());
    let settings = settings(root.path(), NIGHTS, 0.5);
    let (whole, stopped) = (root.path().join("whole"), root.path().join("stopped"));
    let (losses, validations) = train(&mut open(&settings, start(&whole, false)), None);
    assert_eq!(losses.len(), 8);
    assert!(losses.iter().all(|loss| loss.is_finite() && *loss > 0.0));
    for found in &validations {
        let (nights, real) = (found.depth.unwrap(), found.kitti.unwrap());
        assert!(real.mae > 0.0 && real.rmse > 0.0 && real.mae_mm > 0.0);
        let mean = 0.5 * (nights.score() + real.plain_score());
        assert!((found.score().unwrap() - mean).abs() < 1e-12);
    }
    let mut all = Vec::new();
    for (sitting, stop_at) in [Some(1), Some(3), Some(6), None].into_iter().enumerate() {
        let start = start(&stopped, sitting > 0);
        all.extend(train(&mut open(&settings, start), stop_at).0);
    }
    assert_eq!(all, losses);
    for file in ["checkpoint", "last", "best", "stage-2", "stage-3"] {
        let read = |folder: &Path| fs::read(folder.join(format!("{file}.safetensors"))).unwrap();
        assert!(read(&whole) == read(&stopped), "{file} differs");
    }
    let table = fs::read_to_string(whole.join("validation.csv")).unwrap();
    let mut rows = table.lines();
    let columns = rows.next().unwrap().split(',').count();
    assert!(rows.all(|row| row.split(',').count() == columns));
}

#[test]
fn real_frames_alone_train_a_network_too() {
    let root = tempfile::tempdir().unwrap();
    drive(root.path(), DRIVE, 14);
    let settings = settings(root.path(), "", 1.0);
    let folder = root.path().join("run");
    let (losses, validations) = train(&mut open(&settings, start(&folder, false)), None);
    assert_eq!(losses.len(), 8);
    let found = validations.last().unwrap();
    assert!(found.depth.is_none() && found.kitti.is_some());
    assert!(folder.join("best.safetensors").exists() && folder.join("grid.png").exists());
}

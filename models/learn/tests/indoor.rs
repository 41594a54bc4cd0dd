//! Rooms: NYU Depth v2 in folders made here, 7-Scenes where `NOCTULE_DATA` names them.
#![allow(clippy::unwrap_used, reason = "a test may fail by panicking")]
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "small codes worked out in floating point"
)]

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use noctule_depth::{Canvas, save_depth_png16};
use noctule_learn::{Method, NyuScenes, RgbdScenes, Scenes, Scores, Share, evaluate};

const WIDTH: usize = 640;
const HEIGHT: usize = 480;
const AREA: usize = 256 * 256;
/// Disparity of the wall in frame 0; it comes nearer by 5 codes a frame.
const DISPARITY: u16 = 900;

/// Depth of a disparity (NYU Depth v2 toolbox).
fn metres(disparity: u16) -> f32 {
    351.3 / (1092.5 - f32::from(disparity))
}

/// Frame `index` at `time_s`: a bar that moves right by 8 pixels a frame before a grey wall.
fn nyu_frame(scene: &Path, index: u16, time_s: f64) {
    fs::create_dir_all(scene).unwrap();
    let mut pixels = vec![60_u8; 3 * WIDTH * HEIGHT];
    let bar = 200 + 8 * usize::from(index);
    for row in pixels.chunks_exact_mut(3 * WIDTH) {
        row[3 * bar..3 * (bar + 40)].fill(220);
    }
    let mut file = format!("P6 {WIDTH} {HEIGHT} 255\n").into_bytes();
    file.extend(&pixels);
    fs::write(
        scene.join(format!("r-{:.3}-{index}.ppm", time_s + 0.004)),
        file,
    )
    .unwrap();
    let mut file = format!("P5 {WIDTH} {HEIGHT} 65535\n").into_bytes();
    let code = (DISPARITY - 5 * index).to_le_bytes();
    file.extend((0..WIDTH * HEIGHT).flat_map(|i| match i % WIDTH < 120 {
        true => 2047_u16.to_le_bytes(),
        false => code,
    }));
    fs::write(scene.join(format!("d-{time_s:.3}-{index}.pgm")), file).unwrap();
}

/// Frames at 25 Hz.
fn nyu_scene(scene: &Path, count: u16) {
    (0..count).for_each(|i| nyu_frame(scene, i, 100.0 + 0.04 * f64::from(i)));
}

#[test]
fn raw_scenes_have_the_depth_of_their_disparities_and_500_points_a_step() {
    let folder = tempfile::tempdir().unwrap();
    nyu_scene(&folder.path().join("cafes/cafe_0001"), 10);
    let scenes = NyuScenes::open(folder.path()).unwrap();
    assert_eq!(scenes.count(), 1);
    let scene = scenes.scene(0).unwrap();
    scene.check().unwrap();
    assert_eq!(scene.name, "cafes/cafe_0001:100");
    assert_eq!(scene.cap_m, 10.0);
    for step in 0..8 {
        let wall = metres(DISPARITY - 5 * step as u16);
        let truth = &scene.depth[step * AREA..][..AREA];
        assert!(truth.iter().all(|d| *d == 0.0 || *d == wall), "step {step}");
        let known = truth.iter().filter(|d| **d > 0.0).count();
        assert!(known * 2 > AREA, "{known}");
        let sparse = &scene.sparse[step * AREA..][..AREA];
        assert_eq!(sparse.iter().filter(|d| **d > 0.0).count(), 500);
        assert!(sparse.iter().zip(truth).all(|(s, t)| *s == 0.0 || s == t));
    }
    // Every step draws for itself.
    let places = |step: usize| {
        let sparse = scene.sparse[step * AREA..][..AREA].iter();
        sparse.map(|d| *d > 0.0).collect::<Vec<_>>()
    };
    assert_ne!(places(0), places(1));
    // The bar leaves a trail of light between wall and bar, and events of both signs.
    let middle = &scene.blur[128 * 256..129 * 256];
    let (low, high) = (60.0 / 255.0, 220.0 / 255.0);
    let between = middle
        .iter()
        .filter(|v| **v > low + 0.1 && **v < high - 0.1);
    assert!(between.count() > 20);
    assert!(scene.voxel.iter().any(|v| *v > 0.0) && scene.voxel.iter().any(|v| *v < 0.0));
    // The same bytes each time, whatever else lies in the folder.
    assert_eq!(scene, scenes.scene(0).unwrap());
    nyu_scene(&folder.path().join("cafes/cafe_0000"), 8);
    let more = NyuScenes::open(folder.path()).unwrap();
    assert_eq!((more.count(), more.scene(1).unwrap()), (2, scene));
}

#[test]
fn a_gap_or_a_picture_twice_tears_a_scene() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    nyu_scene(root, 7);
    let error = NyuScenes::open(root).unwrap_err().to_string();
    assert!(error.contains("has no 8 consecutive pairs"), "{error}");
    (7..15).for_each(|i| nyu_frame(root, i, 100.1 + 0.04 * f64::from(i)));
    let scenes = NyuScenes::open(root).unwrap();
    assert_eq!(scenes.count(), 1);
    assert!(scenes.scene(0).unwrap().name.ends_with(":100.38"));
    // Without its picture a depth map shares its neighbour's, or has none within 25 ms.
    fs::remove_file(root.join("r-100.504-10.ppm")).unwrap();
    assert!(NyuScenes::open(root).is_err());
}

fn all(scenes: &dyn Scenes, share: Share) -> Scores {
    let stop = AtomicBool::new(false);
    evaluate(scenes, &mut Method::baselines(), share, &stop, &mut |_| {
        Ok(())
    })
    .unwrap()
}

/// A table of single images without its last column, which is wall-clock time.
fn timeless(scores: &Scores) -> Vec<String> {
    let text = scores.per_image_csv();
    let lines = text
        .lines()
        .map(|line| line.rsplit_once(',').unwrap().0.to_owned());
    lines.collect()
}

#[test]
fn parts_merge_to_the_whole() {
    let folder = tempfile::tempdir().unwrap();
    nyu_scene(folder.path(), 24);
    let scenes = NyuScenes::open(folder.path()).unwrap();
    assert_eq!(scenes.count(), 3);
    let whole = all(&scenes, Share::WHOLE);
    let mut merged = Scores::default();
    for part in ["1/2", "0/2"] {
        let part = all(&scenes, part.parse().unwrap());
        merged
            .merge_csv(&part.per_image_csv(), Path::new("part.csv"))
            .unwrap();
    }
    assert_eq!(timeless(&merged), timeless(&whole));
    let rows = whole.rows();
    assert_eq!(rows[0].images, 24);
    // A wall: completing it is exact, and reusing the first step's truth is not.
    assert!(rows[0].mae_mm < 1e-3 && rows[3].mae_mm > 10.0, "{rows:?}");
}

#[test]
fn structural_faults_name_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    nyu_scene(root, 8);
    let scenes = NyuScenes::open(root).unwrap();
    let error = || scenes.scene(0).unwrap_err().to_string();
    let small = format!("P6 320 240 255\n{}", "x".repeat(3 * 320 * 240));
    let picture = root.join("r-100.084-2.ppm");
    let before = fs::read(&picture).unwrap();
    fs::write(&picture, small).unwrap();
    assert!(
        error().contains("r-100.084-2.ppm: is 320x240 pixels, wanted 640x480"),
        "{}",
        error()
    );
    fs::write(&picture, &before[..before.len() - 1]).unwrap();
    assert!(
        error().contains("r-100.084-2.ppm: has 921599 bytes of pixels"),
        "{}",
        error()
    );
    fs::write(&picture, before).unwrap();
    let depth = root.join("d-100.120-3.pgm");
    let blind = [
        format!("P5 {WIDTH} {HEIGHT} 65535\n").into_bytes(),
        vec![0xff; 2 * WIDTH * HEIGHT],
    ];
    fs::write(&depth, blind.concat()).unwrap();
    assert!(
        error().contains("d-100.120-3.pgm: has no depth within 10 m"),
        "{}",
        error()
    );
    fs::write(&depth, b"P5 1").unwrap();
    assert!(
        error().contains("d-100.120-3.pgm: height is no number"),
        "{}",
        error()
    );
}

/// Pre-processed frames stand still: no events, the same depth at each step, other points.
#[cfg(feature = "hdf5")]
#[test]
fn pre_processed_frames_stand_still() {
    use hdf5_writer::{DatasetBuilder, Hdf5Builder, WriteOptions};
    let folder = tempfile::tempdir().unwrap();
    let official = folder.path().join("val/official");
    fs::create_dir_all(&official).unwrap();
    let area = WIDTH * HEIGHT;
    let rgb: Vec<u8> = [50, 100, 200].iter().flat_map(|v| vec![*v; area]).collect();
    let depth: Vec<f32> = (0..area)
        .map(|i| 2.0 + (i % WIDTH) as f32 / 100.0)
        .collect();
    let shape = |planes: &[u64]| [planes, &[480, 640]].concat();
    let plan = Hdf5Builder::new()
        .dataset(DatasetBuilder::typed_data("rgb", shape(&[3]), &rgb).unwrap())
        .dataset(DatasetBuilder::typed_data("depth", shape(&[]), &depth).unwrap())
        .into_plan()
        .unwrap();
    let bytes = plan.encode(WriteOptions::default()).unwrap();
    fs::write(official.join("00001.h5"), bytes).unwrap();
    let scenes = NyuScenes::open(folder.path()).unwrap();
    assert_eq!(scenes.count(), 1);
    let scene = scenes.scene(0).unwrap();
    scene.check().unwrap();
    assert_eq!(scene.name, "val/official/00001");
    assert!(scene.voxel.iter().all(|v| *v == 0.0));
    for (plane, code) in scene.blur.chunks(AREA).zip([50.0, 100.0, 200.0]) {
        assert!(plane.iter().all(|v| *v == code / 255.0));
    }
    // Column 200 of 256 lies over column 92 + floor(200.5 * 57 / 32) of 640.
    assert_eq!(scene.depth[200], 2.0 + 449.0 / 100.0);
    let step = |step: usize| &scene.sparse[step * AREA..][..AREA];
    assert_ne!(step(0), step(7));
    assert!((0..8).all(|k| step(k).iter().filter(|d| **d > 0.0).count() == 500));
    assert_eq!(scene.depth[..AREA], scene.depth[7 * AREA..]);
    fs::write(official.join("00000.h5"), b"no HDF5").unwrap();
    let scenes = NyuScenes::open(folder.path()).unwrap();
    let error = scenes.scene(0).unwrap_err().to_string();
    assert!(error.contains("00000.h5: "), "{error}");
}

#[cfg(feature = "hdf5")]
#[test]
fn of_the_labelled_set_the_frames_for_testing_are_scored() {
    use hdf5_writer::{DatasetBuilder, Hdf5Builder, WriteOptions};
    let folder = tempfile::tempdir().unwrap();
    let splits = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/nyu_labelled/splits.mat");
    fs::copy(splits, folder.path().join("splits.mat")).unwrap();
    // Columns first: the depth of a cell tells its column and its frame.
    let area = WIDTH * HEIGHT;
    let images: Vec<u8> = (0..5 * 3).flat_map(|i| vec![10 * i; area]).collect();
    let depths: Vec<f32> = (0..5 * area)
        .map(|i| (i / area) as f32 + (i % area / HEIGHT) as f32 / 1000.0)
        .collect();
    let plan = Hdf5Builder::new()
        .dataset(DatasetBuilder::typed_data("images", vec![5, 3, 640, 480], &images).unwrap())
        .dataset(DatasetBuilder::typed_data("depths", vec![5, 640, 480], &depths).unwrap())
        .into_plan()
        .unwrap();
    let bytes = plan.encode(WriteOptions::default()).unwrap();
    // MATLAB writes a block of text of its own in front.
    let mut file = vec![b' '; 512];
    file.extend(bytes);
    let set = folder.path().join("nyu_depth_v2_labeled.mat");
    fs::write(&set, &file).unwrap();
    let scenes = NyuScenes::open(folder.path()).unwrap();
    assert_eq!(scenes.count(), 2);
    for (index, frame) in [(0, 3_u8), (1, 5)] {
        let scene = scenes.scene(index).unwrap();
        scene.check().unwrap();
        assert_eq!(scene.name, format!("labelled:000{frame}"));
        assert_eq!(scene.blur[AREA], f32::from(30 * (frame - 1) + 10) / 255.0);
        assert_eq!(scene.depth[200], f32::from(frame - 1) + 449.0 / 1000.0);
    }
    fs::write(&set, &file[..file.len() / 2]).unwrap();
    let error = scenes.scene(1).unwrap_err().to_string();
    assert!(error.contains("nyu_depth_v2_labeled.mat: "), "{error}");
}

#[cfg(not(feature = "hdf5"))]
#[test]
fn hdf5_is_refused_with_what_to_do() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("00001.h5"), b"").unwrap();
    let scenes = NyuScenes::open(folder.path()).unwrap();
    let error = scenes.scene(0).unwrap_err().to_string();
    assert!(
        error.contains("00001.h5: is read by builds with the feature hdf5"),
        "{error}"
    );
    let folder = tempfile::tempdir().unwrap();
    for name in ["nyu_depth_v2_labeled.mat", "splits.mat"] {
        fs::write(folder.path().join(name), b"").unwrap();
    }
    let error = NyuScenes::open(folder.path()).unwrap_err().to_string();
    assert!(error.contains("splits.mat: is read by"), "{error}");
}

#[test]
fn sequences_of_an_rgbd_camera_are_rooms_too() {
    let folder = tempfile::tempdir().unwrap();
    let sequence = folder.path().join("seq-01");
    fs::create_dir_all(&sequence).unwrap();
    for frame in (5..14).chain(20..28) {
        let picture = Canvas::new(WIDTH, HEIGHT, [90, 80, 70]).unwrap();
        let name = |part: &str| sequence.join(format!("frame-{frame:06}.{part}.png"));
        picture.save_png(name("color")).unwrap();
        // Millimetres as codes of 1/256.
        let depth = vec![(2000.0 + f32::from(frame as u8)) / 256.0; WIDTH * HEIGHT];
        save_depth_png16(name("depth"), WIDTH, HEIGHT, &depth).unwrap();
    }
    let scenes = RgbdScenes::open(folder.path()).unwrap();
    assert_eq!(scenes.count(), 2);
    for (index, first) in [(0, 5), (1, 20)] {
        let scene = scenes.scene(index).unwrap();
        scene.check().unwrap();
        assert_eq!(scene.name, format!("seq-01:{first}"));
        for (step, truth) in scene.depth.chunks(AREA).enumerate() {
            let wanted = (2000 + first + step) as f32 / 1000.0;
            assert!(truth.iter().all(|d| *d == wanted), "{} {wanted}", truth[0]);
        }
        assert_eq!(scene.sparse.iter().filter(|d| **d > 0.0).count(), 8 * 500);
    }
    fs::remove_file(sequence.join("frame-000020.depth.png")).unwrap();
    let error = RgbdScenes::open(folder.path()).unwrap_err().to_string();
    assert!(error.contains("has no frame-000020.depth.png"), "{error}");
}

fn captures() -> Option<PathBuf> {
    let found = std::env::var_os("NOCTULE_DATA");
    if found.is_none() {
        eprintln!("NOCTULE_DATA is not set: SKIPPING the real rooms, own folders only");
    }
    found.map(|data| PathBuf::from(data).join("scenes/rgbd_7scenes"))
}

/// 24 and 16 frames: three windows of one sequence and two of the other.
#[test]
fn the_captures_rooms_are_scored() {
    let Some(root) = captures() else { return };
    let scenes = RgbdScenes::open(&root).unwrap();
    assert_eq!(scenes.count(), 5);
    let scene = scenes.scene(0).unwrap();
    scene.check().unwrap();
    assert_eq!(scene.name, "seg_fast:943");
    assert_eq!(scene.sparse.iter().filter(|d| **d > 0.0).count(), 8 * 500);
    let fired = scene.voxel.iter().filter(|v| **v != 0.0).count();
    assert!(fired > AREA / 10, "{fired}");
    assert_eq!(scene, scenes.scene(0).unwrap());
    let rows = all(&scenes, Share::WHOLE).rows();
    eprintln!("{}", noctule_learn::markdown(&rows));
    assert_eq!(rows[0].images, 40);
    // Errors of a room: centimetres for what completes, and more for one map of the whole.
    assert!(
        (20.0..400.0).contains(&rows[0].mae_mm),
        "{}",
        rows[0].mae_mm
    );
    assert!(rows[2].mae_mm > 2.0 * rows[0].mae_mm && rows[3].mae_mm > 0.0);
}

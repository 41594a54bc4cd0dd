//! KITTI's layouts: real frames where `NOCTULE_DATA` names them, and small folders made here.
#![allow(clippy::unwrap_used, reason = "a test may fail by panicking")]

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use noctule_depth::{Canvas, Completer, Size, load_depth_png16, save_depth_png16};
use noctule_learn::{
    ColourCamera, KittiScenes, Method, Scenes, Selection, Share, Split, Window, benchmark_drives,
    evaluate, held_out, raw_drives, rings_by_order, sparse_depth,
};

const DRIVE: &str = "2011_09_26_drive_9001_sync";

/// The KITTI part of the captures, or a loud word that it is not looked at.
fn captures() -> Option<PathBuf> {
    let found =
        std::env::var_os("NOCTULE_DATA").map(|data| PathBuf::from(data).join("scenes/kitti"));
    if found.is_none() {
        eprintln!("NOCTULE_DATA is not set: SKIPPING the real KITTI frames, own folders only");
    }
    found
}

/// The captures' `velodyne_raw` maps were projected from the scans by another program (numpy,
/// `P_rect_02 R_rect_00 Tr`, round half up, nearest wins, depth times 256 rounded).
#[test]
fn scans_project_to_the_captures_maps_to_half_a_code() {
    let Some(root) = captures() else { return };
    let drives = raw_drives(&root, ColourCamera::Left).unwrap();
    let [drive] = &drives[..] else {
        panic!("one drive, found {}", drives.len())
    };
    assert_eq!(drive.name(), DRIVE);
    assert_eq!(drive.pictures(), (0..14).collect::<Vec<u32>>());
    assert_eq!(drive.scans(), drive.pictures());
    assert_eq!(drive.picture_times_ns().unwrap(), None);
    let size = Size::new(1242, 375).unwrap();
    // Pixels, counted by numpy from the same scans.
    for (frame, pixels) in [(0, 16_293), (8, 15_182), (13, 15_608)] {
        let scan = drive.scan(frame).unwrap();
        let map = sparse_depth(&scan, drive.calibration(), size);
        assert_eq!(map.iter().filter(|depth| **depth > 0.0).count(), pixels);
        let folder = root
            .join("val")
            .join(DRIVE)
            .join("proj_depth/velodyne_raw/image_02");
        let stored = load_depth_png16(folder.join(format!("{frame:010}.png"))).unwrap();
        assert_eq!((stored.width, stored.height), (1242, 375));
        // Half a code of rounding, and the last bit of a 32-bit float.
        let far = |(stored, depth): &(&f32, &f32)| (256.0 * (**stored - **depth)).abs() > 0.501;
        let pairs = stored.depth_m.iter().zip(&map);
        assert_eq!(pairs.clone().filter(far).count(), 0, "frame {frame}");
        assert!(
            pairs
                .clone()
                .all(|(stored, depth)| (*stored > 0.0) == (*depth > 0.0))
        );
    }
    assert_eq!(drive.scan(8).unwrap().len(), 16_454);
    // 48 times (numpy) the azimuth jumps from right to left: 49 of the 64 rings cross the picture.
    let rings = rings_by_order(&drive.scan(8).unwrap());
    assert_eq!((rings[0], *rings.last().unwrap()), (0, 48));
    assert_eq!(rings.iter().filter(|ring| **ring == 10).count(), 365);
}

/// A selection's maps are crops of the drive's: 13 columns and 23 rows in.
#[test]
fn the_captures_selection_is_a_crop_of_its_drive() {
    let Some(root) = captures() else { return };
    let selection = Selection::open(&root.join("depth_selection")).unwrap();
    assert_eq!(selection.len(), 2);
    assert_eq!(
        selection.name(1),
        Some("2011_09_26_drive_9001_sync_image_0000000008_image_02")
    );
    let frame = selection.read(1).unwrap();
    assert_eq!(frame.pinhole, [721.5377, 721.5377, 596.5593, 149.854]);
    let window = Window::benchmark(1242, 375).unwrap();
    let folder = root
        .join("val")
        .join(DRIVE)
        .join("proj_depth/velodyne_raw/image_02");
    let whole = load_depth_png16(folder.join("0000000008.png")).unwrap();
    let truth = frame.truth.unwrap();
    assert_eq!(window.of_map(&whole.depth_m, 1242), Some(truth.depth_m));
    let drives = raw_drives(&root, ColourCamera::Left).unwrap();
    let picture = drives[0].picture(8).unwrap();
    assert_eq!(window.of_picture(&picture).unwrap(), frame.picture.rgb());
    let count = frame.sparse.depth_m.iter().filter(|d| **d > 0.0).count();
    assert!((3000..5000).contains(&count), "{count}");
}

/// Held-out rings of the clip: what is given is never scored, together they are the scan, and the
/// baselines run end to end.
#[test]
fn the_captures_clip_is_scored_on_held_out_rings() {
    let Some(root) = captures() else { return };
    let scenes = KittiScenes::open(&root).unwrap();
    // Windows 8-11 and 9-12, whose light ends within the clip; three squares of each.
    assert_eq!(scenes.count(), 6);
    let scene = scenes.scene(0).unwrap();
    scene.check().unwrap();
    assert_eq!(scene.name, format!("{DRIVE}:8:left"));
    let area = scene.size.pixels();
    for step in 0..8 {
        let (given, scored) = (
            &scene.sparse[step * area..][..area],
            &scene.depth[step * area..][..area],
        );
        assert!(given.iter().any(|d| *d > 0.0));
        assert_eq!(
            scored.iter().any(|d| *d > 0.0),
            step % 2 == 0,
            "step {step}"
        );
        assert!(
            given
                .iter()
                .zip(scored)
                .all(|(g, s)| *g == 0.0 || *s == 0.0)
        );
        assert_eq!(given, &scene.sparse[step / 2 * 2 * area..][..area]);
    }
    assert!(scene.voxel.iter().any(|v| *v != 0.0));
    assert_eq!(scene, scenes.scene(0).unwrap());
    let stop = AtomicBool::new(false);
    let scores = evaluate(
        &scenes,
        &mut Method::baselines(),
        Share::WHOLE,
        &stop,
        &mut |_| Ok(()),
    );
    let rows = scores.unwrap().rows();
    eprintln!("{}", noctule_learn::markdown(&rows));
    assert_eq!(rows[0].images, 24);
    assert!(rows[0].mae_mm > 300.0 && rows[0].mae_mm < 3000.0 && rows[0].rmse_mm > rows[0].mae_mm);
    let selection = KittiScenes::open(&root.join("depth_selection")).unwrap();
    assert_eq!(selection.count(), 6);
    let scores = evaluate(
        &selection,
        &mut Method::baselines(),
        Share::WHOLE,
        &stop,
        &mut |_| Ok(()),
    );
    let rows = scores.unwrap().rows();
    eprintln!("{}", noctule_learn::markdown(&rows));
    assert_eq!(rows[0].images, 48);
}

/// Whole pictures, nearest and fill: the figures beside which a network's squares are read.
#[test]
fn held_out_rings_of_whole_pictures_split_the_scan() {
    let Some(root) = captures() else { return };
    let drives = raw_drives(&root, ColourCamera::Left).unwrap();
    let size = Size::new(1242, 375).unwrap();
    let mut completer = Completer::new(1242, 375).unwrap();
    let mut sums = [[0.0; 2]; 2];
    for frame in 0..14 {
        let scan = drives[0].scan(frame).unwrap();
        let (given, scored) = held_out(&scan, drives[0].calibration(), size);
        let whole = sparse_depth(&scan, drives[0].calibration(), size);
        let union = given.depth_m.iter().zip(&scored.depth_m).zip(&whole);
        assert!(
            union
                .clone()
                .all(|((g, s), w)| (g + s > 0.0) == (*w > 0.0) && *w <= g + s)
        );
        let count = |map: &[f32]| map.iter().filter(|d| **d > 0.0).count();
        let share = count(&given.depth_m) as f64 / count(&whole) as f64;
        assert!((0.2..0.3).contains(&share), "{share}");
        let (mut map, mut aside) = (vec![0.0; size.pixels()], vec![0.0; size.pixels()]);
        for (kind, sum) in sums.iter_mut().enumerate() {
            let given = &given.depth_m;
            match kind {
                0 => completer.nearest(given, &mut map, &mut aside).unwrap(),
                _ => completer.fill(given, &mut map, &mut aside).unwrap(),
            }
            let found = noctule_depth::metrics(&map, &scored.depth_m, 0.1, 80.0).unwrap();
            sum[0] += found.rmse_mm / 14.0;
            sum[1] += found.mae_mm / 14.0;
        }
    }
    eprintln!("whole pictures, nearest and fill, RMSE and MAE mm: {sums:.0?}");
    assert!(sums[0][1] < sums[0][0] && sums[0][0] < 10_000.0);
}

const CAMERAS: &str = "calib_time: 01-Jan-2000\nR_rect_00: 1 0 0 0 1 0 0 0 1\nP_rect_02: 300 0 150 0 0 300 130 0 0 0 1 0\nP_rect_03: 300 0 150 -160 0 300 130 0 0 0 1 0\n";
const VELODYNE: &str = "R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n";
const WIDTH: usize = 300;
const HEIGHT: usize = 270;

/// A raw drive of `frames` pictures whose brightness grows, each with a wall of four rings.
fn raw_drive(root: &Path, name: &str, frames: u32) -> PathBuf {
    let day = root.join("raw").join(&name[..10]);
    let drive = day.join(name);
    let (pictures, scans) = (
        drive.join("image_02/data"),
        drive.join("velodyne_points/data"),
    );
    fs::create_dir_all(&pictures).unwrap();
    fs::create_dir_all(&scans).unwrap();
    fs::write(day.join("calib_cam_to_cam.txt"), CAMERAS).unwrap();
    fs::write(day.join("calib_velo_to_cam.txt"), VELODYNE).unwrap();
    for frame in 0..frames {
        let grey = 40 + 5 * u8::try_from(frame % 30).unwrap();
        let picture = Canvas::new(WIDTH, HEIGHT, [grey; 3]).unwrap();
        picture
            .save_png(pictures.join(format!("{frame:010}.png")))
            .unwrap();
        let mut scan = Vec::new();
        for ring in 0..64_u8 {
            for column in -10..=10_i8 {
                let point = [
                    10.0,
                    f32::from(column) * -0.3,
                    1.0 - f32::from(ring) * 0.05,
                    0.5,
                ];
                scan.extend(point.iter().flat_map(|x| x.to_le_bytes()));
            }
        }
        fs::write(scans.join(format!("{frame:010}.bin")), scan).unwrap();
    }
    drive
}

#[test]
fn long_drives_give_windows_of_eight_and_clips_of_four() {
    let folder = tempfile::tempdir().unwrap();
    raw_drive(folder.path(), "2011_09_26_drive_0001_sync", 14);
    let clip = KittiScenes::open(folder.path()).unwrap();
    assert_eq!(clip.count(), 6);
    let long = raw_drive(folder.path(), "2011_09_28_drive_0037_sync", 35);
    // A drive that the benchmark holds back displaces those that it trains on.
    let scenes = KittiScenes::open(folder.path()).unwrap();
    assert_eq!(scenes.count(), 3 * 4);
    let scene = scenes.scene(4).unwrap();
    scene.check().unwrap();
    assert_eq!(scene.name, "2011_09_28_drive_0037_sync:8:centre");
    // Every wall point lies 10 m ahead; every step has a scan and is scored.
    assert!(
        scene
            .depth
            .iter()
            .chain(&scene.sparse)
            .all(|d| *d == 0.0 || *d == 10.0)
    );
    let area = scene.size.pixels();
    assert!(scene.depth.chunks(area).all(|step| step.contains(&10.0)));
    // Light only grows, so does what the events say of it.
    assert!(scene.voxel.iter().sum::<f32>() > 0.0);
    // A lost frame tears the second window; the rest is taken up behind it.
    fs::remove_file(long.join("image_02/data/0000000009.png")).unwrap();
    let torn = KittiScenes::open(&long).unwrap();
    assert_eq!(torn.count(), 3 * 4);
    assert_eq!(
        torn.scene(3).unwrap().name,
        "2011_09_28_drive_0037_sync:10:left"
    );
}

#[test]
fn structural_faults_name_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let error = |root: &Path| KittiScenes::open(root).unwrap_err().to_string();
    assert!(
        error(root).contains("has no raw drive like"),
        "{}",
        error(root)
    );
    let drive = raw_drive(root, "2011_09_26_drive_0001_sync", 14);
    let day = drive.parent().unwrap().to_path_buf();
    for (file, text, fault) in [
        (
            "calib_velo_to_cam.txt",
            "R: 1 2 3\nT: 0 0 0\n",
            "R: 3 numbers, wanted 9",
        ),
        (
            "calib_velo_to_cam.txt",
            "R: 0 -1 0 0 0 -1 1 0 zero\nT: 0 0 0\n",
            "\"zero\" is no finite number",
        ),
        ("calib_velo_to_cam.txt", "T: 0 0 0\n", "has no line R:"),
        ("calib_cam_to_cam.txt", "", "has no line P_rect_02:"),
    ] {
        let before = fs::read(day.join(file)).unwrap();
        fs::write(day.join(file), text).unwrap();
        let error = error(root);
        assert!(error.contains(file) && error.contains(fault), "{error}");
        fs::write(day.join(file), before).unwrap();
    }
    let scan = drive.join("velodyne_points/data/0000000008.bin");
    fs::write(&scan, [0; 17]).unwrap();
    let scenes = KittiScenes::open(root).unwrap();
    let torn = scenes.scene(0).unwrap_err().to_string();
    assert!(
        torn.contains("0000000008.bin: 17 bytes are no whole number"),
        "{torn}"
    );
    fs::write(drive.join("image_02/data/0000000009.png"), b"no picture").unwrap();
    assert!(
        scenes
            .scene(0)
            .unwrap_err()
            .to_string()
            .contains("0000000009.png")
    );
    fs::write(drive.join("image_02/data/9.png"), b"").unwrap();
    assert!(
        error(root).contains("\"9.png\" is not called like frame"),
        "{}",
        error(root)
    );
}

fn depth_file(folder: &Path, frame: u32, depth_m: f32) {
    fs::create_dir_all(folder).unwrap();
    let map = vec![depth_m; WIDTH * HEIGHT];
    save_depth_png16(folder.join(format!("{frame:010}.png")), WIDTH, HEIGHT, &map).unwrap();
}

/// Plain split folders, the archives' two roots, pictures in raw drives or merged beside the maps.
#[test]
fn benchmark_drives_are_found_in_every_variant() {
    let name = "2011_09_26_drive_0002_sync";
    for (annotated, velodyne, is_merged) in [
        ("val", "val", false),
        ("val", "val", true),
        ("data_depth_annotated/val", "data_depth_velodyne/val", false),
        ("data_depth_annotated/val", "data_depth_velodyne/val", true),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        let drive = raw_drive(root, name, 18);
        if is_merged {
            let merged = root.join(velodyne).join(name);
            fs::create_dir_all(&merged).unwrap();
            fs::rename(drive.join("image_02"), merged.join("image_02")).unwrap();
            fs::remove_dir_all(root.join("raw")).unwrap();
        }
        for frame in 5..13 {
            depth_file(
                &root
                    .join(velodyne)
                    .join(name)
                    .join("proj_depth/velodyne_raw/image_02"),
                frame,
                7.0,
            );
            depth_file(
                &root
                    .join(annotated)
                    .join(name)
                    .join("proj_depth/groundtruth/image_02"),
                frame,
                9.0,
            );
        }
        let drives = benchmark_drives(root, Split::Validation, ColourCamera::Left).unwrap();
        assert_eq!(drives.len(), 1);
        assert_eq!(drives[0].frames(), (5..13).collect::<Vec<u32>>());
        assert!(
            benchmark_drives(root, Split::Train, ColourCamera::Left)
                .unwrap()
                .is_empty()
        );
        let scenes = KittiScenes::open(root).unwrap();
        assert_eq!(scenes.count(), 3);
        let scene = scenes.scene(2).unwrap();
        scene.check().unwrap();
        assert!(scene.sparse.iter().all(|d| *d == 7.0) && scene.depth.iter().all(|d| *d == 9.0));
        // A map of 8 bits, and one of another size.
        let truth = root
            .join(annotated)
            .join(name)
            .join("proj_depth/groundtruth/image_02/0000000006.png");
        save_depth_png16(&truth, 300, 200, &vec![9.0; 300 * 200]).unwrap();
        let error = scenes.scene(0).unwrap_err().to_string();
        assert!(
            error.contains("depth of frame 6 is 300x200, its picture 300x270"),
            "{error}"
        );
    }
}

#[test]
fn selections_are_read_with_and_without_truth() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("test_depth_completion_anonymous");
    for part in ["image", "velodyne_raw", "intrinsics"] {
        fs::create_dir_all(root.join(part)).unwrap();
    }
    let picture = Canvas::new(WIDTH, HEIGHT, [9; 3]).unwrap();
    picture.save_png(root.join("image/0000000003.png")).unwrap();
    depth_file(&root.join("velodyne_raw"), 3, 5.0);
    let selection = Selection::open(&root).unwrap();
    let error = selection.read(0).unwrap_err().to_string();
    assert!(error.contains("intrinsics"), "{error}");
    let text = root.join("intrinsics/0000000003.txt");
    fs::write(&text, "700 0 150 0 710 120 0 0 1").unwrap();
    let frame = selection.read(0).unwrap();
    assert!(frame.truth.is_none() && frame.sparse.depth_m[7] == 5.0);
    assert_eq!(frame.pinhole, [700.0, 710.0, 150.0, 120.0]);
    let scenes = KittiScenes::open(&root).unwrap();
    assert!(
        scenes
            .scene(0)
            .unwrap_err()
            .to_string()
            .contains("has no groundtruth_depth")
    );
    depth_file(&root.join("groundtruth_depth"), 3, 6.0);
    let scene = scenes.scene(1).unwrap();
    scene.check().unwrap();
    assert!(scene.depth.iter().all(|d| *d == 6.0) && scene.voxel.iter().all(|v| *v == 0.0));
    fs::write(&text, "0 0 150 0 710 120 0 0 1").unwrap();
    assert!(
        selection
            .read(0)
            .unwrap_err()
            .to_string()
            .contains("focal lengths are 0 and 710")
    );
    assert!(
        selection
            .read(1)
            .unwrap_err()
            .to_string()
            .contains("frame number 1")
    );
}

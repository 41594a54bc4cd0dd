//! Sparse depth on a simulated LiDAR: passes cut out of the stream, and a vehicle that moves.
#![allow(clippy::unwrap_used, reason = "a test may panic")]
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "test arithmetic"
)]

use std::time::Duration;

use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use noctule_raster::{
    Channel, Distortion, EgoPolicy, Grid, PassCounts, Pinhole, RasterError, SparseConfig,
    SparseRaster,
};
use noctule_sensor::{Return, Stamp, Tai};

const FIRING_NS: u64 = 166_666;
const START_NS: u64 = 1_800_000_000_000_000_000;

/// LiDAR above and behind a camera, turned a little; both well ahead of the vehicle's origin.
fn config() -> SparseConfig {
    let axes = Matrix3::new(1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0);
    let turn = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    let tilt = UnitQuaternion::from_euler_angles(0.01, -0.02, 0.015);
    let camera_from_lidar =
        Isometry3::from_parts(Translation3::new(0.02, -0.25, -0.10), tilt * turn);
    // Vehicle x (forward) is the LiDAR's y, vehicle y (left) its -x.
    let ahead = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::FRAC_PI_2);
    let lidar_from_vehicle = Isometry3::from_parts(Translation3::new(0.0, -1.5, -1.7), ahead);
    let offsets = [8.7, -5.3, 5.5, -7.9];
    let channel = |c: usize| Channel {
        elevation_deg: c as f64 * 1.6 - 50.4,
        azimuth_offset_deg: offsets[c % 4],
    };
    SparseConfig {
        camera: Pinhole::new(
            262.0,
            262.0,
            127.5,
            127.5,
            Distortion {
                k1: -0.1,
                ..Distortion::default()
            },
        )
        .unwrap(),
        grid: Grid::new(256, 256),
        camera_from_lidar,
        lidar_from_vehicle,
        channels: (0..64).map(channel).collect(),
        rotation: Duration::from_millis(100),
        passes: 4,
        points_max: 20_000,
        range_min_m: 2.0,
        margin_deg: 6.0,
        motion_samples: 400,
        motion_reach: Duration::from_millis(20),
    }
}

fn at(ns: u64) -> Stamp<Tai> {
    Stamp::from_nanos(START_NS + ns)
}

/// When firing `k` shoots channel `c`, nanoseconds.
fn fired(k: u64, c: usize) -> u64 {
    k * FIRING_NS + 2310 + c as u64 * 2100
}

fn echo(config: &SparseConfig, k: u64, c: usize, point: Point3<f64>) -> Return {
    let offset = (config.channels[c].azimuth_offset_deg * 100.0).round() as i64;
    Return {
        t: Stamp::ZERO,
        x_m: point.x as f32,
        y_m: point.y as f32,
        z_m: point.z as f32,
        azimuth_cdeg: (k as i64 * 60 + offset).rem_euclid(36_000) as u16,
        channel: c as u8,
        intensity: 10,
        block: 0,
    }
}

/// A wall at 10 m all round.
fn on_the_wall(config: &SparseConfig, k: u64, c: usize) -> Return {
    let angle = &config.channels[c];
    let (sin, cos) = (k as f64 * 0.6 + angle.azimuth_offset_deg)
        .to_radians()
        .sin_cos();
    let up = 10.0 * angle.elevation_deg.to_radians().tan();
    echo(config, k, c, Point3::new(10.0 * sin, 10.0 * cos, up))
}

/// Firings `range`, all channels, but for those `lost` says.
fn spin(
    raster: &mut SparseRaster,
    config: &SparseConfig,
    range: std::ops::Range<u64>,
    lost: impl Fn(u64) -> bool,
) {
    for k in range.filter(|k| !lost(*k)) {
        for c in 0..64 {
            raster.push_return(at(fired(k, c)), &on_the_wall(config, k, c));
        }
    }
}

fn spun(range: std::ops::Range<u64>, lost: impl Fn(u64) -> bool) -> SparseRaster {
    let config = config();
    let mut raster = SparseRaster::new(&config).unwrap();
    spin(&mut raster, &config, range, lost);
    raster
}

fn counts(raster: &SparseRaster) -> PassCounts {
    raster.tracker().counts()
}

/// Firings from azimuth 180 degrees on, so that every turn starts behind the camera.
const BEHIND: u64 = 300;

#[test]
fn every_turn_is_one_pass_of_the_same_returns() {
    let raster = spun(BEHIND..BEHIND + 5 * 600 + 10, |_| false);
    assert_eq!((counts(&raster).complete, counts(&raster).partial), (5, 0));
    let window = raster.tracker().window();
    let seen = (0..64).filter(|c| window.sees(*c)).count();
    let firings = window.width_cdeg() as usize / 60;
    let passes: Vec<_> = raster.tracker().passes().collect();
    assert_eq!(passes.len(), 4); // the fifth oldest made room
    for pass in passes {
        let n = pass.points().len();
        assert!(
            n.abs_diff(seen * firings) <= 2 * seen,
            "{n} returns, {seen} channels x {firings}"
        );
        // Each channel from edge to edge: no ragged border though offsets differ by 16.6 degrees.
        assert_eq!(pass.gap_cdeg_max(), 60);
        let span = pass.ended().diff_nanos(pass.points()[0].at) as u64;
        let expected = u64::from(window.width_cdeg() + 1660) * FIRING_NS / 60;
        assert!(span.abs_diff(expected) < 2 * FIRING_NS, "{span} {expected}");
    }
    let total = counts(&raster);
    assert_eq!(
        total.kept + total.outside_window + total.unplaced,
        (5 * 600 + 10) * 64
    );
    assert_eq!(
        (total.unplaced, total.unknown_channel, total.overflowed),
        (0, 0, 0)
    );
}

#[test]
fn the_newest_pass_that_ended_before_the_instant_is_taken() {
    let raster = spun(BEHIND..BEHIND + 3 * 600, |_| false);
    let mut ends: Vec<_> = raster
        .tracker()
        .passes()
        .map(|pass| (pass.ended(), pass.id()))
        .collect();
    ends.sort_unstable();
    assert_eq!(ends.len(), 3);
    let newest = |instant| {
        raster
            .tracker()
            .newest_before(instant)
            .map(|pass| pass.id())
    };
    assert_eq!(newest(ends[0].0), None); // it has to end before, not at
    assert_eq!(newest(ends[0].0.offset_nanos(1)), Some(ends[0].1));
    assert_eq!(newest(ends[2].0), Some(ends[1].1));
    assert_eq!(newest(Stamp::MAX), Some(ends[2].1));
}

#[test]
fn a_pass_of_which_the_start_was_missed_does_not_count() {
    // The stream starts with the camera's axis.
    let raster = spun(600..1800, |_| false);
    assert_eq!((counts(&raster).complete, counts(&raster).partial), (1, 0));
    assert!(counts(&raster).unplaced > 500);
    // Nor one that is not over.
    let raster = spun(BEHIND..600, |_| false);
    assert_eq!(
        (counts(&raster).complete, raster.tracker().passes().count()),
        (0, 0)
    );
    assert!(counts(&raster).kept > 500);
}

#[test]
fn lost_packets_leave_a_gap_and_never_merge_two_passes() {
    // Firings 590..610, then the end of the second turn's window and all until the next entry.
    let raster = spun(BEHIND..BEHIND + 2400, |k| {
        (590..610).contains(&k) || (1240..1400).contains(&k)
    });
    assert_eq!((counts(&raster).complete, counts(&raster).partial), (4, 0));
    let mut gaps: Vec<_> = raster
        .tracker()
        .passes()
        .map(|pass| (pass.id(), pass.gap_cdeg_max()))
        .collect();
    gaps.sort_unstable();
    let gaps: Vec<_> = gaps.into_iter().map(|(_, gap)| gap).collect();
    assert_eq!((gaps[0], gaps[2], gaps[3]), (21 * 60, 60, 60));
    assert!(gaps[1] > 60, "{gaps:?}");
    // A silence of most of a turn: nobody knows where one turn ended and the other began.
    let raster = spun(BEHIND..BEHIND + 2400, |k| (600..1100).contains(&k));
    assert_eq!((counts(&raster).complete, counts(&raster).partial), (3, 1));
}

#[test]
fn packets_may_swap_and_the_clock_may_step() {
    let config = config();
    let mut raster = SparseRaster::new(&config).unwrap();
    for k in (BEHIND..BEHIND + 600).map(|k| k ^ 1) {
        for c in 0..64 {
            raster.push_return(at(fired(k, c)), &on_the_wall(&config, k, c));
        }
    }
    assert_eq!((counts(&raster).complete, counts(&raster).unplaced), (1, 0));
    let in_order = spun(BEHIND..BEHIND + 600, |_| false);
    assert!(counts(&raster).kept.abs_diff(counts(&in_order).kept) <= 64);
    // Ten seconds back: what was known is of another time.
    let back = Stamp::from_nanos(START_NS - 10_000_000_000);
    raster.push_return(back, &on_the_wall(&config, 0, 30));
    assert_eq!(
        (
            counts(&raster).clock_steps,
            raster.tracker().passes().count()
        ),
        (1, 0)
    );
}

#[test]
fn blocks_without_returns_still_end_a_pass() {
    let config = config();
    let mut raster = SparseRaster::new(&config).unwrap();
    for k in BEHIND..BEHIND + 600 {
        raster.note_block(at(k * FIRING_NS), k as u32 * 60 % 36_000);
    }
    assert_eq!(counts(&raster).complete, 1);
    let mut out = vec![1.0; raster.map_len()];
    let report = raster.draw(Stamp::MAX, EgoPolicy::Still, &mut out).unwrap();
    assert_eq!((report.pass.is_some(), report.returns), (true, 0));
    assert!(out.iter().all(|depth| *depth == 0.0));
    let mut stranger = on_the_wall(&config, 0, 3);
    stranger.channel = 64;
    raster.push_return(at(0), &stranger);
    assert_eq!(counts(&raster).unknown_channel, 1);
}

#[test]
fn a_full_pass_counts_what_it_cannot_hold() {
    let config = SparseConfig {
        points_max: 100,
        ..config()
    };
    let mut raster = SparseRaster::new(&config).unwrap();
    spin(&mut raster, &config, BEHIND..BEHIND + 600, |_| false);
    assert_eq!(counts(&raster).kept, 100);
    let pass = raster.tracker().passes().next().unwrap();
    assert_eq!(
        (pass.points().len(), pass.overflowed()),
        (100, counts(&raster).overflowed)
    );
    assert!(pass.overflowed() > 500);
}

/// Where the vehicle is `seconds` after the start, on a circle in closed form; world = start.
fn world_from_vehicle(speed: f64, yaw_rate: f64, seconds: f64) -> Isometry3<f64> {
    let (turn, radius) = (yaw_rate * seconds, speed / yaw_rate);
    Isometry3::from_parts(
        Translation3::new(radius * turn.sin(), radius * (1.0 - turn.cos()), 0.0),
        UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn),
    )
}

const SPEED: f64 = 14.0;
const YAW_RATE: f64 = 0.35;

/// One thing that stands still, shot once per turn by the channel that points at it.
fn shoot(config: &SparseConfig, landmark: &Point3<f64>, turn: u64) -> Option<(u64, usize, Return)> {
    let seen_from = |ns: u64| {
        let vehicle = world_from_vehicle(SPEED, YAW_RATE, ns as f64 * 1e-9);
        config.lidar_from_vehicle * vehicle.inverse() * landmark
    };
    // Where it is, when it is shot, where it is then: settles after a few rounds.
    let mut k = turn * 600;
    let mut c = 0;
    for _ in 0..20 {
        let point = seen_from(fired(k, c));
        let elevation = point.z.atan2(point.x.hypot(point.y)).to_degrees();
        c = ((elevation + 50.4) / 1.6).round().clamp(0.0, 63.0) as usize;
        let azimuth = point.x.atan2(point.y).to_degrees() - config.channels[c].azimuth_offset_deg;
        k = (turn * 600).checked_add_signed((azimuth / 0.6).round() as i64)?;
    }
    Some((k, c, echo(config, k, c, seen_from(fired(k, c)))))
}

/// Posts on a grid ahead of the vehicle.
fn landmarks() -> Vec<Point3<f64>> {
    let post = |i: i32, j: i32| {
        let far = 14.0 + 3.1 * f64::from(j);
        Point3::new(
            far,
            f64::from(i) * 0.09 * far + 0.9,
            1.5 + 0.4 * f64::from((i * 7 + j * 3) % 5 - 2),
        )
    };
    (0..6)
        .flat_map(|j| (-4..=4).map(move |i| post(i, j)))
        .collect()
}

/// The rig after two turns past the landmarks, motion logged at 100 Hz.
fn drive(config: &SparseConfig) -> SparseRaster {
    let mut raster = SparseRaster::new(config).unwrap();
    for k in 0..40 {
        raster
            .push_motion(at(k * 10_000_000), SPEED as f32, YAW_RATE as f32)
            .unwrap();
    }
    let landmarks = landmarks();
    let mut shots: Vec<_> = (1..=2)
        .flat_map(|turn| {
            landmarks
                .iter()
                .filter_map(move |post| shoot(config, post, turn))
        })
        .collect();
    shots.sort_by_key(|(k, c, _)| fired(*k, *c));
    let mut shots = shots.into_iter().peekable();
    for k in BEHIND..1600 {
        raster.note_block(at(k * FIRING_NS), k as u32 * 60 % 36_000);
        while let Some((k, c, echo)) = shots.next_if(|shot| shot.0 <= k) {
            raster.push_return(at(fired(k, c)), &echo);
        }
    }
    raster
}

/// A still scene: whichever turn saw it, and however long ago, it lands on the pixels where the
/// closed form says it is at the instant asked for.
#[test]
fn a_still_scene_seen_at_two_times_lands_on_the_same_pixels() {
    let config = config();
    let mut raster = drive(&config);
    let mut ends: Vec<_> = raster.tracker().passes().map(|pass| pass.ended()).collect();
    ends.sort_unstable();
    assert_eq!(ends.len(), 2);
    let mut out = vec![0.0f32; raster.map_len()];
    let both: Vec<_> = ends
        .iter()
        .map(|end| {
            // The same place is looked at from 3 ms and from 40 ms later.
            [3_000_000, 40_000_000].map(|later| {
                let centre = end.offset_nanos(later);
                let report = raster
                    .draw(centre, EgoPolicy::Compensate, &mut out)
                    .unwrap();
                assert_eq!((report.extrapolated_ns, report.age_ns), (0, later as u64));
                assert_eq!(
                    report.returns,
                    report.drawn + report.hidden + report.outside
                );
                assert_expected(&config, centre, &out, report.drawn + report.hidden)
            })
        })
        .collect();
    assert!(both.iter().flatten().all(|seen| *seen > 40), "{both:?}");
    // Uncompensated, posts 15 m ahead are off by what was driven.
    let centre = ends[0].offset_nanos(40_000_000);
    raster.draw(centre, EgoPolicy::Still, &mut out).unwrap();
    let wrong = misplaced(&config, centre, &out);
    assert!(wrong > 30, "{wrong} posts misplaced");
}

/// Pixel and depth of every landmark in view at `centre`.
fn expected(config: &SparseConfig, centre: Stamp<Tai>) -> Vec<(usize, f64)> {
    let seconds = (centre.as_nanos() - START_NS) as f64 * 1e-9;
    let vehicle_from_world = world_from_vehicle(SPEED, YAW_RATE, seconds).inverse();
    let camera_from_world =
        config.camera_from_lidar * config.lidar_from_vehicle * vehicle_from_world;
    let place = |post: Point3<f64>| {
        let seen = camera_from_world * post;
        let (u, v) = config.camera.project(&seen)?;
        let is_inside = (0.0..255.0).contains(&u) && (0.0..255.0).contains(&v);
        is_inside.then(|| (v.round() as usize * 256 + u.round() as usize, seen.z))
    };
    landmarks().into_iter().filter_map(place).collect()
}

fn misplaced(config: &SparseConfig, centre: Stamp<Tai>, out: &[f32]) -> usize {
    let is_there = |(cell, depth): &(usize, f64)| (f64::from(out[*cell]) - depth).abs() < 2e-5;
    expected(config, centre)
        .iter()
        .filter(|post| !is_there(post))
        .count()
}

fn assert_expected(config: &SparseConfig, centre: Stamp<Tai>, out: &[f32], returns: u32) -> u32 {
    let posts = expected(config, centre);
    for (cell, depth) in &posts {
        let nearest = posts
            .iter()
            .filter(|(other, _)| other == cell)
            .map(|(_, depth)| *depth);
        let depth = nearest.fold(*depth, f64::min);
        let drawn = f64::from(out[*cell]);
        assert!(
            (drawn - depth).abs() < 2e-5,
            "{drawn} m at cell {cell}, should be {depth} m"
        );
    }
    assert!(posts.len() as u32 <= returns);
    posts.len() as u32
}

/// Against a plain loop of matrix products, one transform per return.
#[test]
fn a_map_is_the_nearest_of_all_returns_projected_one_by_one() {
    let config = config();
    let mut raster = SparseRaster::new(&config).unwrap();
    for k in 0..40u16 {
        let (speed, yaw_rate) = (10.0 + 0.1 * f32::from(k), 0.3 - 0.02 * f32::from(k));
        raster
            .push_motion(at(u64::from(k) * 10_000_000), speed, yaw_rate)
            .unwrap();
    }
    for k in BEHIND..BEHIND + 900 {
        for c in 0..64 {
            // Two echoes on one beam, the nearer one first or last.
            let echo = on_the_wall(&config, k, c);
            let scale = if k % 2 == 0 { 0.99 } else { 1.01 };
            let (x_m, y_m, z_m) = (scale * echo.x_m, scale * echo.y_m, scale * echo.z_m);
            raster.push_return(at(fired(k, c)), &echo);
            raster.push_return(
                at(fired(k, c)),
                &Return {
                    x_m,
                    y_m,
                    z_m,
                    ..echo
                },
            );
        }
    }
    let centre = at(210_000_000);
    let mut out = vec![f32::NAN; raster.map_len()];
    let report = raster
        .draw(centre, EgoPolicy::Compensate, &mut out)
        .unwrap();
    let pass = raster.tracker().newest_before(centre).unwrap();
    let mut slow = vec![0.0f64; raster.map_len()];
    let (mut outside, mut inside) = (0, 0);
    for point in pass.points() {
        let lidar_from_lidar = raster
            .motion()
            .lidar_from_lidar(centre, point.at, &config.lidar_from_vehicle)
            .unwrap();
        let matrix = (config.camera_from_lidar * lidar_from_lidar).to_homogeneous();
        let seen = matrix.transform_point(&Point3::from(point.xyz_m.map(f64::from)));
        match config
            .camera
            .project(&seen)
            .map(|(u, v)| ((u + 0.5).floor(), (v + 0.5).floor()))
        {
            Some((u, v)) if (0.0..256.0).contains(&u) && (0.0..256.0).contains(&v) => {
                let pixel = &mut slow[v as usize * 256 + u as usize];
                *pixel = if *pixel == 0.0 {
                    seen.z
                } else {
                    pixel.min(seen.z)
                };
                inside += 1;
            }
            _ => outside += 1,
        }
    }
    assert_eq!(
        (report.outside, report.drawn + report.hidden),
        (outside, inside)
    );
    assert!(
        report.drawn > 1000 && report.hidden > 0 && report.outside > 100,
        "{report:?}"
    );
    for (cell, (fast, slow)) in out.iter().zip(&slow).enumerate() {
        assert!(
            (f64::from(*fast) - slow).abs() < 1e-5,
            "{fast} {slow} at {cell}"
        );
    }
    assert_eq!(
        report.drawn as usize,
        out.iter().filter(|depth| **depth > 0.0).count()
    );
}

#[test]
fn motion_that_does_not_reach_is_an_error_or_owned_up_to() {
    let config = config();
    let mut raster = SparseRaster::new(&config).unwrap();
    spin(&mut raster, &config, BEHIND..BEHIND + 600, |_| false);
    let mut out = vec![1.0; raster.map_len()];
    let end = raster.tracker().passes().next().unwrap().ended();
    let centre = end.offset_nanos(1_000_000);
    assert_eq!(
        raster.draw(centre, EgoPolicy::Compensate, &mut out),
        Err(RasterError::NoMotion)
    );
    assert!(out.iter().all(|depth| *depth == 0.0));
    for k in 0..9 {
        raster.push_motion(at(k * 10_000_000), 5.0, 0.0).unwrap();
    }
    let reach = |raster: &SparseRaster| centre.diff_nanos(raster.motion().covered().unwrap().1);
    // The newest sample is further back than 20 ms.
    let error = raster
        .draw(centre, EgoPolicy::Compensate, &mut out)
        .unwrap_err();
    assert!(matches!(error, RasterError::NotCovered { .. }), "{error}");
    let newest = centre.offset_nanos(-15_000_000);
    raster.push_motion(newest, 5.0, 0.0).unwrap();
    let report = raster
        .draw(centre, EgoPolicy::Compensate, &mut out)
        .unwrap();
    assert_eq!(
        (report.extrapolated_ns, reach(&raster)),
        (15_000_000, 15_000_000)
    );
    // Once the log catches up the same pass is placed again, without extrapolation.
    raster
        .push_motion(centre.offset_nanos(1), 9.0, 0.3)
        .unwrap();
    assert_eq!(
        raster
            .draw(centre, EgoPolicy::Compensate, &mut out)
            .unwrap()
            .extrapolated_ns,
        0
    );
    let error = raster
        .draw(centre, EgoPolicy::Compensate, &mut out[1..])
        .unwrap_err();
    assert_eq!(
        error.to_string(),
        "depth map has 65535 elements, needs 65536"
    );
}

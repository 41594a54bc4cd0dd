//! Pictures between frames: moved textures, and the real clip's frames made from their neighbours.
#![allow(clippy::unwrap_used, reason = "a test may fail by panicking")]
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "codes worked out in f64"
)]

use std::path::PathBuf;

use noctule_depth::{Canvas, Size};
use noctule_learn::{
    ColourCamera, Footage, InBetween, OpticalFlow, Synthesis, Window, expose, raw_drives,
};
use proptest::prelude::*;

/// Grey of 0 to 255 that repeats nowhere: random numbers on grids of 24, 12 and 6 pixels, smoothly
/// joined.
fn noise(x: f64, y: f64, salt: u32) -> f64 {
    let mut grey = 128.0;
    for (cell, height) in [(24.0, 70.0), (12.0, 40.0), (6.0, 20.0)] {
        let (u, v) = (x / cell, y / cell);
        let corner = |i: f64, j: f64| {
            let mut h = (i as i32 as u32).wrapping_mul(0x9e37_79b9)
                ^ (j as i32 as u32).wrapping_mul(0x85eb_ca6b)
                ^ (cell as u32 * 7 + salt).wrapping_mul(0xc2b2_ae35);
            h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
            h = (h ^ (h >> 12)).wrapping_mul(0x297a_2d39);
            f64::from(h ^ (h >> 15)) / f64::from(u32::MAX) - 0.5
        };
        let (i, j) = (u.floor(), v.floor());
        let smooth = |t: f64| t * t * t * (t * (6.0 * t - 15.0) + 10.0);
        let (fu, fv) = (smooth(u - i), smooth(v - j));
        let top = corner(i, j) * (1.0 - fu) + corner(i + 1.0, j) * fu;
        let bottom = corner(i, j + 1.0) * (1.0 - fu) + corner(i + 1.0, j + 1.0) * fu;
        grey += 2.0 * height * (top * (1.0 - fv) + bottom * fv);
    }
    grey
}

/// A textured picture, `[H, W, 3]`, moved by `(dx, dy)`, and in front of it a square of another
/// texture, moved by `near`.
fn picture(size: Size, [dx, dy]: [f64; 2], near: Option<[f64; 2]>) -> Vec<u8> {
    let mut codes = Vec::new();
    for y in 0..size.height() {
        for x in 0..size.width() {
            let (x, y) = (x as f64, y as f64);
            let mut code = noise(x - dx, y - dy, 1);
            if let Some([nx, ny]) = near {
                let (x, y) = (x - nx, y - ny);
                if (30.0..60.0).contains(&x) && (20.0..50.0).contains(&y) {
                    code = noise(x, y, 2);
                }
            }
            codes.extend([code, code, 0.7 * code].map(|c| c.round().clamp(0.0, 255.0) as u8));
        }
    }
    codes
}

fn footage(frames: &[Vec<u8>], size: Size) -> Footage {
    Footage::from_srgb(frames.iter().map(Vec::as_slice), size, 100_000.0).unwrap()
}

/// Mean absolute difference over the pixels that `is_counted`.
fn difference(a: &[f32], b: &[f32], size: Size, is_counted: impl Fn(usize, usize) -> bool) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for (i, (a, b)) in a.iter().zip(b).enumerate() {
        let cell = i % size.pixels();
        if is_counted(cell % size.width(), cell / size.width()) {
            sum += f64::from((a - b).abs());
            count += 1.0;
        }
    }
    sum / count
}

#[test]
fn the_middle_of_a_moving_texture_is_moved_half_way() {
    let size = Size::new(128, 96).unwrap();
    for [dx, dy] in [[6.0, 0.0], [-9.0, 5.0]] {
        let ends = [picture(size, [0.0; 2], None), picture(size, [dx, dy], None)];
        let middle = footage(&[picture(size, [0.5 * dx, 0.5 * dy], None)], size);
        let truth = middle.light(0.0, InBetween::Blended);
        let made = footage(&ends, size);
        let interior = |x: usize, y: usize| {
            (12..size.width() - 12).contains(&x) && (12..size.height() - 12).contains(&y)
        };
        let error = |how| difference(&made.light(0.5, how), &truth, size, interior);
        let (moved, blended) = (error(InBetween::Moved), error(InBetween::Blended));
        eprintln!("({dx}, {dy}): moved {moved:.5}, blended {blended:.5}");
        assert!(moved * 10.0 < blended, "{moved} {blended}");
    }
}

/// A square passes in front: what it hides and uncovers is taken from the frame that sees it.
#[test]
fn what_is_hidden_in_one_frame_is_taken_from_the_other() {
    let size = Size::new(128, 80).unwrap();
    let at = |share: f64| picture(size, [-2.0 * share, 0.0], Some([6.0 * share, 2.0 * share]));
    let made = footage(&[at(0.0), at(1.0)], size);
    let truth = footage(&[at(0.5)], size).light(0.0, InBetween::Blended);
    // The square's way and what it uncovers.
    let around = |x: usize, y: usize| (26..72).contains(&x) && (16..56).contains(&y);
    let error = |how| difference(&made.light(0.5, how), &truth, size, around);
    let (moved, blended) = (error(InBetween::Moved), error(InBetween::Blended));
    eprintln!("moved {moved:.5}, blended {blended:.5}");
    assert!(moved * 2.5 < blended, "{moved} {blended}");
}

#[test]
fn frames_are_themselves_and_a_window_sees_what_the_whole_does() {
    let size = Size::new(96, 64).unwrap();
    let frames: Vec<Vec<u8>> = (0..3)
        .map(|i| picture(size, [4.0 * f64::from(i), -1.5 * f64::from(i)], None))
        .collect();
    let whole = footage(&frames, size);
    for at in [-1.0, 0.0, 1.0, 2.0, 3.5] {
        let (moved, blended) = (
            whole.light(at, InBetween::Moved),
            whole.light(at, InBetween::Blended),
        );
        assert_eq!(moved, blended, "{at}");
    }
    // Nothing jumps on the way into a frame.
    let (near, on) = (
        whole.light(0.999, InBetween::Moved),
        whole.light(1.0, InBetween::Moved),
    );
    assert!(difference(&near, &on, size, |_, _| true) < 2e-3);

    let inner = Size::new(40, 30).unwrap();
    let window = Window {
        x: 20,
        y: 12,
        size: inner,
    };
    let seen = whole.seen_through(window.x, window.y, inner).unwrap();
    for how in [InBetween::Moved, InBetween::Blended] {
        let all = whole.light(0.3, how);
        let part: Vec<f32> = all
            .chunks(size.pixels())
            .flat_map(|plane| window.of_map(plane, size.width()).unwrap())
            .collect();
        assert_eq!(seen.light(0.3, how), part);
    }
    let error = whole.seen_through(60, 0, inner).unwrap_err().to_string();
    assert_eq!(
        error,
        "a window of 40x30 pixels at (60, 0) of frames of 96x64"
    );
}

/// Eight pictures per frame, doubled until a step is a pixel at most, or 32.
#[test]
fn pictures_per_frame_follow_what_moves() {
    let size = Size::new(128, 96).unwrap();
    let recipe = Synthesis::of_seed(1);
    for (dx, wanted) in [
        (0.0, 8),
        (6.0, 8),
        (12.0, 16),
        (14.0, 16),
        (26.0, 32),
        (40.0, 32),
    ] {
        let frames = [
            picture(size, [0.0; 2], None),
            picture(size, [dx, 0.0], None),
        ];
        let made = footage(&frames, size);
        assert_eq!(recipe.pictures_per_frame(&made, 0.0, 1.0), wanted, "{dx}");
        let blended = Synthesis {
            in_between: InBetween::Blended,
            ..recipe
        };
        assert_eq!(blended.pictures_per_frame(&made, 0.0, 1.0), 8);
        // Beyond the frames the light stands still.
        assert_eq!(recipe.pictures_per_frame(&made, 1.0, 2.0), 8);
    }
}

#[test]
fn the_same_frames_are_the_same_bits_on_any_number_of_threads() {
    let size = Size::new(64, 48).unwrap();
    let frames: Vec<Vec<u8>> = (0..3)
        .map(|i| {
            picture(
                size,
                [3.0 * f64::from(i), f64::from(i)],
                Some([5.0 * f64::from(i), 0.0]),
            )
        })
        .collect();
    let made = || {
        let exposed = expose(&footage(&frames, size), -0.5, 2.5, &Synthesis::of_seed(3));
        exposed.unwrap()
    };
    let one = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .unwrap();
    let four = rayon::ThreadPoolBuilder::new()
        .num_threads(4)
        .build()
        .unwrap();
    assert_eq!(one.install(made), four.install(made));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn no_pictures_make_it_panic(
        (width, height) in (1_usize..40, 1_usize..40),
        seed in any::<u64>(),
        at in -1.0_f64..3.0,
    ) {
        let size = Size::new(width, height).unwrap();
        let mut state = seed | 1;
        let mut frame = || -> Vec<u8> {
            (0..3 * size.pixels())
                .map(|_| {
                    state ^= state << 13;
                    state ^= state >> 7;
                    state ^= state << 17;
                    (state >> 32) as u8
                })
                .collect()
        };
        let made = footage(&[frame(), frame(), frame()], size);
        let light = made.light(at, InBetween::Moved);
        prop_assert_eq!(light.len(), 3 * size.pixels());
        // Every pixel is a mean of pixels.
        prop_assert!(light.iter().all(|l| (-1e-5..=1.0 + 1e-5).contains(l)));
    }
}

/// Grey as the eye sees it, 0 to 255.
fn grey(picture: &Canvas) -> Vec<f32> {
    let weights = [0.2126, 0.7152, 0.0722];
    let pixels = picture.rgb().chunks_exact(3);
    pixels
        .map(|p| p.iter().zip(weights).map(|(c, w)| f32::from(*c) * w).sum())
        .collect()
}

/// Of neighbouring frames, flow explains most of the difference; a frame made of the two around it
/// is nearer to the real one than their blend is.
#[test]
fn the_captures_frames_are_made_from_their_neighbours() {
    let Some(root) = std::env::var_os("NOCTULE_DATA") else {
        eprintln!("NOCTULE_DATA is not set: SKIPPING the real KITTI frames, own textures only");
        return;
    };
    let root = PathBuf::from(root).join("scenes/kitti");
    let drive = &raw_drives(&root, ColourCamera::Left).unwrap()[0];
    // The left and the middle of the road and what stands beside it.
    let size = Size::new(640, 375).unwrap();
    let window = Window { x: 0, y: 0, size };
    let pictures: Vec<Canvas> = [2, 3, 4].map(|frame| drive.picture(frame).unwrap()).into();
    let parts: Vec<Vec<u8>> = pictures
        .iter()
        .map(|picture| window.of_picture(picture).unwrap())
        .collect();
    let greys: Vec<Vec<f32>> = parts
        .iter()
        .map(|part| grey(&Canvas::from_rgb(640, 375, part.clone()).unwrap()))
        .collect();

    let flow = OpticalFlow::between(&greys[0], &greys[1], size).unwrap();
    let (mut still, mut warped, mut count) = (0.0, 0.0, 0.0);
    for y in 0..size.height() {
        for x in 0..size.width() {
            let [dx, dy] = flow.at(x, y);
            let (tx, ty) = (x as f32 + dx, y as f32 + dy);
            let inside = (0.0..=639.0).contains(&tx) && (0.0..=374.0).contains(&ty);
            if !inside {
                continue;
            }
            let cell = y * 640 + x;
            let (left, top) = (tx as usize, ty as usize);
            let (right, bottom) = ((left + 1).min(639), (top + 1).min(374));
            let (fx, fy) = (tx - left as f32, ty - top as f32);
            let next = |x: usize, y: usize| greys[1][y * 640 + x];
            let found = (1.0 - fy) * ((1.0 - fx) * next(left, top) + fx * next(right, top))
                + fy * ((1.0 - fx) * next(left, bottom) + fx * next(right, bottom));
            still += f64::from((greys[1][cell] - greys[0][cell]).abs());
            warped += f64::from((found - greys[0][cell]).abs());
            count += 1.0;
        }
    }
    eprintln!(
        "grey differs by {:.2}, along the flow by {:.2}",
        still / count,
        warped / count
    );
    assert!(warped * 2.5 < still, "{warped} {still}");

    let truth = footage(&parts[1..2], size).light(0.0, InBetween::Blended);
    let ends = [parts[0].clone(), parts[2].clone()];
    let made = footage(&ends, size);
    let encoded = |light: Vec<f32>| -> Vec<f32> {
        light
            .iter()
            .map(|l| 255.0 * l.max(0.0).powf(1.0 / 2.2))
            .collect()
    };
    let truth = encoded(truth);
    let error = |how| difference(&encoded(made.light(0.5, how)), &truth, size, |_, _| true);
    let (moved, blended) = (error(InBetween::Moved), error(InBetween::Blended));
    eprintln!("frame 3 of 2 and 4: moved {moved:.2}, blended {blended:.2} of 255");
    assert!(moved * 1.5 < blended, "{moved} {blended}");
}

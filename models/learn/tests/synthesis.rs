//! Exposures made of sharp frames: closed forms, and the same bits every time.
#![allow(clippy::unwrap_used, reason = "a test may fail by panicking")]
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "codes and counts worked out in f64"
)]

use noctule_depth::Size;
use noctule_learn::{Footage, InBetween, SynthError, Synthesis, expose};
use noctule_world::PixelModel;

const SIDE: usize = 16;

fn plain(between: usize) -> Synthesis {
    let pixels = PixelModel::default().without_noise();
    Synthesis {
        between,
        in_between: InBetween::Blended,
        pixels,
        film: None,
        seed: 1,
    }
}

fn footage(greys: &[u8]) -> Footage {
    let frames: Vec<Vec<u8>> = greys
        .iter()
        .map(|grey| vec![*grey; 3 * SIDE * SIDE])
        .collect();
    let size = Size::new(SIDE, SIDE).unwrap();
    Footage::from_srgb(frames.iter().map(Vec::as_slice), size, 100_000.0).unwrap()
}

/// sRGB's curve (IEC 61966-2-1), written out once more.
fn linear(code: f64) -> f64 {
    let value = code / 255.0;
    if value <= 0.04045 {
        value / 12.92
    } else {
        ((value + 0.055) / 1.055).powf(2.4)
    }
}

fn encoded(light: f64) -> f64 {
    255.0
        * if light <= 0.003_130_8 {
            12.92 * light
        } else {
            1.055 * light.powf(1.0 / 2.4) - 0.055
        }
}

/// Light that grows evenly from frame to frame has its mean half-way: in linear light.
#[test]
fn a_blur_is_the_mean_of_linear_light() {
    let (dark, bright) = (40.0, 220.0);
    let exposed = expose(&footage(&[40, 220]), 0.0, 1.0, &plain(16)).unwrap();
    let wanted = encoded(0.5 * (linear(dark) + linear(bright))).round() as u8;
    assert_eq!(wanted, 163); // the mean of codes is 130
    assert!(
        exposed.blur.iter().all(|code| *code == wanted),
        "{}",
        exposed.blur[0]
    );
    assert_eq!(exposed.exposure_us, 100_000);
    for (step, sharp) in exposed.sharp.chunks(3 * SIDE * SIDE).enumerate() {
        let share = (step as f64 + 0.5) / 8.0;
        let wanted = encoded(linear(dark) + share * (linear(bright) - linear(dark))).round() as u8;
        assert!(sharp.iter().all(|code| *code == wanted), "step {step}");
    }
}

/// The logarithm of light rises by ln((b + 0.002) / (a + 0.002)); a pixel fires once per threshold
/// of 0.25, save what the band limit holds back at the end and the share that lies in no frame.
#[test]
fn events_count_the_thresholds_that_light_crosses() {
    let exposed = expose(&footage(&[60, 60, 200, 200]), 0.0, 3.0, &plain(32)).unwrap();
    let rise = ((linear(200.0) + 0.002) / (linear(60.0) + 0.002)).ln();
    let wanted = (rise / 0.25).floor() as usize;
    assert_eq!(wanted, 10);
    assert_eq!(exposed.events.len(), wanted * SIDE * SIDE);
    assert!(exposed.events.iter().all(|event| event.is_on()));
    // Light stands still but between the second frame and the third; the filter lags a little.
    assert!(
        exposed
            .events
            .iter()
            .all(|event| (95_000..=240_000).contains(&event.t_us))
    );
    assert!(
        exposed
            .events
            .windows(2)
            .all(|pair| (pair[0].t_us, pair[0].y(), pair[0].x())
                <= (pair[1].t_us, pair[1].y(), pair[1].x()))
    );
    // Falling light mirrors rising light.
    let fallen = expose(&footage(&[200, 200, 60, 60]), 0.0, 3.0, &plain(32)).unwrap();
    assert_eq!(fallen.events.len(), wanted * SIDE * SIDE);
    assert!(fallen.events.iter().all(|event| !event.is_on()));
}

#[test]
fn a_seed_is_an_exposure_bit_for_bit() {
    let footage = footage(&[20, 90, 60]);
    let made = |seed| expose(&footage, -0.5, 2.5, &Synthesis::of_seed(seed)).unwrap();
    assert_eq!(made(4), made(4));
    assert!(made(4).blur != made(5).blur && made(4).events != made(5).events);
    let one = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .unwrap();
    assert_eq!(one.install(|| made(4)), made(4));
    assert!(made(4).events.iter().all(|event| event.t_us < 300_000));
    assert_eq!(made(4).exposure_us, 300_000);
}

#[test]
fn nonsense_is_named() {
    let size = Size::new(SIDE, SIDE).unwrap();
    let none = Footage::from_srgb([], size, 1.0).unwrap_err();
    assert_eq!(none, SynthError::Empty);
    let short = Footage::from_srgb([&[0_u8; 7][..]], size, 1.0).unwrap_err();
    assert_eq!(short.to_string(), "frame 0 has 7 bytes, wanted 768");
    let wide = Size::new(4000, 1).unwrap();
    let wide = Footage::from_srgb([&[0_u8; 12_000][..]], wide, 1.0).unwrap_err();
    assert_eq!(
        wide.to_string(),
        "frames of 4000x1 pixels, at most 2048 a side"
    );
    let frame = [0_u8; 768];
    assert_eq!(
        Footage::from_srgb([&frame[..]], size, f64::NAN)
            .unwrap_err()
            .to_string(),
        "frames every NaN us, wanted a number above 0"
    );
    let footage = footage(&[1]);
    for (open, close, between) in [
        (0.0, 0.0, 8),
        (1.0, 0.0, 8),
        (0.0, f64::NAN, 8),
        (f64::NEG_INFINITY, 0.0, 8),
        (0.0, 1e9, 8),
        (0.0, 1.0, 0),
        (0.0, 1.0, 65),
    ] {
        let recipe = Synthesis {
            between,
            ..plain(8)
        };
        assert!(
            expose(&footage, open, close, &recipe).is_err(),
            "{open} {close} {between}"
        );
    }
}

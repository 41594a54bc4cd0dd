//! What events say of the light during an exposure: the event double integral (paper, eq. 10).

use noctule_raster::PackedEvent;
use noctule_world::STEPS;

use super::cut::{GAMMA, GREY};
use crate::settings::Domain;

/// Signed events from the opening to each step's centre, `[T, H, W]`.
pub(super) fn event_sums(events: &[PackedEvent], exposure_us: u32, side: usize) -> Vec<f32> {
    let area = side * side;
    let mut sums = vec![0.0f32; STEPS * area];
    for event in events {
        // Step k's centre lies at (k + 1/2) / T of the exposure: the first one after the event.
        let step =
            (u64::from(event.t_us) * 2 * STEPS as u64 / u64::from(exposure_us.max(1))).div_ceil(2);
        if let Ok(step @ 0..STEPS) = usize::try_from(step) {
            let cell = event.y() as usize * side + event.x() as usize;
            sums[step * area + cell] += if event.is_on() { 1.0 } else { -1.0 };
        }
    }
    for cell in area..STEPS * area {
        sums[cell] += sums[cell - area];
    }
    sums
}

/// Grey at the step centres as the event double integral has it (paper, eq. 10), `[T, H, W]`.
pub(super) fn event_grey(blur: &[f32], sums: &[f32], domain: Domain, contrast: f32) -> Vec<f32> {
    let area = blur.len() / 3;
    let gamma = match domain {
        Domain::Linear => GAMMA,
        Domain::Encoded => 1.0,
    };
    let (decode, encode) = (|v: f32| v.powf(gamma), |v: f32| v.powf(1.0 / gamma));
    let mut grey = vec![0.0; sums.len()];
    for cell in 0..area {
        let mean: f32 = (0..3)
            .map(|c| GREY[c] * decode(blur[c * area + cell]))
            .sum();
        let rise = |step: usize| (contrast * sums[step * area + cell]).exp();
        let total = (0..STEPS).map(rise).sum::<f32>() / STEPS as f32;
        for step in 0..STEPS {
            grey[step * area + cell] = encode(mean * rise(step) / total).min(1.0);
        }
    }
    grey
}

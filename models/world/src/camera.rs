//! The frame camera: from light on the sensor to 8-bit pixels.
//!
//! Electrons = 25,000 per second and unit of radiance, spread by lens flare, then Poisson noise,
//! read noise, full well, white level and gamma 1/2.2.

use rayon::prelude::*;

use crate::chance::{Dice, Purpose};
use crate::flare;

/// Electrons per second for one unit of radiance.
pub const ELECTRONS_PER_SECOND: f32 = 25_000.0;
/// Read noise, electrons.
const READ_NOISE: f64 = 2.5;
/// Electrons a pixel holds.
pub(crate) const FULL_WELL: f32 = 10_000.0;
/// White is never below this many electrons.
const WHITE_FLOOR: f32 = 150.0;

/// Three planes of linear light in electrons.
pub(crate) type Light = [Vec<f32>; 3];

/// The camera of one seed.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Camera {
    seed: u64,
    /// Over- or under-exposure: 0.5 to 1.5.
    brightness: f32,
}

impl Camera {
    pub(crate) fn new(seed: u64) -> Self {
        let brightness = Dice::new(seed, Purpose::Camera).range(0.5, 1.5) as f32;
        Self { seed, brightness }
    }

    /// Noise-free electrons behind the lens, from radiance averaged over `seconds`.
    pub(crate) fn expose(radiance: &Light, size: usize, seconds: f64) -> Light {
        let gain = ELECTRONS_PER_SECOND * seconds as f32;
        let planes: Vec<Vec<f32>> = radiance
            .par_iter()
            .map(|plane| {
                let mut spread = flare::spread(plane, size);
                spread.iter_mut().for_each(|e| *e *= gain);
                spread
            })
            .collect();
        planes.try_into().expect("three planes in, three out")
    }

    /// The number of electrons shown as white: the 97th percentile times 1.2 over the camera's
    /// brightness; no more than a pixel holds, so that a full pixel is white.
    pub(crate) fn white(&self, electrons: &Light) -> f32 {
        let mut all: Vec<f32> = electrons.concat();
        let rank = all.len() * 97 / 100;
        let (_, percentile, _) = all.select_nth_unstable_by(rank, f32::total_cmp);
        (*percentile * 1.2 / self.brightness).clamp(WHITE_FLOOR, FULL_WELL)
    }

    /// A noisy picture, `[3, H, W]`; `index` numbers the exposure.
    pub(crate) fn develop(
        &self,
        electrons: &Light,
        white: f32,
        size: usize,
        index: u64,
    ) -> Vec<u8> {
        let mut out = vec![0; 3 * size * size];
        out.par_chunks_mut(size)
            .enumerate()
            .for_each(|(row, pixels)| {
                let number = 1 + index * 3 * size as u64 + row as u64;
                let mut dice = Dice::numbered(self.seed, Purpose::Camera, number);
                let means = &electrons[row / size][row % size * size..][..size];
                for (pixel, &mean) in pixels.iter_mut().zip(means) {
                    let noisy = dice.poisson(f64::from(mean)) + READ_NOISE * dice.normal();
                    *pixel = encode((noisy as f32).clamp(0.0, FULL_WELL) / white);
                }
            });
        out
    }

    /// A picture without noise, `[3, H, W]`, at the same white level.
    pub(crate) fn develop_clean(electrons: &Light, white: f32) -> Vec<u8> {
        electrons
            .iter()
            .flatten()
            .map(|&e| encode(e / white))
            .collect()
    }
}

/// Linear light (white = 1) to a pixel value, gamma 1/2.2.
fn encode(linear: f32) -> u8 {
    (linear.clamp(0.0, 1.0).powf(1.0 / 2.2) * 255.0).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_poisson_plus_read_noise() {
        let size = 64;
        let camera = Camera::new(3);
        let electrons = [(); 3].map(|()| vec![400.0_f32; size * size]);
        let pixels = camera.develop(&electrons, 1000.0, size, 0);
        let linear: Vec<f64> = pixels
            .iter()
            .map(|&p| 1000.0 * (f64::from(p) / 255.0).powf(2.2))
            .collect();
        let n = linear.len() as f64;
        let mean = linear.iter().sum::<f64>() / n;
        let deviation = (linear.iter().map(|e| (e - mean).powi(2)).sum::<f64>() / n).sqrt();
        assert!((mean - 400.0).abs() < 2.0, "{mean}");
        // sqrt(400 + 2.5^2) = 20.2; 8-bit rounding adds 5.2 / sqrt(12).
        assert!((deviation - 20.2).abs() < 0.6, "{deviation}");
        assert_ne!(pixels, camera.develop(&electrons, 1000.0, size, 1));
    }

    #[test]
    fn white_has_a_floor_and_follows_the_97th_percentile() {
        let camera = Camera {
            seed: 0,
            brightness: 1.0,
        };
        let dark = [(); 3].map(|()| vec![10.0_f32; 1024]);
        assert_eq!(camera.white(&dark), WHITE_FLOOR);
        let ramp = [(); 3].map(|()| (0..1000).map(|i| i as f32).collect::<Vec<_>>());
        assert!((camera.white(&ramp) - 970.0 * 1.2).abs() < 2.0);
    }
}

//! From linear light to a picture of 8 bits, with the noise of a dark scene.

use noctule_raster::{Encoding, EncodingTable};

use crate::chance::Chance;

/// Electrons of a full pixel, as the world's camera has it.
const FULL_WELL: f32 = 10_000.0;
/// What film takes its chance for: the scene's light, and each plane's noise.
const SCENE: u64 = 0x6461_726b;

/// How dark a scene is made, and what the camera adds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Film {
    /// Share of daylight that is left; the exposure's gain makes up for it.
    pub light: f32,
    /// Read noise, electrons.
    pub read_electrons: f32,
}

impl Film {
    /// The night of a seed: 0.05 to 0.3 of the light, read noise of 2.5 electrons.
    pub fn of_seed(seed: u64) -> Self {
        Self {
            light: Chance::of(&[SCENE, seed]).between(0.05, 0.3) as f32,
            read_electrons: 2.5,
        }
    }

    /// A noisy picture of linear light (white 1), sRGB.
    pub(super) fn develop(&self, light: &[f32], seed: u64) -> Vec<u8> {
        let white = f64::from(FULL_WELL * self.light).max(1.0);
        let table = EncodingTable::new(Encoding::Srgb);
        let mut chance = Chance::of(&[SCENE, seed, 1]);
        light
            .iter()
            .map(|&share| {
                let electrons = poisson(&mut chance, f64::from(share) * white)
                    + f64::from(self.read_electrons) * normal(&mut chance);
                table.code((electrons / white) as f32)
            })
            .collect()
    }
}

/// A picture of linear light without noise, sRGB.
pub(super) fn develop_clean(light: &[f32]) -> Vec<u8> {
    let table = EncodingTable::new(Encoding::Srgb);
    light.iter().map(|&share| table.code(share)).collect()
}

/// Standard normal (Box and Muller, one of the pair).
fn normal(chance: &mut Chance) -> f64 {
    let radius = (-2.0 * (1.0 - chance.unit()).ln()).sqrt();
    radius * (std::f64::consts::TAU * chance.unit()).cos()
}

/// Poisson (Knuth); above a mean of 40 a rounded normal.
fn poisson(chance: &mut Chance, mean: f64) -> f64 {
    if mean > 40.0 {
        return (mean + mean.sqrt() * normal(chance)).round().max(0.0);
    }
    let limit = (-mean).exp();
    let (mut count, mut product) = (0.0, chance.unit());
    while product > limit {
        count += 1.0;
        product *= chance.unit();
    }
    count
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Grey of 0.2 at a tenth of the light is 200 of 1000 electrons: noise sqrt(200 + 2.5^2).
    #[test]
    fn noise_is_that_of_counted_electrons() {
        let film = Film {
            light: 0.1,
            read_electrons: 2.5,
        };
        let table = EncodingTable::new(Encoding::Srgb);
        for (grey, wanted) in [(0.2_f32, 206.25_f64.sqrt()), (0.02, 26.25_f64.sqrt())] {
            let codes = film.develop(&vec![grey; 30_000], 5);
            let electrons = |code: &u8| f64::from(table.light(*code)) * 1000.0;
            let n = codes.len() as f64;
            let mean = codes.iter().map(electrons).sum::<f64>() / n;
            let spread = codes
                .iter()
                .map(|c| (electrons(c) - mean).powi(2))
                .sum::<f64>()
                / n;
            assert!((mean - 1000.0 * f64::from(grey)).abs() < 0.4, "{mean}");
            assert!(
                (spread.sqrt() / wanted - 1.0).abs() < 0.03,
                "{} {wanted}",
                spread.sqrt()
            );
            assert_eq!(codes, film.develop(&vec![grey; 30_000], 5));
            assert_ne!(codes, film.develop(&vec![grey; 30_000], 6));
        }
    }
}

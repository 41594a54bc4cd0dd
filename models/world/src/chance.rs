//! Reproducible chance: a seeded generator and a stateless hash, both independent of thread order.

/// Odd constants of `SplitMix64` (Steele, Lea, Flood: Fast splittable pseudorandom number
/// generators, 2014).
const GOLDEN: u64 = 0x9e37_79b9_7f4a_7c15;

fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// What a stream of chance is for; every use has its own, so that adding one draw never shifts
/// another.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Purpose {
    Road = 1,
    Facades,
    Cars,
    Walkers,
    Poles,
    Lights,
    Exposure,
    Camera,
    Pixels,
    Lidar,
    Motion,
    Clocks,
    Strobe,
    Images,
    Packets,
    Transfers,
}

/// A seeded stream of random numbers (`SplitMix64`).
#[derive(Debug, Clone)]
pub(crate) struct Dice {
    state: u64,
}

impl Dice {
    /// The stream of `seed` for one purpose.
    pub(crate) fn new(seed: u64, purpose: Purpose) -> Self {
        Self::numbered(seed, purpose, 0)
    }

    /// The `index`-th independent stream of `seed` for one purpose.
    pub(crate) fn numbered(seed: u64, purpose: Purpose, index: u64) -> Self {
        let state = mix(mix(seed ^ mix(purpose as u64)) ^ index.wrapping_mul(GOLDEN));
        Self { state }
    }

    pub(crate) fn bits(&mut self) -> u64 {
        self.state = self.state.wrapping_add(GOLDEN);
        mix(self.state)
    }

    /// Uniform in `[0, 1)`.
    pub(crate) fn unit(&mut self) -> f64 {
        (self.bits() >> 11) as f64 * (1.0 / 9_007_199_254_740_992.0)
    }

    /// Uniform in `[low, high)`.
    pub(crate) fn range(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// `true` with probability `p`.
    pub(crate) fn chance(&mut self, p: f64) -> bool {
        self.unit() < p
    }

    /// Standard normal (Box-Muller, one of the pair).
    pub(crate) fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.unit()).ln()).sqrt();
        radius * (core::f64::consts::TAU * self.unit()).cos()
    }

    /// Exponential with the given mean.
    pub(crate) fn exponential(&mut self, mean: f64) -> f64 {
        -mean * (1.0 - self.unit()).ln()
    }

    /// Poisson; above a mean of 40 a rounded normal, whose error is far below the read noise.
    pub(crate) fn poisson(&mut self, mean: f64) -> f64 {
        if mean > 40.0 {
            return (mean + mean.sqrt() * self.normal()).round().max(0.0);
        }
        let limit = (-mean).exp();
        let mut count = 0.0;
        let mut product = self.unit();
        while product > limit {
            count += 1.0;
            product *= self.unit();
        }
        count
    }
}

/// 32 well-mixed bits from an index and a key; a few integer operations, so that loops over
/// pixels vectorise.
#[inline]
pub(crate) fn hash32(index: u32, key: u32) -> u32 {
    let mut h = index.wrapping_mul(0x9e37_79b1) ^ key;
    h ^= h >> 15;
    h = h.wrapping_mul(0x85eb_ca6b);
    h ^= h >> 13;
    h = h.wrapping_mul(0xc2b2_ae35);
    h ^ (h >> 16)
}

/// Uniform in `[0, 1)` from the top 24 bits of a hash.
#[inline]
pub(crate) fn unit32(hash: u32) -> f32 {
    (hash >> 8) as i32 as f32 * (1.0 / 16_777_216.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn moments(draws: impl Iterator<Item = f64>) -> (f64, f64) {
        let all: Vec<f64> = draws.collect();
        let n = all.len() as f64;
        let mean = all.iter().sum::<f64>() / n;
        let variance = all.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n;
        (mean, variance)
    }

    #[test]
    fn draws_have_the_moments_of_their_distributions() {
        let mut dice = Dice::new(7, Purpose::Road);
        let (mean, variance) = moments((0..40_000).map(|_| dice.normal()));
        assert!(mean.abs() < 0.02 && (variance - 1.0).abs() < 0.03);
        for expected in [0.3, 3.0, 60.0] {
            let (mean, variance) = moments((0..40_000).map(|_| dice.poisson(expected)));
            assert!(
                (mean / expected - 1.0).abs() < 0.03,
                "{mean} for {expected}"
            );
            assert!((variance / expected - 1.0).abs() < 0.05);
        }
        let (mean, _) = moments((0..40_000).map(|_| dice.exponential(2.0)));
        assert!((mean - 2.0).abs() < 0.05);
    }

    #[test]
    fn streams_do_not_depend_on_each_other() {
        let first = Dice::numbered(1, Purpose::Camera, 0).bits();
        assert_ne!(first, Dice::numbered(1, Purpose::Camera, 1).bits());
        assert_ne!(first, Dice::numbered(2, Purpose::Camera, 0).bits());
        assert_ne!(first, Dice::numbered(1, Purpose::Lidar, 0).bits());
        assert_eq!(first, Dice::numbered(1, Purpose::Camera, 0).bits());
    }

    #[test]
    fn pixel_hashes_are_uniform() {
        let (mean, variance) = moments((0..65_536).map(|i| f64::from(unit32(hash32(i, 99)))));
        assert!((mean - 0.5).abs() < 0.01 && (variance - 1.0 / 12.0).abs() < 0.002);
    }
}

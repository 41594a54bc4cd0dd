//! Starting values for a new network, the same for the same seed everywhere.
//!
//! The generator is that of `numpy.random.RandomState`: a Mersenne Twister (Matsumoto and
//! Nishimura 1998) with polar Gaussians (Marsaglia). Weights started here equal those the PyTorch
//! reference starts from the same seed, so training runs can be compared from step 0.

use crate::params::{Init, Slot};
use crate::rdu::bank;

/// Values for every slot, drawn in the order of the slots' names.
pub(crate) fn initial_values(mut slots: Vec<Slot>, seed: u32) -> Vec<(Slot, Vec<f32>)> {
    slots.sort_by(|a, b| a.name.cmp(&b.name));
    let mut gaussian = Gaussian::new(seed);
    slots
        .into_iter()
        .map(|slot| {
            let values = match slot.init {
                Init::Constant(value) => vec![value; slot.len()],
                Init::Atoms { level } => bank(level),
                Init::Normal { gain } => {
                    let fan_in: usize = slot.shape[1..].iter().product();
                    #[allow(clippy::cast_precision_loss, reason = "a fan-in fits a double")]
                    let deviation = (2.0 / fan_in as f64).sqrt() * gain;
                    (0..slot.len())
                        .map(|_| single(gaussian.draw() * deviation))
                        .collect()
                }
            };
            (slot, values)
        })
        .collect()
}

#[allow(
    clippy::cast_possible_truncation,
    reason = "rounding to single precision"
)]
fn single(value: f64) -> f32 {
    value as f32
}

/// Standard normal numbers, two per accepted pair of uniform ones.
struct Gaussian {
    twister: Twister,
    spare: Option<f64>,
}

impl Gaussian {
    fn new(seed: u32) -> Self {
        Self {
            twister: Twister::new(seed),
            spare: None,
        }
    }

    fn draw(&mut self) -> f64 {
        if let Some(spare) = self.spare.take() {
            return spare;
        }
        loop {
            let a = 2.0 * self.twister.uniform() - 1.0;
            let b = 2.0 * self.twister.uniform() - 1.0;
            let square = a * a + b * b;
            if square < 1.0 && square != 0.0 {
                let factor = (-2.0 * square.ln() / square).sqrt();
                self.spare = Some(factor * a);
                return factor * b;
            }
        }
    }
}

const STATE_LEN: usize = 624;

/// MT19937.
struct Twister {
    state: [u32; STATE_LEN],
    next: usize,
}

impl Twister {
    fn new(seed: u32) -> Self {
        let mut state = [seed; STATE_LEN];
        let mut last = seed;
        for (index, word) in (0u32..).zip(&mut state).skip(1) {
            last = (last ^ (last >> 30))
                .wrapping_mul(1_812_433_253)
                .wrapping_add(index);
            *word = last;
        }
        Self {
            state,
            next: STATE_LEN,
        }
    }

    fn refill(&mut self) {
        for i in 0..STATE_LEN {
            let joined =
                (self.state[i] & 0x8000_0000) | (self.state[(i + 1) % STATE_LEN] & 0x7fff_ffff);
            let odd = if joined & 1 == 1 { 0x9908_b0df } else { 0 };
            self.state[i] = self.state[(i + 397) % STATE_LEN] ^ (joined >> 1) ^ odd;
        }
        self.next = 0;
    }

    fn word(&mut self) -> u32 {
        if self.next == STATE_LEN {
            self.refill();
        }
        let mut y = self.state[self.next];
        self.next += 1;
        y ^= y >> 11;
        y ^= (y << 7) & 0x9d2c_5680;
        y ^= (y << 15) & 0xefc6_0000;
        y ^ (y >> 18)
    }

    /// Uniform in 0 to 1, 53 bits.
    fn uniform(&mut self) -> f64 {
        let (high, low) = (f64::from(self.word() >> 5), f64::from(self.word() >> 6));
        (high * 67_108_864.0 + low) / 9_007_199_254_740_992.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_twister_is_the_published_one() {
        // Seed 5489 is the default of std::mt19937, whose 10000th word the C++ standard states
        // ([rand.predef]).
        let mut twister = Twister::new(5489);
        let words: Vec<u32> = (0..10_000).map(|_| twister.word()).collect();
        assert_eq!(words[9_999], 4_123_659_995);
    }

    #[test]
    fn gaussians_have_the_right_moments_and_depend_on_the_seed() {
        let mut gaussian = Gaussian::new(1);
        let draws: Vec<f64> = (0..20_000).map(|_| gaussian.draw()).collect();
        let mean = draws.iter().sum::<f64>() / 2e4;
        let square = draws.iter().map(|d| d * d).sum::<f64>() / 2e4;
        assert!(
            mean.abs() < 0.03 && (square - 1.0).abs() < 0.04,
            "{mean} {square}"
        );
        assert_ne!(Gaussian::new(2).draw(), draws[0]);
    }
}

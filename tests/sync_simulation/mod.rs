//! Simulated clocks with a known truth, shared by the tests of synchronisation.
#![allow(
    dead_code,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "each test program uses its own part; simulated instants are positive and small"
)]

use noctule_sensor::{Clock, Evk4, Stamp};

pub const MS: f64 = 1e6;
pub const S: f64 = 1e9;

/// Xorshift, so that a seed gives the same stream for ever.
pub struct Chance(u64);

impl Chance {
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1)
    }

    pub fn uniform(&mut self) -> f64 {
        for _ in 0..2 {
            self.0 ^= self.0 << 13;
            self.0 ^= self.0 >> 7;
            self.0 ^= self.0 << 17;
        }
        (self.0 >> 11) as f64 / (1_u64 << 53) as f64
    }

    pub fn exponential(&mut self, mean: f64) -> f64 {
        -mean * (1.0 - self.uniform()).ln()
    }

    pub fn normal(&mut self, sd: f64) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        sd * radius * (core::f64::consts::TAU * self.uniform()).cos()
    }

    pub fn is(&mut self, probability: f64) -> bool {
        self.uniform() < probability
    }
}

/// A sensor clock against the host's: both count nanoseconds, from different zeros.
#[derive(Clone, Copy)]
pub struct Oscillator {
    pub zero: f64,
    pub skew: f64,
}

impl Oscillator {
    pub fn any(chance: &mut Chance) -> Self {
        Self {
            zero: chance.uniform() * 500.0 * S,
            skew: (chance.uniform() * 2.0 - 1.0) * 50e-6,
        }
    }

    /// What it shows at host time `t`, in fractional nanoseconds.
    pub fn shows(&self, t: f64) -> f64 {
        self.zero + t * (1.0 + self.skew)
    }
}

/// Host time zero of the simulations, nanoseconds since 1970.
pub const HOST: u64 = 1_700_000_000_000_000_000;

pub fn host<C: Clock>(t: f64) -> Stamp<C> {
    Stamp::from_nanos(HOST + t.round() as u64)
}

pub fn ticks(nanos: f64) -> Stamp<Evk4> {
    Stamp::from_micros((nanos / 1e3) as u64)
}

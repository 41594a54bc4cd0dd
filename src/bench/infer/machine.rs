//! What one core of this machine can do at most: multiply-adds and bytes per second.

use std::time::Instant;

use noctule_kernels::{Isa, Precision, spin, stream};

/// About as much memory as the features of a small network take.
const STREAM_BYTES: usize = 16 << 20;
/// Tries; the best counts, as other work on the machine can only slow it down.
const TRIES: usize = 20;

/// Peaks of one core.
#[derive(Debug, Clone, Copy)]
pub(super) struct Machine {
    /// Single precision, operations per second, two per multiply-add.
    pub flops_f32: f64,
    /// bfloat16 with single-precision sums.
    pub flops_bf16: f64,
    /// Bytes read and written per second.
    pub bandwidth: f64,
}

impl Machine {
    pub fn measure(isa: Isa) -> Self {
        Self {
            flops_f32: flops(isa, Precision::Single),
            flops_bf16: flops(isa, Precision::Brain),
            bandwidth: bandwidth(isa),
        }
    }

    /// Measures once more and keeps the better figures.
    pub fn measure_again(&mut self, isa: Isa) {
        let again = Self::measure(isa);
        self.flops_f32 = self.flops_f32.max(again.flops_f32);
        self.flops_bf16 = self.flops_bf16.max(again.flops_bf16);
        self.bandwidth = self.bandwidth.max(again.bandwidth);
    }

    pub fn flops(&self, precision: &str) -> f64 {
        if precision == precision_name(Precision::Brain) {
            self.flops_bf16
        } else {
            self.flops_f32
        }
    }
}

/// The name used in rows and on the command line.
pub(super) fn precision_name(precision: Precision) -> &'static str {
    match precision {
        Precision::Single => "f32",
        Precision::Brain => "bf16",
    }
}

fn best(mut rate: impl FnMut() -> f64) -> f64 {
    (0..TRIES).map(|_| rate()).fold(0.0, f64::max)
}

#[expect(clippy::cast_precision_loss, reason = "a rate of three digits")]
fn flops(isa: Isa, precision: Precision) -> f64 {
    best(|| {
        let started = Instant::now();
        let done = spin(isa, precision, 200_000).unwrap_or(0);
        done as f64 / started.elapsed().as_secs_f64()
    })
}

#[expect(clippy::cast_precision_loss, reason = "a rate of three digits")]
fn bandwidth(isa: Isa) -> f64 {
    let mut memory = vec![1e-30; STREAM_BYTES / size_of::<f32>()];
    best(|| {
        let started = Instant::now();
        let moved = stream(isa, &mut memory, 2).unwrap_or(0);
        moved as f64 / started.elapsed().as_secs_f64()
    })
}

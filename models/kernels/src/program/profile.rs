//! How long every operation takes: measured apart from the steady path.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use super::crew::Barrier;

/// One operation of one pass: its work and its time.
#[derive(Debug, Clone, PartialEq)]
pub struct OpProfile {
    /// The label it was described under.
    pub name: String,
    /// What it is and its shape, such as `conv 3x3/2 16-32`.
    pub kind: String,
    /// The pass it was timed in.
    pub pass: usize,
    /// Height and width of what it computes, in pixels; before the store enlarges it.
    pub size: [usize; 2],
    /// Multiply-adds on the channels there are. Adaptive fields count as they are computed:
    /// coefficients, kernels from atoms, windows over the taps some atom uses, mixture.
    pub macs: u64,
    /// Bytes of the features, planes and slices read and written, each once, margins and padded
    /// channels not counted.
    pub feature_bytes: u64,
    /// Bytes of the weights, each once.
    pub weight_bytes: u64,
    /// Shortest time, in seconds, from barrier to barrier.
    pub seconds: f64,
}

impl OpProfile {
    /// The least time in seconds on a machine of `flops` floating-point operations and
    /// `bandwidth` bytes per second: whichever of computing and moving takes longer (roofline).
    #[allow(clippy::cast_precision_loss, reason = "counts far below 2^53")]
    pub fn bound(&self, flops: f64, bandwidth: f64) -> f64 {
        let compute = 2.0 * self.macs as f64 / flops;
        let moving = (self.feature_bytes + self.weight_bytes) as f64 / bandwidth;
        compute.max(moving)
    }
}

/// Shortest times of the operations of one pass, in nanoseconds.
pub(super) struct Times(Vec<AtomicU64>);

/// Takes down times while a crew works.
pub(super) struct Watch<'a> {
    times: &'a [AtomicU64],
    barrier: &'a Barrier,
}

impl Times {
    pub(super) fn new(count: usize) -> Self {
        Self((0..count).map(|_| AtomicU64::new(u64::MAX)).collect())
    }

    pub(super) fn watch<'a>(&'a self, barrier: &'a Barrier) -> Watch<'a> {
        Watch {
            times: &self.0,
            barrier,
        }
    }

    #[allow(clippy::cast_precision_loss, reason = "times far below 2^53 ns")]
    pub(super) fn seconds(&self) -> impl Iterator<Item = f64> {
        let seconds = |time: &AtomicU64| time.load(Ordering::Relaxed) as f64 / 1e9;
        self.0.iter().map(seconds)
    }
}

impl Watch<'_> {
    /// Does `work` between two barriers; the first thread of the crew times it. Nobody starts
    /// before it has read its clock: a thread that loses its processor there would otherwise find
    /// its work done by the others, and almost no time gone.
    pub(super) fn around(&self, thread: usize, place: usize, work: impl FnOnce()) {
        self.barrier.wait();
        let started = Instant::now();
        self.barrier.wait();
        work();
        self.barrier.wait();
        if thread == 0 {
            let spent = u64::try_from(started.elapsed().as_nanos()).unwrap_or(u64::MAX);
            self.times[place].fetch_min(spent, Ordering::Relaxed);
        }
    }
}

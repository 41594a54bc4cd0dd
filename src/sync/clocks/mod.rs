//! Clock maps: from pairs of readings, from arrivals, from the host's own clocks, and all of them
//! together onto TAI.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::cast_precision_loss,
    reason = "nanoseconds within an epoch stay below 2^53; `as` from float saturates"
)]

mod envelope;
mod epoch;
mod host;
mod hull;
mod line;
mod paired;
mod timeline;

pub use envelope::{EnvelopeConfig, EnvelopeFit};
pub use epoch::{EpochCause, FitCounts, Observation};
pub use host::{ClockReading, HostClocks};
pub use paired::{PairedConfig, PairedFit};
pub use timeline::{MapSource, SensorClock, Timeline, TimelineConfig, TimelineCounts};

/// How fast one clock runs against another, and how well that is known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RateEstimate {
    /// Advance of the second clock beyond the first, parts per billion.
    pub rate_ppb: f64,
    /// Standard deviation of that, parts per billion.
    pub sd_ppb: f64,
}

/// A slope in parts per billion, rounded.
fn to_ppb(slope: f64) -> i64 {
    (slope * 1e9).round() as i64
}

/// A bound in whole units, rounded up.
fn to_bound_ns(bound: f64) -> u64 {
    if bound > 0.0 { bound.ceil() as u64 } else { 0 }
}

/// Signed difference of two instants of one clock, saturating.
fn signed(later: u64, earlier: u64) -> i64 {
    let d = i128::from(later) - i128::from(earlier);
    i64::try_from(d).unwrap_or(if d < 0 { i64::MIN } else { i64::MAX })
}

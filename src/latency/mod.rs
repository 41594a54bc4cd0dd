//! How long things take, told honestly: fixed-size histograms, counts beside them, one report.
//!
//! A percentile is shown only when there are samples enough to mean it, a mean never.

mod histogram;
mod report;

pub use histogram::Latency;
pub use report::{StageRow, StreamRow, table_of_stages, table_of_streams};

/// `CLOCK_MONOTONIC` now, nanoseconds: the clock of every stage stamp, the same in all processes.
///
/// Only the processes' own threads call this; the core is handed instants.
#[must_use]
pub fn monotonic_ns() -> u64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    // CLOCK_MONOTONIC starts at zero when the machine does.
    u64::try_from(now.tv_sec).unwrap_or(0) * 1_000_000_000 + u64::try_from(now.tv_nsec).unwrap_or(0)
}

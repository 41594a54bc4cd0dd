//! The table of a host benchmark.

use std::fmt::Write as _;

use serde::Serialize;

/// One rate.
#[derive(Debug, Clone, Serialize)]
pub struct HostRow {
    /// Mev/s offered.
    pub rate_mev_s: u32,
    /// Exposures sent.
    pub bundles: u64,
    /// Events taken.
    pub events: u64,
    /// Events rastered.
    pub events_rastered: u64,
    /// Closing bytes received to bundle sent, microseconds.
    pub close_to_sent_p50_us: f64,
    /// As above.
    pub close_to_sent_p99_us: f64,
    /// As above.
    pub close_to_sent_max_us: f64,
    /// The same over a copy of as many bytes.
    pub ratio_p50: f64,
    /// The same over a copy of as many bytes.
    pub ratio_p99: f64,
    /// Exposures whose predicted width was right, a little off, rastered again.
    pub retimed: [u64; 3],
}

/// A host benchmark.
#[derive(Debug, Clone, Serialize)]
pub struct HostBench {
    /// Bytes of a bundle.
    pub bundle_bytes: usize,
    /// A copy of them into memory touched before, microseconds.
    pub copy_p50_us: f64,
    /// As above.
    pub copy_p99_us: f64,
    /// One row per rate.
    pub rows: Vec<HostRow>,
}

impl HostBench {
    /// The table for reading.
    #[must_use]
    pub fn text(&self) -> String {
        #[expect(clippy::cast_precision_loss, reason = "shown with one decimal")]
        let mib = self.bundle_bytes as f64 / f64::from(1 << 20);
        let mut text = format!(
            "bundle of {mib:.1} MiB; a copy of it into touched memory takes p50 {:.2} ms, p99 {:.2} \
             ms\n{:>7} {:>8} {:>12} {:>9} {:>9} {:>9} {:>10} {:>10}  exact/moved/again\n",
            self.copy_p50_us / 1e3,
            self.copy_p99_us / 1e3,
            "Mev/s",
            "bundles",
            "events",
            "p50 ms",
            "p99 ms",
            "max ms",
            "p50/copy",
            "p99/copy",
        );
        for row in &self.rows {
            let [exact, moved, again] = row.retimed;
            let _ = writeln!(
                text,
                "{:>7} {:>8} {:>12} {:>9.2} {:>9.2} {:>9.2} {:>10.2} {:>10.2}  {exact}/{moved}/{again}",
                row.rate_mev_s,
                row.bundles,
                row.events,
                row.close_to_sent_p50_us / 1e3,
                row.close_to_sent_p99_us / 1e3,
                row.close_to_sent_max_us / 1e3,
                row.ratio_p50,
                row.ratio_p99,
            );
        }
        text
    }
}

//! The tables a run ends with.

use std::fmt::Write as _;

use serde::Serialize;

use super::Latency;

/// One stage: what went in, what came out, how long it took.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StageRow {
    /// Which stage.
    pub stage: String,
    /// Frames that should have passed.
    pub offered: u64,
    /// Frames that did.
    pub received: u64,
    /// Frames that did not.
    pub lost: u64,
    /// Median, microseconds.
    pub p50_us: Option<f64>,
    /// 99th percentile, microseconds.
    pub p99_us: Option<f64>,
    /// 99.9th percentile, microseconds; only with 10,000 samples or more.
    pub p999_us: Option<f64>,
    /// Longest, microseconds.
    pub max_us: Option<f64>,
}

impl StageRow {
    /// A row of `latency`'s percentiles.
    #[must_use]
    pub fn new(stage: &str, offered: u64, received: u64, latency: &Latency) -> Self {
        Self {
            stage: stage.to_owned(),
            offered,
            received,
            lost: offered.saturating_sub(received),
            p50_us: latency.percentile_us(50.0),
            p99_us: latency.percentile_us(99.0),
            p999_us: latency.p999_us(),
            max_us: latency.max_us(),
        }
    }
}

/// One sensor's stream: what it delivered and what was lost where.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct StreamRow {
    /// Which sensor.
    pub stream: &'static str,
    /// What is counted.
    pub unit: &'static str,
    /// Units the device produced.
    pub offered: u64,
    /// Units the host took in.
    pub received: u64,
    /// Units that never reached the host, by the device's own numbering.
    pub lost: u64,
    /// Units the host could not take, its ring being full.
    pub shed: u64,
    /// Units that were refused as malformed.
    pub rejected: u64,
}

/// Lays stages out as a text table.
#[must_use]
pub fn table_of_stages(rows: &[StageRow]) -> String {
    let mut text = String::new();
    let width = rows.iter().map(|r| r.stage.len()).max().unwrap_or(0).max(5);
    let _ = writeln!(
        text,
        "{:<width$}  {:>8} {:>8} {:>6} {:>10} {:>10} {:>10} {:>10}",
        "stage", "offered", "received", "lost", "p50 ms", "p99 ms", "p99.9 ms", "max ms"
    );
    for row in rows {
        let ms =
            |us: Option<f64>| us.map_or_else(|| "-".to_owned(), |us| format!("{:.3}", us / 1e3));
        let _ = writeln!(
            text,
            "{:<width$}  {:>8} {:>8} {:>6} {:>10} {:>10} {:>10} {:>10}",
            row.stage,
            row.offered,
            row.received,
            row.lost,
            ms(row.p50_us),
            ms(row.p99_us),
            ms(row.p999_us),
            ms(row.max_us)
        );
    }
    text
}

/// Lays streams out as a text table.
#[must_use]
pub fn table_of_streams(rows: &[StreamRow]) -> String {
    let mut text = String::new();
    let _ = writeln!(
        text,
        "{:<8} {:<10} {:>12} {:>12} {:>8} {:>8} {:>8}",
        "stream", "unit", "offered", "received", "lost", "shed", "rejected"
    );
    for row in rows {
        let _ = writeln!(
            text,
            "{:<8} {:<10} {:>12} {:>12} {:>8} {:>8} {:>8}",
            row.stream, row.unit, row.offered, row.received, row.lost, row.shed, row.rejected
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_counts_what_did_not_arrive() {
        let mut latency = Latency::default();
        latency.record(1, 2_000_001);
        let row = StageRow::new("sent -> received", 10, 9, &latency);
        assert_eq!((row.lost, row.p999_us), (1, None));
        let table = table_of_stages(&[row]);
        assert!(
            table.lines().nth(1).is_some_and(|l| l.contains("2.0")),
            "{table}"
        );
    }
}

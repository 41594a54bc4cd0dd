//! One stage's latencies in a histogram of fixed size, written by one thread.

use hdrhistogram::Histogram;

/// The longest latency told apart from longer ones: one hour.
const NANOS_MAX: u64 = 3_600_000_000_000;

/// Latencies of one stage.
#[derive(Debug, Clone)]
pub struct Latency {
    histogram: Histogram<u64>,
}

impl Default for Latency {
    fn default() -> Self {
        // Fixed bounds: nothing grows while recording. Three digits are valid bounds.
        let histogram = Histogram::new_with_bounds(1_000, NANOS_MAX, 3)
            .expect("bounds and precision are constants that the histogram accepts");
        Self { histogram }
    }
}

impl Latency {
    /// Records the time from `start_ns` to `end_ns`, both on the same clock. Stamps that are zero
    /// were never set and are not recorded.
    pub fn record(&mut self, start_ns: u64, end_ns: u64) {
        if start_ns != 0 && end_ns != 0 {
            self.histogram
                .saturating_record(end_ns.saturating_sub(start_ns).max(1));
        }
    }

    /// How many were recorded.
    #[must_use]
    pub fn count(&self) -> u64 {
        self.histogram.len()
    }

    /// The latency that `percent` of all stay at or under, microseconds; `None` without samples.
    #[must_use]
    #[expect(
        clippy::cast_precision_loss,
        reason = "latencies of under an hour are exact in f64"
    )]
    pub fn percentile_us(&self, percent: f64) -> Option<f64> {
        (self.count() > 0).then(|| self.histogram.value_at_percentile(percent) as f64 / 1e3)
    }

    /// The largest latency, microseconds.
    #[must_use]
    #[expect(
        clippy::cast_precision_loss,
        reason = "latencies of under an hour are exact in f64"
    )]
    pub fn max_us(&self) -> Option<f64> {
        (self.count() > 0).then(|| self.histogram.max() as f64 / 1e3)
    }

    /// p99.9, only when at least 10,000 samples stand behind it.
    #[must_use]
    pub fn p999_us(&self) -> Option<f64> {
        if self.count() >= 10_000 {
            self.percentile_us(99.9)
        } else {
            None
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_within_the_histograms_precision() {
        let mut latency = Latency::default();
        for us in 1..=1000_u64 {
            latency.record(5, 5 + us * 1000);
        }
        let near = |value: Option<f64>, expected: f64| {
            assert!(
                (value.unwrap() - expected).abs() <= expected * 2e-3,
                "{value:?} {expected}"
            );
        };
        near(latency.percentile_us(50.0), 500.0);
        near(latency.percentile_us(99.0), 990.0);
        near(latency.max_us(), 1000.0);
        assert_eq!(latency.p999_us(), None);
    }

    #[test]
    fn unset_stamps_are_no_samples() {
        let mut latency = Latency::default();
        latency.record(0, 10);
        latency.record(10, 0);
        assert_eq!((latency.count(), latency.max_us()), (0, None));
    }
}

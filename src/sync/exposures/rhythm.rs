//! What the strobe has kept to so far: its width and its period.

use noctule_sensor::{Evk4, Stamp};

/// Widths and spacings remembered.
const MEMORY: usize = 7;
/// Spacings needed before a period is believed.
const SPACINGS_MIN: usize = 3;
/// Spacings agree when they differ by less than one part in this many.
const AGREEMENT: i64 = 100;

/// The newest few values, oldest overwritten.
#[derive(Debug, Clone, Copy, Default)]
struct Recent {
    values: [i64; MEMORY],
    len: usize,
    next: usize,
}

impl Recent {
    fn push(&mut self, value: i64) {
        self.values[self.next] = value;
        self.next = (self.next + 1) % MEMORY;
        self.len = (self.len + 1).min(MEMORY);
    }

    fn last(&self) -> Option<i64> {
        (self.len > 0).then(|| self.values[(self.next + MEMORY - 1) % MEMORY])
    }

    fn median(&self) -> Option<i64> {
        let mut sorted = self.values;
        let sorted = &mut sorted[..self.len];
        sorted.sort_unstable();
        sorted.get(self.len / 2).copied()
    }
}

/// Running knowledge of width and period.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Rhythm {
    widths: Recent,
    spacings: Recent,
    period_ns: Option<i64>,
    last_open: Option<Stamp<Evk4>>,
}

impl Rhythm {
    /// The width to put a missing edge back with: the median of the last few.
    pub fn width_ns(&self) -> Option<i64> {
        self.widths.median()
    }

    /// The newest width: what the next exposure is predicted from.
    pub fn last_width_ns(&self) -> Option<i64> {
        self.widths.last()
    }

    /// The period, where the camera keeps one.
    pub fn period_ns(&self) -> Option<i64> {
        self.period_ns
    }

    /// Notes a measured width.
    pub fn width(&mut self, width_ns: i64) {
        self.widths.push(width_ns);
    }

    /// Notes a measured opening edge.
    pub fn open(&mut self, open: Stamp<Evk4>) {
        if let Some(last) = self.last_open {
            let spacing = open.diff_nanos(last);
            // Across a missed exposure the spacing is a multiple.
            let turns = self
                .period_ns
                .map_or(1, |p| (spacing.saturating_add(p / 2) / p).max(1));
            self.spacings.push(spacing / turns);
            self.period_ns = self.agreed_period();
        }
        self.last_open = Some(open);
    }

    /// The median spacing when all but two of the remembered ones agree with it.
    fn agreed_period(&self) -> Option<i64> {
        let period = self.spacings.median().filter(|&p| p > 0)?;
        let agreeing = self.spacings.values[..self.spacings.len]
            .iter()
            .filter(|&&s| s.saturating_sub(period).saturating_abs() <= period / AGREEMENT)
            .count();
        (agreeing >= SPACINGS_MIN && agreeing + 2 >= self.spacings.len).then_some(period)
    }

    /// Whether `at` is a whole number of periods from the last opening edge; false without a
    /// period, and after so many that its own uncertainty spoils the answer.
    pub fn is_in_step(&self, at: Stamp<Evk4>, tolerance_ns: i64) -> bool {
        const TURNS_MAX: i64 = 20;
        let (Some(period), Some(last)) = (self.period_ns, self.last_open) else {
            return false;
        };
        let since = at.diff_nanos(last);
        let turns = since.saturating_add(period / 2).div_euclid(period);
        (1..=TURNS_MAX).contains(&turns) && (since - turns * period).abs() <= tolerance_ns
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rhythm(opens_ms: &[u64]) -> Rhythm {
        let mut rhythm = Rhythm::default();
        for &ms in opens_ms {
            rhythm.open(Stamp::from_micros(ms * 1000));
        }
        rhythm
    }

    #[test]
    fn a_period_is_believed_after_three_spacings_and_survives_a_gap() {
        assert_eq!(rhythm(&[0, 200, 400]).period_ns(), None);
        let kept = rhythm(&[0, 200, 400, 600, 1200]);
        assert_eq!(kept.period_ns(), Some(200_000_000));
        let at = |us: u64| kept.is_in_step(Stamp::from_micros(us), 1_000_000);
        assert!(at(1_400_500) && at(1_999_500) && !at(1_405_000));
        assert!(!at(1_200_000), "the last opening itself is not a new one");
        assert!(
            !at(1_200_000 + 21 * 200_000),
            "too long ago to count periods"
        );
    }

    #[test]
    fn irregular_openings_have_no_period() {
        assert_eq!(rhythm(&[0, 130, 500, 610, 1000, 1700]).period_ns(), None);
    }

    #[test]
    fn the_median_width_ignores_one_bad_one() {
        let mut rhythm = Rhythm::default();
        for width in [80, 80, 260, 81, 80] {
            rhythm.width(width);
        }
        assert_eq!(
            (rhythm.width_ns(), rhythm.last_width_ns()),
            (Some(80), Some(80))
        );
    }
}

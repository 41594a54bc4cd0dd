//! The one place where a wrapping `TIME_HIGH` is widened.

/// What a `TIME_HIGH` word did to the widened time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Step {
    /// The value in force was repeated.
    Same,
    /// Time went on, by a step or past the wrap, or is known for the first time.
    Forward,
    /// Time went back by less than half the range: an error of the stream, taken as is.
    Backward,
}

/// Widens a `TIME_HIGH` of `bits` bits.
///
/// A wrap is a step back by half the range or more; smaller steps back are errors, not wraps.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct TimeHigh {
    bits: u32,
    loops: u64,
    last: Option<u32>,
    known: bool,
    /// Where the next word is expected, in units of the word.
    near: Option<u64>,
}

impl TimeHigh {
    pub(super) const fn new(bits: u32) -> Self {
        Self {
            bits,
            loops: 0,
            last: None,
            known: false,
            near: None,
        }
    }

    /// Whether a word was taken since the start or the last [`forget`](Self::forget).
    #[inline]
    pub(super) const fn is_known(&self) -> bool {
        self.known
    }

    /// The time can no longer be trusted until the next word.
    pub(super) const fn forget(&mut self) {
        self.known = false;
    }

    /// Says where the next word lies, to within half the range.
    pub(super) const fn expect_near(&mut self, units: u64) {
        self.near = Some(units);
        self.known = false;
    }

    /// Takes the next word's value, which has at most `bits` bits.
    pub(super) fn take(&mut self, high: u32) -> Step {
        let half = 1_u32 << (self.bits - 1);
        let was_known = core::mem::replace(&mut self.known, true);
        if let Some(near) = self.near.take() {
            self.loops = nearest_loop(near, high, self.bits);
            self.last = Some(high);
            return Step::Forward;
        }
        let last = self.last.replace(high).unwrap_or(high);
        if high.saturating_add(half) <= last {
            self.loops = self.loops.wrapping_add(1);
            Step::Forward
        } else if high < last {
            Step::Backward
        } else if high == last && was_known {
            Step::Same
        } else {
            Step::Forward
        }
    }

    /// The low 12 bits of the value in force.
    pub(super) fn low_12(&self) -> u16 {
        let [low, high, ..] = self.last.unwrap_or(0).to_le_bytes();
        u16::from_le_bytes([low, high]) & 0xfff
    }

    /// The widened value, in units of the word.
    pub(super) fn widened(&self) -> u64 {
        let high = u64::from(self.last.unwrap_or(0));
        self.loops.wrapping_shl(self.bits) | high
    }
}

/// The loop count that puts `high` nearest to `near`.
fn nearest_loop(near: u64, high: u32, bits: u32) -> u64 {
    let (half, high) = (1_u64 << (bits - 1), u64::from(high));
    // `near - half` is the earliest candidate; take the first value not before it.
    let earliest = near.saturating_sub(half);
    let loops = earliest >> bits;
    if (loops << bits | high) < earliest {
        loops + 1
    } else {
        loops
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_wrap_is_a_step_back_by_half_the_range_or_more() {
        let mut time = TimeHigh::new(12);
        assert_eq!(time.take(4095), Step::Forward);
        assert_eq!(time.take(4095), Step::Same);
        assert_eq!(time.take(2047), Step::Forward);
        assert_eq!(time.widened(), 4096 + 2047);
        assert_eq!(time.take(4094), Step::Forward);
        assert_eq!(time.take(2047), Step::Backward);
        assert_eq!(time.widened(), 4096 + 2047);
    }

    #[test]
    fn hours_of_wraps_add_up() {
        let mut time = TimeHigh::new(12);
        for units in 0..4096_u32 * 1000 {
            assert_eq!(time.take(units % 4096), Step::Forward);
            assert_eq!(time.widened(), u64::from(units));
        }
    }

    #[test]
    fn a_hint_finds_the_loop_from_either_side() {
        for true_units in [0_u64, 1, 2047, 4095, 4096, 1_000_000, 123_456_789] {
            let high = u32::try_from(true_units % 4096).unwrap();
            for error in [-2047_i64, -1, 0, 1, 2047] {
                let Some(near) = true_units.checked_add_signed(error) else {
                    continue;
                };
                let mut time = TimeHigh::new(12);
                time.expect_near(near);
                assert_eq!(time.take(high), Step::Forward);
                assert_eq!(time.widened(), true_units, "hint off by {error}");
            }
        }
    }

    #[test]
    fn a_forgotten_time_keeps_its_loops() {
        let mut time = TimeHigh::new(12);
        for high in [4000, 10, 20] {
            time.take(high);
        }
        time.forget();
        assert!(!time.is_known());
        assert_eq!(time.take(20), Step::Forward);
        assert_eq!(time.widened(), 4096 + 20);
    }
}

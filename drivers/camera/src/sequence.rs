//! Frames that never came, came late, or came twice, from the driver's counter alone.

/// How many earlier numbers are remembered to tell a late frame from a repeated one.
const HISTORY: u32 = 64;

/// What the counter has shown so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SequenceCounts {
    /// Frames taken in, duplicates included.
    pub received: u64,
    /// Numbers skipped and not seen since.
    pub lost: u64,
    /// Frames that came after a higher number.
    pub late: u64,
    /// Numbers seen before.
    pub duplicate: u64,
}

/// Follows a wrapping 32-bit frame counter.
///
/// The difference to the newest number is taken as signed 32 bit: +1 is in order, +k means k - 1
/// missing so far, zero a duplicate; a negative one is late (one missing less) or, if that number
/// was seen within the last 64, a duplicate. Older ones, and ones before the first, count as late and
/// take nothing back.
#[derive(Debug, Clone, Default)]
pub struct SequenceMonitor {
    newest: Option<u32>,
    /// Bit k: number `newest - k` was seen.
    seen: u64,
    /// Distance from the first number to the newest, capped at the history's length.
    span: u32,
    counts: SequenceCounts,
}

impl SequenceMonitor {
    /// A monitor that has seen nothing.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            newest: None,
            seen: 0,
            span: 0,
            counts: SequenceCounts {
                received: 0,
                lost: 0,
                late: 0,
                duplicate: 0,
            },
        }
    }

    /// Takes the next frame's number; gives how many numbers it skipped.
    pub fn push(&mut self, sequence: u32) -> u32 {
        self.counts.received += 1;
        let Some(newest) = self.newest else {
            (self.newest, self.seen, self.span) = (Some(sequence), 1, 0);
            return 0;
        };
        let step = sequence.wrapping_sub(newest).cast_signed();
        if step > 0 {
            let step = step.unsigned_abs();
            self.seen = self.seen.checked_shl(step).unwrap_or(0) | 1;
            self.newest = Some(sequence);
            self.span = self.span.saturating_add(step).min(HISTORY);
            self.counts.lost += u64::from(step - 1);
            return step - 1;
        }
        self.push_behind(step.unsigned_abs());
        0
    }

    fn push_behind(&mut self, behind: u32) {
        // A number before the first was never counted as lost, nor one too old to remember.
        if behind >= HISTORY || behind > self.span {
            self.counts.late += 1;
        } else if self.seen >> behind & 1 == 1 {
            self.counts.duplicate += 1;
        } else {
            self.seen |= 1 << behind;
            self.counts.late += 1;
            self.counts.lost -= 1;
        }
    }

    /// The counts so far.
    #[must_use]
    pub const fn counts(&self) -> SequenceCounts {
        self.counts
    }

    /// Forgets the newest number but keeps the counts: for a stream that was restarted.
    pub const fn restart(&mut self) {
        self.newest = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn after(numbers: &[u32]) -> SequenceCounts {
        let mut monitor = SequenceMonitor::new();
        for &n in numbers {
            monitor.push(n);
        }
        monitor.counts()
    }

    const fn counts(received: u64, lost: u64, late: u64, duplicate: u64) -> SequenceCounts {
        SequenceCounts {
            received,
            lost,
            late,
            duplicate,
        }
    }

    #[test]
    fn order_gaps_swaps_and_repeats() {
        assert_eq!(after(&[5, 6, 7]), counts(3, 0, 0, 0));
        assert_eq!(after(&[5, 8]), counts(2, 2, 0, 0));
        assert_eq!(after(&[5, 7, 6, 8]), counts(4, 0, 1, 0));
        assert_eq!(after(&[5, 5, 6, 5]), counts(4, 0, 0, 2));
        assert_eq!(after(&[5, 7, 6, 6]), counts(4, 0, 1, 1));
    }

    #[test]
    fn the_counter_wraps_without_loss() {
        assert_eq!(after(&[u32::MAX - 1, u32::MAX, 0, 1]), counts(4, 0, 0, 0));
        assert_eq!(after(&[u32::MAX, 1]), counts(2, 1, 0, 0));
        assert_eq!(after(&[u32::MAX, 1, 0]), counts(3, 0, 1, 0));
    }

    #[test]
    fn frames_before_the_first_take_nothing_back() {
        assert_eq!(after(&[10, 9]), counts(2, 0, 1, 0));
        assert_eq!(after(&[100, 0, 101]), counts(3, 0, 1, 0));
    }

    #[test]
    fn a_restarted_stream_is_not_a_gap() {
        let mut monitor = SequenceMonitor::new();
        monitor.push(1000);
        monitor.restart();
        assert_eq!(monitor.push(0), 0);
        assert_eq!(monitor.counts(), counts(2, 0, 0, 0));
    }

    proptest! {
        /// Any reordering within the history of a gapless run loses nothing in the end.
        #[test]
        fn shuffled_neighbours_are_late_and_not_lost(
            first: u32, swaps in proptest::collection::vec(0usize..199, 0..40),
        ) {
            let mut order: Vec<u32> = (0..200).map(|k| first.wrapping_add(k)).collect();
            for at in swaps {
                if at > 0 {
                    order.swap(at, at + 1);
                }
            }
            let result = after(&order);
            prop_assert_eq!((result.received, result.lost, result.duplicate), (200, 0, 0));
        }

        #[test]
        fn no_order_panics_and_every_frame_is_one_thing(numbers: Vec<u32>) {
            let result = after(&numbers);
            prop_assert!(result.late + result.duplicate <= result.received);
        }
    }
}

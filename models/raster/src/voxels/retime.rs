//! Which events change place when an exposure's width turns out another than predicted.

use super::history::PackedEvent;
use super::timing::{HALVES_PER_STEP, Timing};

/// Longest exposure whose changes are marked, microseconds (one bit each: 128 KiB).
const MARKED_US_MAX: u32 = 1 << 20;
/// Events looked at between two checks of the room left.
const BATCH: usize = 256;

/// One bit per microsecond since the opening: set where step, bin or weight differ.
#[derive(Debug)]
pub(super) struct Changes {
    words: Box<[u64]>,
    /// Microseconds marked; those beyond lie outside both exposures and change nothing.
    len: u32,
}

impl Changes {
    pub fn new() -> Self {
        Self {
            words: vec![0; MARKED_US_MAX as usize / 64 + 1].into_boxed_slice(),
            len: 0,
        }
    }

    /// Whether exposures of these two widths can be marked.
    pub fn hold(old: &Timing, new: &Timing) -> bool {
        old.open == new.open && old.width.max(new.width) <= MARKED_US_MAX
    }

    /// Whether walking the events and moving the changed ones beats rastering anew: where a width
    /// differs by d, a boundary between weights moves by up to d, d / 2 in the mean.
    pub fn is_worth_it(old: &Timing, new: &Timing, steps: usize) -> bool {
        let boundaries = steps as u64 * HALVES_PER_STEP / 2;
        let moved = u64::from(old.width.abs_diff(new.width)) * boundaries / 2;
        Self::hold(old, new) && 3 * moved <= u64::from(old.width.max(new.width))
    }

    /// Marks nothing; for exposures of up to `longest` microseconds.
    pub fn clear(&mut self, longest: u32) {
        self.len = longest.min(MARKED_US_MAX);
        self.words[..=self.len as usize / 64].fill(0);
    }

    /// Marks the microseconds whose place differs between two exposures that open together, neither
    /// longer than was cleared for.
    ///
    /// A place changes where its half-weights become odd (the weight rounds up) or reach a new
    /// step; half-weights reach n at elapsed = ceil(n * width / N). Between the two exposures'
    /// instants for the same n, places differ. Takes time in proportion to their difference.
    pub fn mark(&mut self, old: &Timing, new: &Timing, steps: usize) {
        let parts = steps as u64 * HALVES_PER_STEP;
        let reach = |timing: &Timing, halves: u64| {
            (halves * u64::from(timing.width)).div_ceil(parts) as u32 // at most the width
        };
        for step in 0..steps as u64 {
            let odd = (1..HALVES_PER_STEP).step_by(2);
            for within in odd.chain([HALVES_PER_STEP]) {
                let halves = step * HALVES_PER_STEP + within;
                let (a, b) = (reach(old, halves), reach(new, halves));
                for elapsed in a.min(b)..a.max(b) {
                    self.words[elapsed as usize / 64] |= 1 << (elapsed % 64);
                }
            }
        }
    }

    /// 1 when the place of an event `elapsed` microseconds after the opening differs, else 0.
    #[inline(always)]
    fn at(&self, elapsed: u32) -> usize {
        let elapsed = elapsed.min(self.len); // the bit at `len` is never set
        (self.words[elapsed as usize / 64] >> (elapsed % 64)) as usize & 1
    }
}

/// A bounded list of events, allocated once.
#[derive(Debug)]
pub(super) struct EventList {
    events: Vec<PackedEvent>,
    is_complete: bool,
}

impl EventList {
    pub fn new(capacity: usize) -> Self {
        Self {
            events: Vec::with_capacity(capacity),
            is_complete: true,
        }
    }

    /// Empties the list; `is_complete` is `false` for a list that must not be relied on.
    pub fn clear(&mut self, is_complete: bool) {
        self.events.clear();
        self.is_complete = is_complete;
    }

    /// Whether all events offered found room.
    pub fn is_complete(&self) -> bool {
        self.is_complete
    }

    pub fn events(&self) -> &[PackedEvent] {
        &self.events
    }

    /// Appends the marked ones of `events`, if there is room.
    pub fn gather(&mut self, changes: &Changes, timing: &Timing, events: &[PackedEvent]) {
        for batch in events.chunks(BATCH) {
            if !self.is_complete {
                return;
            }
            // Without branching: which events are marked cannot be predicted.
            let mut marked = [PackedEvent::default(); BATCH];
            let mut count = 0;
            for event in batch {
                marked[count % BATCH] = *event;
                count += changes.at(timing.elapsed(event.t_us));
            }
            if self.events.len() + count > self.events.capacity() {
                self.is_complete = false;
            } else {
                self.events.extend_from_slice(&marked[..count]);
            }
        }
    }

    /// Puts the events in order of time; they nearly always are.
    pub fn sort(&mut self, timing: &Timing) {
        let elapsed = |event: &PackedEvent| timing.elapsed(event.t_us);
        if !self.events.is_sorted_by_key(elapsed) {
            self.events.sort_unstable_by_key(elapsed);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Exposure;

    fn timing(width: u64, steps: usize) -> Timing {
        Timing::new(Exposure::from_micros(9, 9 + width).unwrap(), steps)
    }

    #[test]
    fn marks_are_exactly_the_places_that_differ() {
        let mut changes = Changes::new();
        let widths = [
            1u64, 2, 7, 64, 100, 999, 1000, 16_384, 20_000, 20_001, 20_007,
        ];
        for steps in [1, 3, 8] {
            let pairs = widths.into_iter().flat_map(|a| widths.map(|b| (a, b)));
            for (a, b) in pairs.filter(|(a, b)| a.abs_diff(*b) < 1000) {
                let (old, new) = (timing(a, steps), timing(b, steps));
                changes.clear(old.width.max(new.width));
                changes.mark(&old, &new, steps);
                let place = |timing: &Timing, e: u32| (e < timing.width).then(|| timing.place(e));
                for e in (0..a.max(b) as u32 + 70).chain([u32::MAX]) {
                    let differs = place(&old, e) != place(&new, e);
                    assert_eq!(
                        changes.at(e) == 1,
                        differs,
                        "{e} us of {a} -> {b} in {steps}"
                    );
                }
            }
        }
    }

    #[test]
    fn a_list_says_when_it_ran_out_of_room() {
        let mut changes = Changes::new();
        let (old, new) = (timing(1000, 8), timing(2000, 8));
        changes.clear(2000);
        changes.mark(&old, &new, 8);
        let late = PackedEvent::new(9 + 999, 0, 0, true).unwrap();
        let early = PackedEvent::new(9 + 500, 1, 0, true).unwrap();
        let first = PackedEvent::new(9, 2, 0, true).unwrap();
        let mut list = EventList::new(3);
        list.gather(&changes, &old, &[late, first, early]);
        assert_eq!(
            (list.events(), list.is_complete()),
            (&[late, early][..], true)
        );
        list.sort(&old);
        assert_eq!(list.events(), [early, late]);
        list.gather(&changes, &old, &[late, late]);
        assert!(!list.is_complete());
        list.clear(true);
        assert!(list.is_complete() && list.events().is_empty());
    }
}

//! Which microseconds of an exposure change place when its width turns out another than predicted.

use super::timing::{HALVES_PER_STEP, Timing};

/// Longest exposure whose changes are marked, microseconds (one bit each: 128 KiB).
pub(super) const MARKED_US_MAX: u32 = 1 << 20;

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

    /// Whether walking the events and moving the changed ones beats rastering anew: where a width
    /// differs by d, a boundary between weights moves by up to d, d / 2 in the mean.
    pub fn is_worth_it(old: &Timing, new: &Timing, steps: usize) -> bool {
        let longer = old.width.max(new.width);
        let boundaries = steps as u64 * HALVES_PER_STEP / 2;
        old.open == new.open
            && longer <= MARKED_US_MAX
            && u64::from(old.width.abs_diff(new.width)) * boundaries <= u64::from(longer)
    }

    /// Marks the microseconds whose place differs between two exposures that open together.
    ///
    /// A place changes where its half-weights become odd (the weight rounds up) or reach a new
    /// step; half-weights reach n at elapsed = ceil(n * width / N). Between the two exposures'
    /// instants for the same n, places differ.
    pub fn mark(&mut self, old: &Timing, new: &Timing, steps: usize) {
        self.len = old.width.max(new.width);
        self.words[..=self.len as usize / 64].fill(0);
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
    pub fn at(&self, elapsed: u32) -> usize {
        let elapsed = elapsed.min(self.len); // the bit at `len` is never set
        (self.words[elapsed as usize / 64] >> (elapsed % 64)) as usize & 1
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Exposure;

    #[test]
    fn marks_are_exactly_the_places_that_differ() {
        let mut changes = Changes::new();
        let timing =
            |width: u64, steps| Timing::new(Exposure::from_micros(9, 9 + width).unwrap(), steps);
        let widths = [
            1, 2, 7, 64, 100, 1000, 9999, 60_000, 60_001, 60_007, 131_072, 131_075,
        ];
        for steps in [1, 3, 8] {
            for (a, b) in widths.into_iter().flat_map(|a| widths.map(|b| (a, b))) {
                let (old, new) = (timing(a, steps), timing(b, steps));
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
}

//! From an event's time to its step, bin and weight, exactly, with one multiplication.

use noctule_sensor::{Evk4, Stamp};

use crate::RasterError;

/// Time bins per step.
pub const BINS: usize = 5;
/// Longest exposure, microseconds: up to here the fixed-point reciprocal is exact.
pub const EXPOSURE_US_MAX: u32 = 1 << 24;
/// Most steps per exposure, so that the reciprocal fits 64 bits.
pub const STEPS_MAX: usize = 31;

/// Weight of a whole event.
pub(super) const WHOLE: i32 = 256;
/// Half-weights per step: 4 gaps between bins of 256 weights each, twice.
pub(super) const HALVES_PER_STEP: u64 = 4 * 256 * 2;
/// Fraction bits of the reciprocal.
const SHIFT: u32 = 48;

/// The interval [open, close) on the event camera's clock, whole microseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Exposure {
    open_us: u64,
    width_us: u32,
}

impl Exposure {
    /// From the two edges of the strobe, each to the nearest microsecond (the camera's tick; an
    /// edge delay from the configuration may be finer).
    ///
    /// # Errors
    /// [`RasterError::Exposure`], when it would not last 1 us to 16.7 s ([`EXPOSURE_US_MAX`]).
    pub fn new(open: Stamp<Evk4>, close: Stamp<Evk4>) -> Result<Self, RasterError> {
        let micros = |stamp: Stamp<Evk4>| stamp.as_nanos().saturating_add(500) / 1000;
        Self::from_micros(micros(open), micros(close))
    }

    /// From whole microseconds on the event camera's clock.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn from_micros(open_us: u64, close_us: u64) -> Result<Self, RasterError> {
        let width = close_us
            .checked_sub(open_us)
            .and_then(|width| u32::try_from(width).ok());
        match width {
            Some(width_us) if (1..=EXPOSURE_US_MAX).contains(&width_us) => {
                Ok(Self { open_us, width_us })
            }
            _ => Err(RasterError::Exposure {
                open_us,
                close_us,
                limit_us: EXPOSURE_US_MAX,
            }),
        }
    }

    /// When the shutter opened.
    #[must_use]
    pub const fn open(&self) -> Stamp<Evk4> {
        Stamp::from_micros(self.open_us)
    }

    /// When it closed: the first instant that is no longer part of it.
    #[must_use]
    pub const fn close(&self) -> Stamp<Evk4> {
        Stamp::from_micros(self.open_us + self.width_us as u64)
    }

    /// How long it lasted, microseconds.
    #[must_use]
    pub const fn width_us(&self) -> u32 {
        self.width_us
    }

    /// Centre of step `step` (0 first) of `steps`, to the nanosecond below: the time its depth,
    /// its returns and its sharp image belong to.
    #[must_use]
    pub fn step_centre(&self, step: usize, steps: usize) -> Stamp<Evk4> {
        let halves = 2 * step as u128 + 1;
        let nanos = u128::from(self.width_us) * 1000 * halves / (2 * steps.max(1) as u128);
        Stamp::from_nanos(self.open().as_nanos().saturating_add(nanos as u64))
    }
}

/// An exposure made ready for the hot loop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Timing {
    /// Low 32 bits of the opening, microseconds, as packed events carry them.
    pub open: u32,
    /// Microseconds.
    pub width: u32,
    /// ceil(2^48 * steps * 2048 / width).
    factor: u64,
}

/// Where an event's weight goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Place {
    /// Index of the earlier plane, `step * BINS + bin`; the later one follows it.
    pub plane: usize,
    /// Weight of the later plane, of [`WHOLE`]; the earlier one gets the rest.
    pub later: i32,
}

impl Timing {
    pub fn new(exposure: Exposure, steps: usize) -> Self {
        let open = exposure.open_us as u32; // the low bits are what is wanted
        Self {
            open,
            width: 0,
            factor: 0,
        }
        .with_width(exposure.width_us, steps)
    }

    /// The same opening with another width, in `1..=EXPOSURE_US_MAX`.
    pub fn with_width(self, width: u32, steps: usize) -> Self {
        let numerator = (steps as u64 * HALVES_PER_STEP) << SHIFT; // below 2^64: steps <= 31
        Self {
            open: self.open,
            width,
            factor: numerator.div_ceil(u64::from(width)),
        }
    }

    /// Microseconds since the opening; at least `width` for an event outside the exposure.
    #[inline(always)]
    pub fn elapsed(&self, t_us: u32) -> u32 {
        t_us.wrapping_sub(self.open)
    }

    /// Half-weights elapsed since the opening: floor(elapsed * N / width), N = steps * 2048.
    ///
    /// Exact for `elapsed < width <= 2^24`: with f = ceil(2^48 N / width) = (2^48 N + e) / width,
    /// 0 <= e < width, the product is elapsed N / width + elapsed e / (width 2^48). The second term
    /// is below elapsed / 2^48 < 1 / width, too little to lift the first one past the next integer,
    /// from which it is at least 1 / width away. The product stays below 2^48 N + width < 2^64.
    #[inline(always)]
    pub fn halves(&self, elapsed: u32) -> u32 {
        ((u64::from(elapsed) * self.factor) >> SHIFT) as u32 // below N <= 31 * 2048
    }

    /// Where an event goes, `elapsed < width` microseconds after the opening.
    #[inline(always)]
    pub fn place(&self, elapsed: u32) -> Place {
        let halves = self.halves(elapsed);
        let step = halves / HALVES_PER_STEP as u32;
        let within = (halves % HALVES_PER_STEP as u32).div_ceil(2); // rounds to the nearest weight
        let bin = (within >> 8).min(BINS as u32 - 2); // the last weight of a step: all to bin 4
        Place {
            plane: (step * BINS as u32 + bin) as usize,
            later: (within - (bin << 8)).cast_signed(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn timing(width: u32, steps: usize) -> Timing {
        Timing::new(Exposure::from_micros(0, u64::from(width)).unwrap(), steps)
    }

    /// The definition in wide integers: step, bin and weight by plain division.
    fn by_division(elapsed: u32, width: u32, steps: usize) -> Place {
        let (e, w, steps) = (i128::from(elapsed), i128::from(width), steps as i128);
        let step = e * steps / w;
        let rest = e * steps - step * w; // of w, inside the step
        let weight = (rest * 1024 * 2 + w) / (2 * w); // nearest 256th, halves up
        let bin = (weight / 256).min(3);
        Place {
            plane: (step * 5 + bin) as usize,
            later: (weight - bin * 256) as i32,
        }
    }

    #[test]
    fn worked_by_hand() {
        // 800 us in 8 steps: 100 us each, 25 us from bin to bin.
        let timing = timing(800, 8);
        let at = |elapsed| (timing.place(elapsed).plane, timing.place(elapsed).later);
        assert_eq!(at(0), (0, 0));
        assert_eq!(at(25), (1, 0));
        assert_eq!(at(30), (1, 51)); // 5/25 = 51.2/256
        assert_eq!(at(99), (3, 246)); // 24/25 = 245.76/256
        assert_eq!(at(100), (5, 0)); // half-open: the next step's first bin
        assert_eq!(at(799), (38, 246));
    }

    #[test]
    fn every_microsecond_of_many_widths_is_exact() {
        for width in (1..60).chain([999, 4096, 20_011]) {
            for steps in [1, 3, 8, 31] {
                let timing = timing(width, steps);
                for elapsed in 0..width {
                    let expected = by_division(elapsed, width, steps);
                    assert_eq!(
                        timing.place(elapsed),
                        expected,
                        "{elapsed} of {width} in {steps}"
                    );
                }
            }
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2000))]
        #[test]
        fn the_reciprocal_is_exact_up_to_the_longest_exposure(
            width in prop_oneof![1..=EXPOSURE_US_MAX, EXPOSURE_US_MAX - 999..=EXPOSURE_US_MAX],
            share in 0.0..1.0f64,
            boundary in any::<u32>(),
            steps in 1..=STEPS_MAX,
        ) {
            let timing = timing(width, steps);
            // A random instant, and those round a random boundary, where rounding would show.
            let parts = steps as u64 * HALVES_PER_STEP;
            let edge = (u64::from(boundary) % parts * u64::from(width)).div_ceil(parts) as u32;
            let random = (f64::from(width) * share) as u32;
            for elapsed in [random, edge, edge.saturating_sub(1), edge + 1, width - 1] {
                let elapsed = elapsed.min(width - 1);
                prop_assert_eq!(timing.place(elapsed), by_division(elapsed, width, steps));
            }
        }
    }

    #[test]
    fn stamps_round_to_the_tick_and_centres_lie_between_boundaries() {
        let exposure =
            Exposure::new(Stamp::from_nanos(1_000_499), Stamp::from_nanos(1_800_500)).unwrap();
        assert_eq!(
            (exposure.open(), exposure.width_us()),
            (Stamp::from_micros(1000), 801)
        );
        assert_eq!(exposure.close(), Stamp::from_micros(1801));
        assert_eq!(
            exposure.step_centre(0, 8).as_nanos(),
            1_000_000 + 801_000 / 16
        );
        assert_eq!(
            exposure.step_centre(7, 8).as_nanos(),
            1_000_000 + 801_000 * 15 / 16
        );
    }

    #[test]
    fn bad_exposures_are_named() {
        for (open, close) in [
            (5, 5),
            (5, 4),
            (0, u64::from(EXPOSURE_US_MAX) + 1),
            (0, u64::MAX),
        ] {
            assert!(matches!(
                Exposure::from_micros(open, close),
                Err(RasterError::Exposure { .. })
            ));
        }
        let error = Exposure::from_micros(7, 7).unwrap_err();
        let text = "exposure opens at 7 us and closes at 7 us, must last 1..=16777216 us";
        assert_eq!(error.to_string(), text);
    }
}

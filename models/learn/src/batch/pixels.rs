//! Other event pixels than those that were simulated, as far as finished events tell.
//!
//! What a pixel saw is known from its events to one threshold. Read as a staircase, they can be
//! looked at again by a slower photoreceptor, a coarser comparator and a pixel that rests longer;
//! never by a faster or finer one. All three only lose events, and keep the order of time in each
//! pixel, which is all that rasters ask for.

use noctule_raster::PackedEvent;

use crate::chance::Chance;

/// Light at which a pixel is twenty times as slow as at white, added to all light.
const DARK: f32 = 0.05;

/// Keeps what pixels with a threshold `factor` times as high (1 or more) would have fired.
///
/// Every event moves its pixel's level by one old threshold; the pixel fires when the level has
/// moved by a new one. Where between two firings it stood at the start is drawn. Times are those of
/// the old events, up to one old threshold late.
pub(super) fn raise_threshold(
    events: &mut Vec<PackedEvent>,
    span: usize,
    factor: f64,
    chance: &mut Chance,
) {
    let factor = factor as f32;
    let start = |_| (factor - 1.0) * (2.0 * chance.unit() as f32 - 1.0);
    let mut moved: Vec<f32> = (0..span * span).map(start).collect();
    events.retain(|event| {
        let moved = &mut moved[cell(event, span)];
        let step = if event.is_on() { 1.0 } else { -1.0 };
        *moved += step;
        let fires = *moved * step >= factor;
        if fires {
            *moved -= step * factor;
        }
        fires
    });
}

/// Silences each pixel for `dead_us` after an event that it fired.
pub(super) fn rest(events: &mut Vec<PackedEvent>, span: usize, dead_us: f64) {
    let dead_us = dead_us as u32;
    let mut ready_us = vec![0_u32; span * span];
    events.retain(|event| {
        let ready_us = &mut ready_us[cell(event, span)];
        let fires = event.t_us >= *ready_us;
        if fires {
            *ready_us = event.t_us.saturating_add(dead_us);
        }
        fires
    });
}

/// One pixel behind a low-pass; levels count thresholds from where it stood at the opening.
#[derive(Clone, Copy)]
#[repr(align(32))]
struct Slow {
    /// Where the events say the light is: half a threshold beyond the last event's level, on the
    /// side it came to.
    light: f32,
    /// What the low-pass has made of it, at `at_us`.
    filtered: f32,
    at_us: f32,
    /// Level of the last event it fired.
    fired: f32,
    /// Level of the last event it was told of.
    told: f32,
    lag_us: f32,
    /// The inverse of that.
    rate: f32,
}

impl Slow {
    fn new(lag_us: f32) -> Self {
        Self {
            light: 0.0,
            filtered: 0.0,
            at_us: 0.0,
            fired: 0.0,
            told: 0.0,
            lag_us,
            rate: lag_us.recip(),
        }
    }

    /// Lets time pass until `until_us`; says when it fires, and with which polarity.
    #[inline(always)]
    fn pass(&mut self, until_us: f32, mut fire: impl FnMut(u32, bool)) {
        loop {
            let passed = (until_us - self.at_us) * self.rate;
            // After so many time constants less is left than a number of 24 bits can tell.
            let left = if passed < 16.0 { (-passed).exp() } else { 0.0 };
            let filtered = self.light + (self.filtered - self.light) * left;
            let step = if self.light > self.fired { 1.0 } else { -1.0 };
            let next = self.fired + step;
            // The light stands half a threshold beyond `next` or more where it is reached at all.
            if (filtered - next) * step < 0.0 {
                (self.filtered, self.at_us) = (filtered, until_us);
                return;
            }
            let gone = (self.light - self.filtered) / (self.light - next);
            self.at_us = (self.at_us + self.lag_us * gone.max(1.0).ln()).min(until_us);
            fire(self.at_us as u32, step > 0.0);
            (self.fired, self.filtered) = (next, next);
        }
    }
}

/// Looks again through a low-pass of first order whose time constant is `lag_us` at white and longer
/// in the dark: `lag_us / (light + 0.05)`. `light` is each pixel's, white 1. Changes that do not last
/// are not fired again, others come later, those after `close_us` never.
pub(super) fn slow_down(
    events: &[PackedEvent],
    span: usize,
    close_us: u32,
    lag_us: f64,
    light: &[f32],
) -> Vec<PackedEvent> {
    let lag = |light: &f32| (lag_us as f32 / (light.max(0.0) + DARK)).max(1.0);
    let mut pixels: Vec<Slow> = light.iter().map(|light| Slow::new(lag(light))).collect();
    let mut out = Vec::with_capacity(events.len());
    let mut fired = |at_us: u32, x: usize, y: usize, on: bool| {
        out.extend(PackedEvent::new(at_us, x as u16, y as u16, on).ok());
    };
    for event in events {
        let (x, y) = (event.x() as usize, event.y() as usize);
        let pixel = &mut pixels[y * span + x];
        pixel.pass(event.t_us as f32, |at_us, on| fired(at_us, x, y, on));
        let step = if event.is_on() { 1.0 } else { -1.0 };
        pixel.told += step;
        pixel.light = pixel.told + 0.5 * step;
    }
    for (y, row) in pixels.chunks_exact_mut(span).enumerate() {
        for (x, pixel) in row.iter_mut().enumerate() {
            if pixel.light != 0.0 {
                pixel.pass(close_us as f32, |at_us, on| fired(at_us, x, y, on));
            }
        }
    }
    out
}

fn cell(event: &PackedEvent, span: usize) -> usize {
    event.y() as usize * span + event.x() as usize
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const SPAN: usize = 3;
    const CLOSE_US: u32 = 60_000;

    fn events() -> impl Strategy<Value = Vec<PackedEvent>> {
        let one = (0..CLOSE_US, 0..3_u16, 0..3_u16, any::<bool>());
        prop::collection::vec(one, 0..200).prop_map(|mut all| {
            all.sort_unstable();
            let event = |(t, x, y, on)| PackedEvent::new(t, x, y, on).expect("small");
            all.into_iter().map(event).collect()
        })
    }

    fn at(t_us: u32, on: bool) -> PackedEvent {
        PackedEvent::new(t_us, 1, 2, on).expect("small")
    }

    fn raised(events: &[PackedEvent], factor: f64, seed: u64) -> Vec<PackedEvent> {
        let mut events = events.to_vec();
        raise_threshold(&mut events, SPAN, factor, &mut Chance::of(&[seed]));
        events
    }

    fn rested(events: &[PackedEvent], dead_us: f64) -> Vec<PackedEvent> {
        let mut events = events.to_vec();
        rest(&mut events, SPAN, dead_us);
        events
    }

    fn slowed(events: &[PackedEvent], lag_us: f64) -> Vec<PackedEvent> {
        slow_down(events, SPAN, CLOSE_US, lag_us, &[1.0; SPAN * SPAN])
    }

    fn counts(events: &[PackedEvent]) -> [usize; SPAN * SPAN] {
        let mut counts = [0; SPAN * SPAN];
        events
            .iter()
            .for_each(|event| counts[cell(event, SPAN)] += 1);
        counts
    }

    fn is_part(part: &[PackedEvent], whole: &[PackedEvent]) -> bool {
        let mut rest = whole.iter();
        part.iter().all(|event| rest.any(|other| other == event))
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]

        #[test]
        fn events_only_get_fewer_and_stay_in_order(
            events in events(), factor in 1.0..6.0_f64, dead in 0.0..20_000.0_f64,
            lag in 1.0..20_000.0_f64, seed in any::<u64>(),
        ) {
            let raised_ = raised(&events, factor, seed);
            prop_assert!(is_part(&raised_, &events));
            prop_assert_eq!(&raised_, &raised(&events, factor, seed));
            prop_assert!(is_part(&rested(&events, dead), &events));
            let slow = slowed(&events, lag);
            prop_assert!(counts(&slow).iter().zip(counts(&events)).all(|(a, b)| *a <= b));
            let mut last_us = [0; SPAN * SPAN];
            for event in &slow {
                let before_us = std::mem::replace(&mut last_us[cell(event, SPAN)], event.t_us);
                prop_assert!((before_us..=CLOSE_US).contains(&event.t_us));
            }
            // However it is looked at, a pixel is never further off than what it cannot resolve.
            let sums = |events: &[PackedEvent]| {
                let mut sums = [0_i32; SPAN * SPAN];
                for event in events {
                    sums[cell(event, SPAN)] += if event.is_on() { 1 } else { -1 };
                }
                sums
            };
            for (new, old) in sums(&raised_).iter().zip(sums(&events)) {
                prop_assert!((f64::from(*new) * factor - f64::from(old)).abs() < 2.0 * factor);
            }
        }

        #[test]
        fn neutral_strengths_change_nothing(events in events(), seed in any::<u64>()) {
            prop_assert_eq!(&raised(&events, 1.0, seed), &events);
            prop_assert_eq!(&rested(&events, 0.0), &events);
        }
    }

    #[test]
    fn a_threshold_of_two_fires_on_every_second_step() {
        let rising: Vec<PackedEvent> = (0..1000).map(|i| at(10 * i, true)).collect();
        for (factor, wanted) in [(2.0, 500), (2.5, 400), (4.0, 250)] {
            let found = raised(&rising, factor, 7).len();
            assert!(found.abs_diff(wanted) <= 1, "{found} at {factor}");
        }
        // Up and down by one threshold never reaches two from the middle.
        let flicker: Vec<PackedEvent> = (0..1000).map(|i| at(10 * i, i % 2 == 0)).collect();
        assert!(raised(&flicker, 2.0, 7).len() <= 1);
    }

    #[test]
    fn a_resting_pixel_loses_what_comes_too_soon() {
        let events = [at(0, true), at(400, true), at(500, false), at(900, true)];
        assert_eq!(rested(&events, 500.0), [events[0], events[2]]);
    }

    /// One step of one threshold crosses its level after `ln 3` time constants (1.05 at white):
    /// the light stands half a threshold beyond.
    #[test]
    fn a_step_comes_later_and_flicker_not_at_all() {
        let found = slowed(&[at(1000, true)], 2100.0);
        let wanted = 1000.0 + 2000.0 * 3_f64.ln();
        assert_eq!(found.len(), 1);
        assert!(
            (f64::from(found[0].t_us) - wanted).abs() < 2.0,
            "{}",
            found[0].t_us
        );
        assert!(slowed(&[at(1000, true), at(1500, false)], 2100.0).is_empty());
        let lasting = [at(1000, true), at(41_000, false)];
        assert_eq!(slowed(&lasting, 2100.0).len(), 2);
        // In the dark the same pixel is 21 times as slow: too slow for this exposure.
        let dark = slow_down(&lasting, SPAN, CLOSE_US, 2100.0, &[0.0; SPAN * SPAN]);
        assert!(dark.is_empty(), "{dark:?}");
    }
}

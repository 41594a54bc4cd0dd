//! When a recorded delivery is due.

use std::str::FromStr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use noctule_sensor::{Realtime, Stamp};

use crate::latency::monotonic_ns;

/// The longest sleep before looking whether to stop.
const NAP: Duration = Duration::from_millis(20);

/// How fast a recording is replayed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pace {
    /// As fast as it is taken.
    Max,
    /// So many recorded seconds per second.
    Speed(f64),
}

impl Pace {
    /// As it was recorded.
    pub const REALTIME: Self = Self::Speed(1.0);
}

impl FromStr for Pace {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "max" => Ok(Self::Max),
            "realtime" => Ok(Self::REALTIME),
            number => match number.parse::<f64>() {
                Ok(speed) if speed.is_finite() && (0.001..=1000.0).contains(&speed) => {
                    Ok(Self::Speed(speed))
                }
                _ => Err(format!(
                    "'{text}': realtime, max or a factor from 0.001 to 1000"
                )),
            },
        }
    }
}

/// Maps arrivals of a recording onto `CLOCK_MONOTONIC` of this run.
#[derive(Debug, Clone, Copy)]
pub struct Pacer {
    pace: Pace,
    origin: Stamp<Realtime>,
    start_ns: u64,
}

impl Pacer {
    /// Lets the delivery that arrived at `origin` through at `start_ns`.
    #[must_use]
    pub fn new(pace: Pace, origin: Stamp<Realtime>, start_ns: u64) -> Self {
        Self {
            pace,
            origin,
            start_ns,
        }
    }

    /// The instant at which a delivery is due; `None` when at once.
    #[must_use]
    pub fn due_ns(&self, arrival: Stamp<Realtime>) -> Option<u64> {
        let Pace::Speed(speed) = self.pace else {
            return None;
        };
        #[expect(clippy::cast_precision_loss, reason = "exact over weeks")]
        let after = arrival.diff_nanos(self.origin) as f64 / speed;
        #[expect(
            clippy::cast_possible_truncation,
            reason = "whole nanoseconds; `as` saturates"
        )]
        Some(self.start_ns.saturating_add_signed(after as i64))
    }

    /// Sleeps until the delivery is due; returns that instant (not the later one of waking: how
    /// late a thread wakes is the host's to answer for). `None` when told to stop meanwhile.
    #[must_use]
    pub fn hold(&self, arrival: Stamp<Realtime>, stop: &AtomicBool) -> Option<u64> {
        loop {
            if stop.load(Ordering::Relaxed) {
                return None;
            }
            let now_ns = monotonic_ns();
            let Some(due_ns) = self.due_ns(arrival) else {
                return Some(now_ns);
            };
            if due_ns <= now_ns {
                return Some(due_ns);
            }
            std::thread::sleep(NAP.min(Duration::from_nanos(due_ns - now_ns)));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paces_are_read_by_name_and_number() {
        assert_eq!("max".parse(), Ok(Pace::Max));
        assert_eq!("realtime".parse(), Ok(Pace::Speed(1.0)));
        assert_eq!("0.5".parse(), Ok(Pace::Speed(0.5)));
        for bad in ["", "fast", "0", "-1", "inf", "NaN"] {
            assert!(bad.parse::<Pace>().is_err(), "{bad}");
        }
    }

    #[test]
    fn twice_the_speed_halves_the_wait() {
        let pacer = Pacer::new(Pace::Speed(2.0), Stamp::from_nanos(1_000), 500);
        assert_eq!(pacer.due_ns(Stamp::from_nanos(3_000)), Some(1_500));
        assert_eq!(
            Pacer::new(Pace::Max, Stamp::ZERO, 5).due_ns(Stamp::MAX),
            None
        );
    }
}

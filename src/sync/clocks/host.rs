//! The host's own clocks: monotonic, realtime and TAI, read together once a second.

use noctule_sensor::{ClockMap, Monotonic, Realtime, Stamp, Tai};

use super::epoch::{FitCounts, Observation};
use super::paired::{PairedConfig, PairedFit};

/// The host's clocks read together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ClockReading {
    /// `CLOCK_REALTIME`.
    pub realtime: Stamp<Realtime>,
    /// `CLOCK_MONOTONIC`.
    pub monotonic: Stamp<Monotonic>,
    /// What to add to realtime to get TAI, nanoseconds (37 s since 2017, where the kernel knows).
    pub tai_offset_ns: i64,
}

/// Maps between the host's clocks. The kernel steers monotonic and realtime alike, so that they
/// differ by a constant until someone sets the time.
#[derive(Debug)]
pub struct HostClocks {
    realtime: PairedFit<Monotonic, Realtime>,
    tai: Option<(Stamp<Realtime>, i64)>,
    tai_epoch: u32,
}

impl Default for HostClocks {
    fn default() -> Self {
        Self::new()
    }
}

impl HostClocks {
    /// Maps that know nothing yet.
    #[must_use]
    pub fn new() -> Self {
        Self {
            realtime: PairedFit::new(PairedConfig {
                pairs: 64,
                window_ns: 64_000_000_000,
                pairs_min: 1,
                settled_ns: 20_000,
                jitter_ns: 1_000,
                // The kernel steers both alike; other hosts' recordings may not.
                skew_ppb_max: 100_000,
                gate_ns: 50_000,
                suspects_max: 2,
                silence_ns: 30_000_000_000,
                wander_ppb: 0,
                may_lag: false,
                tick_ns: 0,
            }),
            tai: None,
            tai_epoch: 0,
        }
    }

    /// Takes one reading of all clocks. A step of realtime shows as `Suspect`, then `NewEpoch`.
    pub fn observe(&mut self, reading: ClockReading) -> Observation {
        let outcome = self.realtime.observe(reading.monotonic, reading.realtime);
        match self.tai {
            Some((_, offset_ns)) if offset_ns == reading.tai_offset_ns => {}
            Some(_) => {
                self.tai_epoch = self.tai_epoch.wrapping_add(1);
                self.tai = Some((reading.realtime, reading.tai_offset_ns));
            }
            None => self.tai = Some((reading.realtime, reading.tai_offset_ns)),
        }
        outcome
    }

    /// Monotonic onto realtime.
    #[must_use]
    pub fn monotonic_to_realtime(&self) -> Option<ClockMap<Monotonic, Realtime>> {
        self.realtime.map().copied()
    }

    /// Realtime onto TAI: a constant, exact; its epoch counts changes of that constant.
    #[must_use]
    pub fn realtime_to_tai(&self) -> Option<ClockMap<Realtime, Tai>> {
        let (at, offset_ns) = self.tai?;
        let tai = Stamp::from_nanos(at.as_nanos().saturating_add_signed(offset_ns));
        Some(ClockMap {
            epoch: self.tai_epoch,
            ..ClockMap::exact(at, tai)
        })
    }

    /// Monotonic onto TAI.
    #[must_use]
    pub fn monotonic_to_tai(&self) -> Option<ClockMap<Monotonic, Tai>> {
        Some(self.monotonic_to_realtime()?.then(&self.realtime_to_tai()?))
    }

    /// Readings and steps by kind.
    #[must_use]
    pub fn counts(&self) -> FitCounts {
        self.realtime.counts()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: u64 = 1_000_000_000;

    fn reading(second: u64, realtime_ns: u64, tai_s: i64) -> ClockReading {
        ClockReading {
            realtime: Stamp::from_nanos(realtime_ns),
            monotonic: Stamp::from_nanos(second * S),
            tai_offset_ns: tai_s * 1_000_000_000,
        }
    }

    #[test]
    fn one_reading_is_enough_for_maps() {
        let mut host = HostClocks::new();
        host.observe(reading(5, 1_700_000_000 * S, 37));
        let map = host.monotonic_to_tai().unwrap();
        let tai = map.apply(Stamp::from_nanos(6 * S));
        assert_eq!(tai.as_nanos(), 1_700_000_038 * S);
        // 100 ppm of doubt about the rate; tight once there are more readings.
        assert!(map.uncertainty_at(Stamp::from_nanos(6 * S)) < 300_000);
        for second in 6..20 {
            host.observe(reading(second, (1_700_000_000 + second - 5) * S, 37));
        }
        assert!(host.monotonic_to_tai().unwrap().uncertainty_ns < 2_000);
    }

    #[test]
    fn setting_the_time_opens_an_epoch_after_two_readings_agree() {
        let mut host = HostClocks::new();
        for second in 0..10 {
            assert_eq!(
                host.observe(reading(second, (100 + second) * S, 37)),
                Observation::Used
            );
        }
        let stepped = |second: u64| (100 + second) * S + 3_000_000;
        assert_eq!(
            host.observe(reading(10, stepped(10), 37)),
            Observation::Suspect
        );
        assert!(matches!(
            host.observe(reading(11, stepped(11), 37)),
            Observation::NewEpoch(_)
        ));
        let map = host.monotonic_to_realtime().unwrap();
        assert_eq!(map.epoch, 1);
        assert_eq!(map.apply(Stamp::from_nanos(12 * S)).as_nanos(), stepped(12));
    }

    #[test]
    fn a_new_tai_offset_is_a_new_epoch() {
        let mut host = HostClocks::new();
        host.observe(reading(0, 100 * S, 0));
        host.observe(reading(1, 101 * S, 37));
        let map = host.realtime_to_tai().unwrap();
        assert_eq!(
            (map.epoch, map.apply(Stamp::from_nanos(102 * S)).as_nanos()),
            (1, 139 * S)
        );
    }
}

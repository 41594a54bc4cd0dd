//! Every clock of the vehicle on one timeline, TAI: which fit stands behind which map, and what a
//! step of one means for the others.

use noctule_sensor::{Clock, ClockMap, Evk4, Lidar, Monotonic, Realtime, Stamp, Tai};

use super::envelope::{EnvelopeConfig, EnvelopeFit};
use super::epoch::{FitCounts, Observation};
use super::host::{ClockReading, HostClocks};
use super::paired::{PairedConfig, PairedFit};

/// How a sensor's clock gets onto TAI.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SensorClock {
    /// It runs free: from the arrivals of its data.
    Arrivals(EnvelopeConfig),
    /// Its stamps plus this many nanoseconds are TAI: it is locked, or it is alone and its own
    /// clock is as good as any.
    Offset(i64),
}

/// Settings of a [`Timeline`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TimelineConfig {
    /// The event camera's counter.
    pub evk4: SensorClock,
    /// The LiDAR's clock.
    pub lidar: SensorClock,
    /// The event camera's counter against driver stamps, through the strobe.
    pub strobe: PairedConfig,
    /// TAI minus realtime, nanoseconds, taken as long as no clock reading has told.
    pub tai_offset_ns: Option<i64>,
}

impl TimelineConfig {
    /// Both sensors free-running, strobe wired; nothing assumed about TAI.
    #[must_use]
    pub const fn free_running() -> Self {
        Self {
            evk4: SensorClock::Arrivals(EnvelopeConfig::usb()),
            lidar: SensorClock::Arrivals(EnvelopeConfig::udp()),
            strobe: PairedConfig::strobe(),
            tai_offset_ns: None,
        }
    }
}

/// What the fits behind a [`Timeline`] have seen.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct TimelineCounts {
    /// The host's own clocks.
    pub host: FitCounts,
    /// Arrivals of the event camera's transfers.
    pub evk4: FitCounts,
    /// Arrivals of the LiDAR's packets.
    pub lidar: FitCounts,
    /// Strobe edges paired with driver stamps.
    pub strobe: FitCounts,
}

/// Which evidence a map of the event camera's counter rests on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MapSource {
    /// Edges both clocks saw; good to microseconds.
    Edges,
    /// Arrivals; good to tens of microseconds, net of a constant delay.
    Arrivals,
    /// Configured.
    Offset,
}

#[derive(Debug)]
enum Fit<C: Clock> {
    Arrivals(Box<EnvelopeFit<C, Realtime>>),
    Offset(i64),
}

impl<C: Clock> Fit<C> {
    fn new(clock: SensorClock) -> Self {
        match clock {
            SensorClock::Arrivals(config) => Self::Arrivals(Box::new(EnvelopeFit::new(config))),
            SensorClock::Offset(nanos) => Self::Offset(nanos),
        }
    }

    fn observe(&mut self, stamp: Stamp<C>, arrival: Stamp<Realtime>) -> Observation {
        match self {
            Self::Arrivals(fit) => fit.observe(stamp, arrival),
            Self::Offset(_) => Observation::Used,
        }
    }

    fn to_tai(&self, realtime: Option<ClockMap<Realtime, Tai>>) -> Option<ClockMap<C, Tai>> {
        match self {
            Self::Arrivals(fit) => Some(fit.map()?.then(&realtime?)),
            Self::Offset(nanos) => {
                // Anchored where both sides are representable.
                let at = nanos.min(&0).unsigned_abs();
                let tai = Stamp::from_nanos(at.saturating_add_signed(*nanos));
                Some(ClockMap::exact(Stamp::from_nanos(at), tai))
            }
        }
    }

    fn counts(&self) -> FitCounts {
        match self {
            Self::Arrivals(fit) => fit.counts(),
            Self::Offset(_) => FitCounts::default(),
        }
    }

    fn is_suspect(&self) -> bool {
        matches!(self, Self::Arrivals(fit) if fit.is_suspect())
    }
}

/// All clock maps, fed with readings in the order in which they arrived.
#[derive(Debug)]
pub struct Timeline {
    host: HostClocks,
    evk4: Fit<Evk4>,
    lidar: Fit<Lidar>,
    strobe: PairedFit<Evk4, Monotonic>,
    tai_offset_ns: Option<i64>,
}

impl Timeline {
    /// A timeline that has seen nothing. Allocates here and nothing afterwards.
    #[must_use]
    pub fn new(config: TimelineConfig) -> Self {
        Self {
            host: HostClocks::new(),
            evk4: Fit::new(config.evk4),
            lidar: Fit::new(config.lidar),
            strobe: PairedFit::new(config.strobe),
            tai_offset_ns: config.tai_offset_ns,
        }
    }

    /// Takes a reading of the host's clocks.
    pub fn clocks(&mut self, reading: ClockReading) -> Observation {
        self.host.observe(reading)
    }

    /// A transfer whose newest word is stamped `newest` arrived. On `NewEpoch` the exposures in
    /// flight are void: tell the exposure tracker.
    pub fn evk4_arrival(&mut self, newest: Stamp<Evk4>, arrival: Stamp<Realtime>) -> Observation {
        let outcome = self.evk4.observe(newest, arrival);
        if let Fit::Arrivals(fit) = &self.evk4 {
            if matches!(outcome, Observation::NewEpoch(_)) {
                // The counter's relation to every other clock is in doubt.
                self.strobe.reset();
            }
            self.strobe.set_rate(fit.rate());
        }
        outcome
    }

    /// A packet stamped `stamp` arrived.
    pub fn lidar_arrival(&mut self, stamp: Stamp<Lidar>, arrival: Stamp<Realtime>) -> Observation {
        self.lidar.observe(stamp, arrival)
    }

    /// The strobe edge at `edge` is the one the driver stamped `driver`.
    pub fn strobe_pair(&mut self, edge: Stamp<Evk4>, driver: Stamp<Monotonic>) -> Observation {
        self.strobe.observe(edge, driver)
    }

    /// Realtime onto TAI.
    #[must_use]
    pub fn realtime_to_tai(&self) -> Option<ClockMap<Realtime, Tai>> {
        let assumed = || {
            let nanos = self.tai_offset_ns?;
            let at = nanos.min(0).unsigned_abs();
            let tai = Stamp::from_nanos(at.saturating_add_signed(nanos));
            Some(ClockMap::exact(Stamp::from_nanos(at), tai))
        };
        self.host.realtime_to_tai().or_else(assumed)
    }

    /// Monotonic onto TAI.
    #[must_use]
    pub fn monotonic_to_tai(&self) -> Option<ClockMap<Monotonic, Tai>> {
        self.host.monotonic_to_tai()
    }

    /// The LiDAR's clock onto TAI; `None` before the first packets.
    #[must_use]
    pub fn lidar_to_tai(&self) -> Option<ClockMap<Lidar, Tai>> {
        self.lidar.to_tai(self.realtime_to_tai())
    }

    /// The event camera's counter onto driver stamps, and on what evidence: edges as soon as there
    /// are a few undisputed pairs, arrivals before.
    #[must_use]
    pub fn evk4_to_monotonic(&self) -> Option<(ClockMap<Evk4, Monotonic>, MapSource)> {
        if let Some(map) = self.strobe.map().filter(|_| !self.strobe.is_suspect()) {
            return Some((*map, MapSource::Edges));
        }
        match &self.evk4 {
            Fit::Arrivals(fit) => {
                let monotonic = self.host.monotonic_to_realtime()?.inverse();
                Some((fit.map()?.then(&monotonic), MapSource::Arrivals))
            }
            Fit::Offset(_) => {
                let monotonic = self.host.monotonic_to_tai()?.inverse();
                Some((self.evk4.to_tai(None)?.then(&monotonic), MapSource::Offset))
            }
        }
    }

    /// The event camera's counter onto TAI, and on what evidence: edges once their fit has
    /// settled, else arrivals.
    #[must_use]
    pub fn evk4_to_tai(&self) -> Option<(ClockMap<Evk4, Tai>, MapSource)> {
        let settled = self.strobe.is_settled() && !self.strobe.is_suspect();
        if let (true, Some(map), Some(tai)) =
            (settled, self.strobe.map(), self.host.monotonic_to_tai())
        {
            return Some((map.then(&tai), MapSource::Edges));
        }
        let source = match self.evk4 {
            Fit::Arrivals(_) => MapSource::Arrivals,
            Fit::Offset(_) => MapSource::Offset,
        };
        Some((self.evk4.to_tai(self.realtime_to_tai())?, source))
    }

    /// Whether stamps of the event camera should not be mapped just now.
    #[must_use]
    pub fn is_evk4_suspect(&self) -> bool {
        self.evk4.is_suspect()
    }

    /// Whether stamps of the LiDAR should not be mapped just now.
    #[must_use]
    pub fn is_lidar_suspect(&self) -> bool {
        self.lidar.is_suspect()
    }

    /// Readings and epochs of every fit.
    #[must_use]
    pub fn counts(&self) -> TimelineCounts {
        TimelineCounts {
            host: self.host.counts(),
            evk4: self.evk4.counts(),
            lidar: self.lidar.counts(),
            strobe: self.strobe.counts(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reading(second: u64) -> ClockReading {
        ClockReading {
            realtime: Stamp::from_nanos((1_700_000_000 + second) * 1_000_000_000),
            monotonic: Stamp::from_nanos((50 + second) * 1_000_000_000),
            tai_offset_ns: 37_000_000_000,
        }
    }

    #[test]
    fn a_clock_that_is_tai_needs_no_arrivals() {
        let mut timeline = Timeline::new(TimelineConfig {
            evk4: SensorClock::Offset(1_700_000_037_000_000_000),
            lidar: SensorClock::Offset(-5),
            ..TimelineConfig::free_running()
        });
        let (map, source) = timeline.evk4_to_tai().unwrap();
        assert_eq!(source, MapSource::Offset);
        assert_eq!(
            map.apply(Stamp::from_micros(3)).as_nanos(),
            1_700_000_037_000_003_000
        );
        let lidar = timeline.lidar_to_tai().unwrap();
        assert_eq!(lidar.apply(Stamp::from_nanos(105)).as_nanos(), 100);
        assert!(
            timeline.evk4_to_monotonic().is_none(),
            "no clock has been read yet"
        );
        timeline.clocks(reading(0));
        let (map, _) = timeline.evk4_to_monotonic().unwrap();
        assert_eq!(map.apply(Stamp::from_micros(3)).as_nanos(), 50_000_003_000);
    }

    #[test]
    fn tai_is_taken_from_readings_first_and_assumed_only_where_told() {
        let mut timeline = Timeline::new(TimelineConfig::free_running());
        assert!(timeline.realtime_to_tai().is_none());
        timeline.clocks(reading(0));
        let map = timeline.realtime_to_tai().unwrap();
        assert_eq!(
            map.apply(reading(1).realtime).as_nanos(),
            1_700_000_038_000_000_000
        );
        let config = TimelineConfig {
            tai_offset_ns: Some(5),
            ..TimelineConfig::free_running()
        };
        let assumed = Timeline::new(config).realtime_to_tai().unwrap();
        assert_eq!(assumed.apply(Stamp::from_nanos(7)).as_nanos(), 12);
    }

    #[test]
    fn edges_replace_arrivals_for_images_and_a_new_epoch_takes_them_back() {
        let mut timeline = Timeline::new(TimelineConfig::free_running());
        timeline.clocks(reading(0));
        let host = |ms: u64| Stamp::from_nanos(1_700_000_000_000_000_000 + ms * 1_000_000);
        for ms in 1..2000 {
            timeline.evk4_arrival(Stamp::from_micros(ms * 1000), host(ms));
        }
        assert_eq!(timeline.evk4_to_monotonic().unwrap().1, MapSource::Arrivals);
        for ms in (200..2000).step_by(200) {
            let driver = Stamp::from_nanos(50_000_000_000 + ms * 1_000_000);
            timeline.strobe_pair(Stamp::from_micros(ms * 1000), driver);
        }
        let (map, source) = timeline.evk4_to_monotonic().unwrap();
        assert_eq!(source, MapSource::Edges);
        let at = map.apply(Stamp::from_micros(2_000_000));
        assert!(at.diff_nanos(Stamp::from_nanos(52_000_000_000)).abs() < 1_000);
        // The counter starts again.
        for ms in 2000..2020 {
            timeline.evk4_arrival(Stamp::from_micros((ms - 1999) * 1000), host(ms));
        }
        assert_eq!(timeline.evk4_to_monotonic().unwrap().1, MapSource::Arrivals);
        let counts = timeline.counts();
        assert_eq!((counts.evk4.backwards, counts.strobe.resets), (1, 1));
    }
}

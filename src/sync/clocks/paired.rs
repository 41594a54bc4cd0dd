//! A clock map from edges that both clocks saw: the strobe on the event camera's counter, the same
//! shutter edge in the frame's driver stamp.
//!
//! The errors of such pairs are small, so this is a robust linear fit over a sliding window. What
//! the arrivals know about the rate may be lent to it as a prior. Errors may have two sides, as
//! noise does, or one, as the delay of an interrupt handler does: the residuals tell which, and
//! until they do the map's bound covers both.

use noctule_sensor::{Clock, ClockMap, Stamp};

use super::epoch::{Contradiction, EpochCause, FitCounts, Observation, Suspects};
use super::line::{self, Line, Point, Prior};
use super::{RateEstimate, signed, to_bound_ns, to_ppb};

/// Settings of a [`PairedFit`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PairedConfig {
    /// Pairs in the sliding window.
    pub pairs: usize,
    /// Pairs older than this are left out, nanoseconds of `A`.
    pub window_ns: i64,
    /// Pairs needed before there is a map.
    pub pairs_min: usize,
    /// The map is settled when its bound is at most this, nanoseconds.
    pub settled_ns: u64,
    /// Expected jitter of a pair (standard deviation), nanoseconds; the fit learns the true one.
    pub jitter_ns: i64,
    /// Bound on the skew of an oscillator, parts per billion.
    pub skew_ppb_max: i64,
    /// A pair further than this from the map (beyond its bound) contradicts it, nanoseconds.
    pub gate_ns: i64,
    /// Contradicting pairs in agreement that open a new epoch.
    pub suspects_max: u32,
    /// Time without a pair after which the fit is given up, nanoseconds of `B`.
    pub silence_ns: i64,
    /// How fast the skew itself may wander: added to the growth of uncertainty, ppb.
    pub wander_ppb: u64,
    /// Whether `B` may be stamped late by a random delay, never early.
    pub may_lag: bool,
    /// Resolution of `A`: a reading may be this early, nanoseconds. Counts where delays have one
    /// side; in noise of two sides it drowns.
    pub tick_ns: u64,
}

impl PairedConfig {
    /// Strobe edges against V4L2 stamps with 20 us of jitter, at up to 30 frames a second.
    #[must_use]
    pub const fn strobe() -> Self {
        Self {
            pairs: 1024,
            window_ns: 200_000_000_000,
            pairs_min: 4,
            settled_ns: 5_000,
            jitter_ns: 20_000,
            skew_ppb_max: 200_000,
            gate_ns: 200_000,
            suspects_max: 4,
            silence_ns: 10_000_000_000,
            wander_ppb: 0,
            may_lag: true,
            tick_ns: 1_000,
        }
    }
}

/// A borrowed rate is believed to this many of its standard deviations: its noise has long tails.
const RATE_TRUST: f64 = 1.5;

/// Pairs needed before the shape of their errors says anything.
const SHAPE_COUNT: f64 = 32.0;
/// Errors less skewed than this have two sides, more skewed than the other one side. Noise that is
/// normal or uniform has skewness 0 (standard deviation 0.2 for 150 pairs), an exponential delay
/// 2, or 1.6 without its outliers.
const SKEWNESS: (f64, f64) = (0.5, 0.7);
/// A delay's mean lies at most this many standard deviations above the least: exponential 1,
/// uniform 1.7, normal 2.5 and more.
const STEEP: f64 = 1.4;
/// 99 % bound on how far the least of n exponential delays lies above where it is expected, in
/// units of their mean over n: ln 100 - 1.
const LEAST_BOUND: f64 = 3.6;

/// What a line through lagging stamps must be moved by, and the 99 % bound on what is then wrong.
#[derive(Debug, Clone, Copy)]
struct Shift {
    shift: f64,
    bound: f64,
}

/// Sliding-window fit of clock `A` onto clock `B` from pairs of simultaneous readings.
#[derive(Debug)]
pub struct PairedFit<A: Clock, B: Clock> {
    config: PairedConfig,
    /// Pairs of this epoch, used as a ring of `config.pairs`.
    pairs: Vec<(u64, u64)>,
    oldest: usize,
    /// First pair of the epoch; the line counts from there.
    origin: (u64, u64),
    newest: (u64, u64),
    rate: Option<RateEstimate>,
    line: Option<Line>,
    map: Option<ClockMap<A, B>>,
    suspects: Suspects,
    /// The suspects themselves, to start the next epoch with.
    held: Vec<(u64, u64)>,
    epoch: u32,
    counts: FitCounts,
    points: Vec<Point>,
    scratch: Vec<f64>,
}

impl<A: Clock, B: Clock> PairedFit<A, B> {
    /// A fit that has seen nothing. Allocates its window here and nothing afterwards.
    #[must_use]
    pub fn new(config: PairedConfig) -> Self {
        let config = PairedConfig {
            pairs: config.pairs.max(4),
            suspects_max: config.suspects_max.max(1),
            ..config
        };
        Self {
            pairs: Vec::with_capacity(config.pairs),
            oldest: 0,
            origin: (0, 0),
            newest: (0, 0),
            rate: None,
            line: None,
            map: None,
            suspects: Suspects::default(),
            held: Vec::with_capacity(config.suspects_max as usize),
            epoch: 0,
            counts: FitCounts::default(),
            points: Vec::with_capacity(config.pairs),
            scratch: Vec::with_capacity(config.pairs),
            config,
        }
    }

    /// The map as of the last pair; `None` until an epoch has enough pairs.
    #[must_use]
    pub fn map(&self) -> Option<&ClockMap<A, B>> {
        self.map.as_ref()
    }

    /// Whether the map's bound has come down to the configured figure.
    #[must_use]
    pub fn is_settled(&self) -> bool {
        self.map
            .is_some_and(|m| m.uncertainty_ns <= self.config.settled_ns)
    }

    /// Whether the newest pairs contradict the map.
    #[must_use]
    pub fn is_suspect(&self) -> bool {
        self.suspects.run > 0
    }

    /// Epochs opened so far.
    #[must_use]
    pub fn epoch(&self) -> u32 {
        self.epoch
    }

    /// Pairs and epochs by kind.
    #[must_use]
    pub fn counts(&self) -> FitCounts {
        self.counts
    }

    /// Lends the fit a rate measured elsewhere between the same two oscillators.
    pub fn set_rate(&mut self, rate: Option<RateEstimate>) {
        self.rate = rate;
    }

    /// Gives the present fit up, as when one of the devices is known to have restarted.
    pub fn reset(&mut self) {
        self.counts.epoch(EpochCause::Reset);
        self.forget();
    }

    /// Takes one pair: both clocks saw the same edge, at `a` and at `b`.
    pub fn observe(&mut self, a: Stamp<A>, b: Stamp<B>) -> Observation {
        let (a, b) = (a.as_nanos(), b.as_nanos());
        if self.pairs.is_empty() {
            self.accept(a, b);
            return Observation::Used;
        }
        if signed(b, self.newest.1) > self.config.silence_ns {
            return self.restart(EpochCause::Silence, &[(a, b)]);
        }
        let (da, db) = (signed(a, self.newest.0), signed(b, self.newest.1));
        if da == 0 && db == 0 {
            self.counts.late += 1;
            return Observation::Late;
        }
        if let Some(kind) = self.contradiction(a, b, da, db) {
            return self.suspect(a, b, kind);
        }
        self.counts.outliers += u64::from(self.suspects.run);
        self.suspects.clear();
        self.held.clear();
        self.accept(a, b);
        Observation::Used
    }

    fn contradiction(&self, a: u64, b: u64, da: i64, db: i64) -> Option<Contradiction> {
        if da <= 0 || db <= 0 {
            return Some(Contradiction::Backwards);
        }
        let (excess, doubt) = match &self.line {
            Some(line) => {
                let point = point(self.origin, (a, b));
                (
                    point.y - line.at(point.x),
                    line.quantile() * line.sd_at(point.x),
                )
            }
            // Before there is a line, only the bound on skew and the jitter of two stamps.
            None => (
                (i128::from(db) - i128::from(da)) as f64,
                da as f64 * self.config.skew_ppb_max as f64 * 1e-9,
            ),
        };
        let limit = self.config.gate_ns as f64 + doubt;
        if excess < -limit {
            Some(Contradiction::Early)
        } else if excess > limit {
            Some(Contradiction::Late)
        } else {
            None
        }
    }

    fn suspect(&mut self, a: u64, b: u64, kind: Contradiction) -> Observation {
        let before = self.suspects.run;
        // Suspects agree when the skew bound over their distance and the gate allow it.
        let far = self
            .held
            .first()
            .map_or(0, |h| signed(a, h.0).saturating_abs());
        let allowed = i128::from(far) * i128::from(self.config.skew_ppb_max) / 1_000_000_000;
        let tolerance = i64::try_from(allowed).unwrap_or(i64::MAX);
        self.suspects
            .push(a, b, kind, tolerance.saturating_add(self.config.gate_ns));
        if self.suspects.run == 1 {
            self.counts.outliers += u64::from(before);
            self.held.clear();
        }
        self.held.push((a, b));
        if self.suspects.run < self.config.suspects_max {
            return Observation::Suspect;
        }
        let cause = match kind {
            Contradiction::Backwards => EpochCause::Backwards,
            Contradiction::Early | Contradiction::Late => EpochCause::Step,
        };
        let held = core::mem::take(&mut self.held);
        let outcome = self.restart(cause, &held);
        self.held = held;
        self.held.clear();
        outcome
    }

    fn restart(&mut self, cause: EpochCause, seeds: &[(u64, u64)]) -> Observation {
        self.counts.epoch(cause);
        self.forget();
        for &(a, b) in seeds {
            self.accept(a, b);
        }
        Observation::NewEpoch(cause)
    }

    fn forget(&mut self) {
        self.epoch = self.epoch.wrapping_add(1);
        self.pairs.clear();
        self.oldest = 0;
        self.line = None;
        self.map = None;
        self.suspects.clear();
        self.held.clear();
    }

    fn accept(&mut self, a: u64, b: u64) {
        self.counts.used += 1;
        self.newest = (a, b);
        if self.pairs.is_empty() {
            self.origin = (a, b);
        }
        if self.pairs.len() < self.config.pairs {
            self.pairs.push((a, b));
        } else {
            self.pairs[self.oldest] = (a, b);
            self.oldest = (self.oldest + 1) % self.pairs.len();
        }
        self.refit();
    }

    fn refit(&mut self) {
        let (origin, newest, window) = (self.origin, self.newest.0, self.config.window_ns);
        let recent = self.pairs.iter().filter(|p| signed(newest, p.0) <= window);
        self.points.clear();
        self.points.extend(recent.map(|&p| point(origin, p)));
        let unknown = self.config.skew_ppb_max as f64 * 0.5;
        let (rate, rate_sd) = match self.rate {
            Some(rate) => (
                rate.rate_ppb,
                (rate.sd_ppb.max(1.0) * RATE_TRUST).min(unknown),
            ),
            None => (0.0, unknown),
        };
        let prior = Prior {
            slope: rate * 1e-9,
            slope_sd: rate_sd * 1e-9,
            slope_limit: self.config.skew_ppb_max as f64 * 1e-9,
            noise: self.config.jitter_ns as f64,
            noise_weight: 4.0,
            noise_floor: 1.0,
        };
        let start = self.line.map(|l| (l.at(0.0), l.slope));
        self.line = line::fit(&self.points, start, &prior, &mut self.scratch);
        self.map = None;
        if let Some(line) = self.line.filter(|l| l.used >= self.config.pairs_min) {
            self.map = Some(self.to_map(&line));
        }
    }

    /// From the line to the instants of the edges: nowhere when errors have two sides, down to the
    /// least delay when they have one; unknown in between.
    fn shift(&self, line: &Line, x: f64) -> Shift {
        let plain = Shift {
            shift: 0.0,
            bound: line.quantile() * line.sd_at(x),
        };
        if !self.config.may_lag {
            return plain;
        }
        let limit = line::REJECT * line.noise;
        let kept = || {
            let residuals = self.points.iter().map(|p| (p.x, p.y - line.at(p.x)));
            residuals.filter(move |(_, r)| r.abs() <= limit)
        };
        let (mut n, mut mean, mut least) = (0.0, 0.0, (0.0, f64::INFINITY));
        for (x, r) in kept() {
            (n, mean) = (n + 1.0, mean + r);
            if r < least.1 {
                least = (x, r);
            }
        }
        mean /= n;
        let (mut squares, mut cubes) = (0.0, 0.0);
        for (_, r) in kept() {
            let d = r - mean;
            (squares, cubes) = (squares + d * d, cubes + d * d * d);
        }
        let sd = (squares / n).sqrt();
        let skewness = cubes / n / (sd * sd * sd);
        let lag = mean - least.1;
        if n >= SHAPE_COUNT && skewness < SKEWNESS.0 {
            plain
        } else if n >= SHAPE_COUNT && skewness > SKEWNESS.1 && lag < STEEP * sd {
            let tilt = line.quantile() * line.slope_sd * (x - least.0).abs();
            let bound = LEAST_BOUND * lag / n + tilt + self.config.tick_ns as f64;
            Shift {
                shift: least.1 - lag / n,
                bound,
            }
        } else {
            Shift {
                bound: plain.bound + line.noise,
                ..plain
            }
        }
    }

    fn to_map(&self, line: &Line) -> ClockMap<A, B> {
        let x = signed(self.newest.0, self.origin.0);
        let Shift { shift, bound } = self.shift(line, x as f64);
        let y = (line.at(x as f64) + shift).round() as i64;
        let b = i128::from(self.origin.1) + i128::from(x) + i128::from(y);
        ClockMap {
            anchor: (
                Stamp::from_nanos(self.newest.0),
                Stamp::from_nanos(u64::try_from(b.max(0)).unwrap_or(u64::MAX)),
            ),
            rate_ppb: to_ppb(line.slope),
            uncertainty_ns: to_bound_ns(bound),
            growth_ppb: to_bound_ns(line.quantile() * line.slope_sd * 1e9)
                .saturating_add(self.config.wander_ppb),
            epoch: self.epoch,
        }
    }
}

/// A pair as (time since `origin`, change of offset since then).
fn point(origin: (u64, u64), pair: (u64, u64)) -> Point {
    let (x, y) = (signed(pair.0, origin.0), signed(pair.1, origin.1));
    let y = (i128::from(y) - i128::from(x)) as f64;
    Point {
        x: x as f64,
        y,
        scale: 1.0,
    }
}

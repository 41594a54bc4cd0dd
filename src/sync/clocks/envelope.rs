//! A clock map from arrivals alone: the lower envelope of arrival minus sensor time.
//!
//! A packet arrives a constant plus a random delay after the instant it is stamped with. The
//! constant cannot be seen from arrivals (it is calibration, `fixed_delay_ns`); the random part is
//! never negative and often close to zero, so the lowest points of a second of packets lie on a
//! line. Time is cut into buckets, each reduced to its lower convex hull; a robust line goes
//! through the buckets' lowest points, and the height of a minimum above the true bound is
//! estimated from the scatter of the minima and taken off.

use noctule_sensor::{Clock, ClockMap, Stamp};

use super::epoch::{Contradiction, EpochCause, FitCounts, Observation, Suspects};
use super::hull::Bucket;
use super::line::{self, Line, Point, Prior};
use super::{RateEstimate, signed, to_bound_ns, to_ppb};

/// Settings of an [`EnvelopeFit`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EnvelopeConfig {
    /// Length of a bucket of sensor time, nanoseconds.
    pub bucket_ns: i64,
    /// Buckets in the sliding window.
    pub buckets: usize,
    /// Buckets needed before the fit calls itself settled.
    pub buckets_settled: usize,
    /// A bucket with fewer readings is not used.
    pub bucket_count_min: u32,
    /// Calibrated constant delay from stamp to arrival, nanoseconds.
    pub fixed_delay_ns: i64,
    /// Two-sided jitter of the stamps themselves (standard deviation), nanoseconds: lets readings
    /// fall below the envelope, so that the bias of a minimum is not known. 0 for a counter.
    pub stamp_jitter_ns: i64,
    /// Bound on the skew of an oscillator, parts per billion.
    pub skew_ppb_max: i64,
    /// A change of the envelope beyond this is a step, nanoseconds.
    pub step_ns: i64,
    /// A reading later than this is a stall or a step, never a delay, nanoseconds.
    pub stall_ns: i64,
    /// Suspects in agreement that open a new epoch.
    pub suspects_max: u32,
    /// Late suspects must also cover this much sensor time: a stalled host hands over its backlog
    /// late, but the backlog shrinks; nanoseconds.
    pub late_span_ns: i64,
    /// A reading this much before the newest is an overtaken packet, not a clock that went back.
    pub reorder_ns: i64,
    /// Arrival-clock time without a reading after which the fit is given up, nanoseconds.
    pub silence_ns: i64,
    /// How fast the skew itself may wander: added to the growth of uncertainty, ppb.
    pub wander_ppb: u64,
}

impl EnvelopeConfig {
    /// USB transfers of an event camera: one every 1 to 4 ms, 1 ms mean random delay.
    #[must_use]
    pub const fn usb() -> Self {
        Self {
            bucket_ns: 1_000_000_000,
            buckets: 64,
            buckets_settled: 8,
            bucket_count_min: 8,
            fixed_delay_ns: 0,
            stamp_jitter_ns: 0,
            skew_ppb_max: 200_000,
            step_ns: 3_000_000,
            stall_ns: 100_000_000,
            suspects_max: 8,
            late_span_ns: 250_000_000,
            reorder_ns: 20_000_000,
            silence_ns: 5_000_000_000,
            wander_ppb: 0,
        }
    }

    /// Datagrams of a LiDAR: thousands a second, 30 us mean random delay.
    #[must_use]
    pub const fn udp() -> Self {
        Self {
            step_ns: 200_000,
            ..Self::usb()
        }
    }

    /// Frames of a camera: a few a second, 0.2 ms mean random delay.
    #[must_use]
    pub const fn v4l2() -> Self {
        Self {
            bucket_ns: 3_000_000_000,
            buckets: 48,
            buckets_settled: 8,
            stamp_jitter_ns: 20_000,
            suspects_max: 3,
            late_span_ns: 400_000_000,
            ..Self::usb()
        }
    }
}

/// Bias of a bucket's minimum, in units of the scatter of minima. An exponential delay gives 1, an
/// exponential delay blurred by a stamp's resolution up to 1.9: the middle is taken off.
const BIAS: f64 = 1.45;
/// What the true bias may differ from [`BIAS`] by, in the same unit; added to the 99 % bound.
const BIAS_DOUBT: f64 = 0.8;
/// Readings needed for the first, coarse map of an epoch.
const COARSE_COUNT: u32 = 8;

/// Origin of an epoch: stamps are handled as nanoseconds from here.
#[derive(Debug, Clone, Copy)]
struct Origin {
    a: u64,
    b: u64,
}

/// Sliding-window fit of sensor clock `A` onto arrival clock `B`.
#[derive(Debug)]
pub struct EnvelopeFit<A: Clock, B: Clock> {
    config: EnvelopeConfig,
    origin: Option<Origin>,
    /// Closed buckets, oldest first from `oldest`, used as a ring of `config.buckets`.
    closed: Vec<Bucket>,
    oldest: usize,
    open: Bucket,
    /// Sensor time at which `open` ends, nanoseconds from the origin.
    open_until: f64,
    newest: (u64, u64),
    line: Option<Line>,
    map: Option<ClockMap<A, B>>,
    /// The bucket closed last lay above the line by this much, and was not trusted.
    raised: Option<f64>,
    suspects: Suspects,
    epoch: u32,
    counts: FitCounts,
    points: Vec<Point>,
    scratch: Vec<f64>,
}

impl<A: Clock, B: Clock> EnvelopeFit<A, B> {
    /// A fit that has seen nothing. Allocates its window here and nothing afterwards.
    #[must_use]
    pub fn new(config: EnvelopeConfig) -> Self {
        let room = config.buckets.max(2) + 1;
        Self {
            config,
            origin: None,
            closed: Vec::with_capacity(room),
            oldest: 0,
            open: Bucket::EMPTY,
            open_until: 0.0,
            newest: (0, 0),
            line: None,
            map: None,
            raised: None,
            suspects: Suspects::default(),
            epoch: 0,
            counts: FitCounts::default(),
            points: Vec::with_capacity(room),
            scratch: Vec::with_capacity(room),
        }
    }

    /// The map as of the last reading that changed it; `None` until an epoch has enough readings.
    #[must_use]
    pub fn map(&self) -> Option<&ClockMap<A, B>> {
        self.map.as_ref()
    }

    /// Whether enough buckets stand behind the map for its bound to be tight.
    #[must_use]
    pub fn is_settled(&self) -> bool {
        self.map.is_some()
            && self
                .line
                .is_some_and(|l| l.used >= self.config.buckets_settled)
    }

    /// Whether the newest readings contradict the map.
    #[must_use]
    pub fn is_suspect(&self) -> bool {
        self.suspects.run > 0
    }

    /// Epochs opened so far.
    #[must_use]
    pub fn epoch(&self) -> u32 {
        self.epoch
    }

    /// Readings and epochs by kind.
    #[must_use]
    pub fn counts(&self) -> FitCounts {
        self.counts
    }

    /// The rate of `B` against `A` once settled, finer than the map's whole ppb.
    #[must_use]
    pub fn rate(&self) -> Option<RateEstimate> {
        let line = self.line.filter(|_| self.is_settled())?;
        Some(RateEstimate {
            rate_ppb: line.slope * 1e9,
            sd_ppb: line.slope_sd * 1e9,
        })
    }

    /// Gives the present fit up, as when the device is known to have restarted.
    pub fn reset(&mut self) {
        self.counts.epoch(EpochCause::Reset);
        self.forget();
    }

    /// Takes one reading: something stamped `a` by the sensor arrived at `b`.
    pub fn observe(&mut self, a: Stamp<A>, b: Stamp<B>) -> Observation {
        let (a, b) = (
            a.as_nanos(),
            b.offset_nanos(-self.config.fixed_delay_ns).as_nanos(),
        );
        let Some(origin) = self.origin else {
            self.begin(a, b);
            self.accept(0.0, 0.0, a, b);
            return Observation::Used;
        };
        if signed(b, self.newest.1) > self.config.silence_ns {
            return self.restart(EpochCause::Silence, a, b);
        }
        let ahead = signed(a, self.newest.0);
        let (x, da) = (
            signed(a, origin.a) as f64,
            i128::from(a) - i128::from(origin.a),
        );
        let y = (i128::from(b) - i128::from(origin.b) - da) as f64;
        if let Some(kind) = self.contradiction(ahead, x, y) {
            return self.suspect(a, b, kind);
        }
        if ahead <= 0 {
            self.counts.late += 1;
            return Observation::Late;
        }
        self.suspects.clear();
        if x >= self.open_until && self.close_bucket(x) {
            return self.restart(EpochCause::Step, a, b);
        }
        self.accept(x, y, a, b);
        Observation::Used
    }

    /// How a reading contradicts what is known, if it does.
    fn contradiction(&self, ahead: i64, x: f64, y: f64) -> Option<Contradiction> {
        if ahead < -self.config.reorder_ns {
            return Some(Contradiction::Backwards);
        }
        let line = self.line.as_ref()?;
        let excess = y - line.at(x);
        let doubt = line.quantile() * line.sd_at(x);
        if excess < -(self.config.step_ns as f64 + doubt) {
            Some(Contradiction::Early)
        } else if excess > self.config.stall_ns as f64 + doubt {
            Some(Contradiction::Late)
        } else {
            None
        }
    }

    fn suspect(&mut self, a: u64, b: u64, kind: Contradiction) -> Observation {
        self.suspects.push(a, b, kind, self.config.stall_ns / 2);
        let confirmed = self.suspects.run >= self.config.suspects_max
            && (kind != Contradiction::Late || self.suspects.span_ns >= self.config.late_span_ns);
        if !confirmed {
            self.counts.outliers += 1;
            return Observation::Suspect;
        }
        let cause = match kind {
            Contradiction::Backwards => EpochCause::Backwards,
            Contradiction::Early | Contradiction::Late => EpochCause::Step,
        };
        self.restart(cause, a, b)
    }

    /// Opens a new epoch with this reading.
    fn restart(&mut self, cause: EpochCause, a: u64, b: u64) -> Observation {
        self.counts.epoch(cause);
        self.forget();
        self.begin(a, b);
        self.accept(0.0, 0.0, a, b);
        Observation::NewEpoch(cause)
    }

    fn forget(&mut self) {
        self.epoch = self.epoch.wrapping_add(1);
        self.origin = None;
        self.closed.clear();
        self.oldest = 0;
        self.open = Bucket::EMPTY;
        self.line = None;
        self.map = None;
        self.raised = None;
        self.suspects.clear();
    }

    fn begin(&mut self, a: u64, b: u64) {
        self.origin = Some(Origin { a, b });
        self.open_until = self.config.bucket_ns as f64;
    }

    fn accept(&mut self, x: f64, y: f64, a: u64, b: u64) {
        self.counts.used += 1;
        self.newest = (a, b);
        self.open.push(x, y);
        // Until buckets have closed, a growing first bucket gives a coarse map.
        let count = self.open.count;
        let doubled = count >= COARSE_COUNT && count.is_power_of_two();
        if self.closed.len() < 2 && doubled {
            self.refit();
        }
    }

    /// Ends the open bucket because a reading at `x` lies beyond it; `true` when the bucket shows
    /// that the envelope has stepped.
    fn close_bucket(&mut self, x: f64) -> bool {
        let bucket = core::mem::replace(&mut self.open, Bucket::EMPTY);
        let length = self.config.bucket_ns.max(1) as f64;
        self.open_until += length * (((x - self.open_until) / length).floor() + 1.0);
        if bucket.count < self.config.bucket_count_min {
            return false;
        }
        if self.has_stepped(&bucket) {
            return true;
        }
        if self.closed.len() < self.config.buckets.max(2) {
            self.closed.push(bucket);
        } else {
            self.closed[self.oldest] = bucket;
            self.oldest = (self.oldest + 1) % self.closed.len();
        }
        self.refit();
        false
    }

    /// Below the envelope there is no excuse; above it, a busy host may delay everything for one
    /// bucket, but not two by the same amount.
    fn has_stepped(&mut self, bucket: &Bucket) -> bool {
        let Some(line) = self.line.filter(|_| self.closed.len() >= 2) else {
            return false;
        };
        let Some((x, y)) = bucket.lowest(line.slope) else {
            return false;
        };
        // Delays that are not quite exponential scatter the minima of n readings by less than
        // their mean over the root of n.
        let scatter = 2.0 * bucket.mean_excess(line.slope) / f64::from(bucket.count).sqrt();
        let allowed = scatter.max(self.config.step_ns as f64 / 8.0);
        let limit = line.quantile() * (line.sd_at(x) + 4.0 * line.noise) + allowed;
        let excess = y - line.at(x);
        let before = self.raised.take();
        if excess < -limit {
            return true;
        }
        if excess > limit {
            self.raised = Some(excess);
            return before.is_some_and(|b| (b - excess).abs() < limit);
        }
        false
    }

    /// Fits the line through the buckets' lowest points and states the map.
    fn refit(&mut self) {
        let coarse = self.closed.len() < 2;
        let mut slope = self.line.map_or(0.0, |l| l.slope);
        for _ in 0..3 {
            let Some(line) = self.fit_once(slope, coarse) else {
                return;
            };
            slope = line.slope;
            self.line = Some(line);
        }
        self.state_map();
    }

    fn fit_once(&mut self, slope: f64, coarse: bool) -> Option<Line> {
        let buckets = || self.closed.iter().chain(coarse.then_some(&self.open));
        self.scratch.clear();
        self.scratch.extend(buckets().map(|b| f64::from(b.count)));
        let typical = line::median(&mut self.scratch)?;
        let (mut expected, mut used) = (0.0, 0.0);
        self.points.clear();
        for bucket in buckets() {
            let (x, y) = bucket.lowest(slope)?;
            // The minimum of n readings scatters as 1/n.
            let scale = (typical / f64::from(bucket.count.max(1))).clamp(0.5, 8.0);
            self.points.push(Point { x, y, scale });
            expected += bucket.mean_excess(slope) / typical;
            used += 1.0;
        }
        let prior = Prior {
            slope: 0.0,
            slope_sd: self.config.skew_ppb_max as f64 * 0.5e-9,
            slope_limit: self.config.skew_ppb_max as f64 * 1e-9,
            noise: (expected / used).max(1.0),
            noise_weight: 2.0,
            noise_floor: 1.0,
        };
        line::fit(&self.points, None, &prior, &mut self.scratch)
    }

    fn state_map(&mut self) {
        let (Some(line), Some(origin)) = (self.line, self.origin) else {
            return;
        };
        let x = signed(self.newest.0, origin.a) as f64;
        let jitter = self.config.stamp_jitter_ns as f64;
        let bias = if jitter > 0.0 { 0.0 } else { BIAS * line.noise };
        let y = line.at(x) - bias;
        let b = i128::from(origin.b) + i128::from(self.newest.0) - i128::from(origin.a);
        let b = b + i128::from(y.round() as i64);
        let doubt = (BIAS_DOUBT * line.noise).max(jitter);
        let bound = line.quantile() * line.sd_at(x) + doubt;
        self.map = Some(ClockMap {
            anchor: (
                Stamp::from_nanos(self.newest.0),
                Stamp::from_nanos(u64::try_from(b.max(0)).unwrap_or(u64::MAX)),
            ),
            rate_ppb: to_ppb(line.slope),
            uncertainty_ns: to_bound_ns(bound),
            growth_ppb: to_bound_ns(line.quantile() * line.slope_sd * 1e9)
                .saturating_add(self.config.wander_ppb),
            epoch: self.epoch,
        });
    }
}

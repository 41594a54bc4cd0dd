//! Decides when the bundle of an exposure is closed: complete by watermark, partial at its
//! deadline, and in order.
//!
//! Deadlines run on the arrival stamps of the inputs, never on a clock: the same inputs in the
//! same order close the same bundles, live or in replay. Holds no data, only decisions.

use noctule_sensor::{ClockMap, Evk4, Realtime, Stamp, Tai};

use super::exposures::{Exposure, ExposureEvent, ExposureFlags};

/// A stream that contributes to bundles.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Stream {
    /// Events of the event camera.
    Events,
    /// Returns of the LiDAR.
    Lidar,
    /// The vehicle's motion.
    Motion,
    /// Images of the frame camera.
    Images,
}

impl Stream {
    /// All of them, in the order of their index.
    pub const ALL: [Self; 4] = [Self::Events, Self::Lidar, Self::Motion, Self::Images];

    /// Place in arrays of one value per stream.
    #[must_use]
    pub const fn index(self) -> usize {
        self as usize
    }
}

/// A set of streams.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Streams(u8);

impl Streams {
    /// No stream.
    pub const NONE: Self = Self(0);
    /// Every stream.
    pub const ALL: Self = Self(0b1111);

    /// This set and `stream`.
    #[must_use]
    pub const fn with(self, stream: Stream) -> Self {
        Self(self.0 | 1 << stream.index())
    }

    /// This set less `stream`.
    #[must_use]
    pub const fn without(self, stream: Stream) -> Self {
        Self(self.0 & !(1 << stream.index()))
    }

    /// Whether `stream` is in the set.
    #[must_use]
    pub const fn contains(self, stream: Stream) -> bool {
        self.0 >> stream.index() & 1 == 1
    }

    /// Whether the set is empty.
    #[must_use]
    pub const fn is_empty(self) -> bool {
        self.0 == 0
    }

    /// The set as bits, bit n for the stream of index n.
    #[must_use]
    pub const fn bits(self) -> u8 {
        self.0
    }

    const fn less(self, other: Self) -> Self {
        Self(self.0 & !other.0)
    }
}

/// Settings of a [`BundleCloser`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BundleConfig {
    /// Streams a complete bundle needs.
    pub enabled: Streams,
    /// From the arrival of the closing edge to the latest decision, nanoseconds.
    pub deadline_ns: i64,
    /// From the arrival of an opening edge to the arrival of its closing edge at the latest,
    /// nanoseconds.
    pub open_ns_max: i64,
    /// Exposures pending at once; one more, and the oldest goes out as it is.
    pub pending_max: usize,
}

impl Default for BundleConfig {
    fn default() -> Self {
        Self {
            enabled: Streams::ALL,
            deadline_ns: 150_000_000,
            open_ns_max: 1_100_000_000,
            pending_max: 8,
        }
    }
}

/// Why a bundle was closed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ClosedBy {
    /// Every enabled stream had passed the exposure's close and its image was there.
    Complete,
    /// Nothing more could come: every stream had passed, been restarted, or lost its image.
    NothingMissingCanCome,
    /// Its deadline had come.
    Deadline,
    /// There were too many pending.
    Overflow,
    /// The input had ended.
    End,
}

/// A closed bundle: what the host now rasters and sends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BundleDecision {
    /// Counts decisions, from 0.
    pub sequence: u64,
    /// The exposure. When its close was never seen, `close` is the predicted one, or `open`.
    pub exposure: Exposure,
    /// Shutter opens on the common timeline, if there was a map.
    pub open_tai: Option<Stamp<Tai>>,
    /// Shutter closes on the common timeline, if there was a map.
    pub close_tai: Option<Stamp<Tai>>,
    /// 99 % bound on the error of both, nanoseconds.
    pub uncertainty_ns: u64,
    /// Why now.
    pub closed_by: ClosedBy,
    /// Enabled streams that had not delivered all they had for it.
    pub missing: Streams,
    /// Streams that restarted or jumped while it was pending.
    pub restarted: Streams,
    /// Units (as each stream counts them) lost since the bundle before, by [`Stream::index`].
    pub lost: [u64; 4],
    /// Arrival stamp of the input that closed it.
    pub closed_at: Stamp<Realtime>,
}

impl BundleDecision {
    /// Whether something that was enabled is missing.
    #[must_use]
    pub fn is_partial(&self) -> bool {
        !self.missing.is_empty()
    }
}

/// Bundles and exposures by what became of them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct BundleCounts {
    /// Bundles closed with nothing missing.
    pub complete: u64,
    /// Bundles closed with something missing.
    pub partial: u64,
    /// Of all, those closed by their deadline.
    pub by_deadline: u64,
    /// Of all, those closed because too many were pending.
    pub by_overflow: u64,
    /// Exposures taken back before they were bundled.
    pub discarded: u64,
    /// Words about exposures already bundled, such as an image after the deadline.
    pub too_late: u64,
    /// Arrival stamps that went back by more than a scheduling hiccup.
    pub arrival_steps: u64,
    /// Losses reported, by [`Stream::index`].
    pub lost: [u64; 4],
}

/// An exposure on its way to becoming a bundle.
#[derive(Debug, Clone, Copy)]
struct Pending {
    exposure: Exposure,
    is_closed: bool,
    tai: Option<(Stamp<Tai>, Stamp<Tai>, u64)>,
    /// Streams that have delivered all they have for it.
    passed: Streams,
    /// Streams that will never pass it.
    given_up: Streams,
    restarted: Streams,
    lost: [u64; 4],
    deadline: Stamp<Realtime>,
}

/// Arrival stamps of different threads may be out of order by this much, nanoseconds.
const HICCUP_NS: i64 = 50_000_000;

/// Closes bundles by watermark or deadline.
#[derive(Debug)]
pub struct BundleCloser {
    config: BundleConfig,
    /// Oldest first; at most `config.pending_max`.
    pending: Vec<Pending>,
    events: Option<Stamp<Evk4>>,
    /// Watermarks of the other streams on the common timeline, by index.
    watermarks: [Option<Stamp<Tai>>; 4],
    /// Losses with no exposure to charge yet.
    carried: [u64; 4],
    now: Stamp<Realtime>,
    sequence: u64,
    counts: BundleCounts,
}

impl BundleCloser {
    /// Nothing pending. Allocates here and nothing afterwards.
    #[must_use]
    pub fn new(config: BundleConfig) -> Self {
        let config = BundleConfig {
            pending_max: config.pending_max.max(1),
            ..config
        };
        Self {
            config,
            pending: Vec::with_capacity(config.pending_max),
            events: None,
            watermarks: [None; 4],
            carried: [0; 4],
            now: Stamp::ZERO,
            sequence: 0,
            counts: BundleCounts::default(),
        }
    }

    /// What became of exposures.
    #[must_use]
    pub fn counts(&self) -> BundleCounts {
        self.counts
    }

    /// Exposures announced and not yet bundled.
    #[must_use]
    pub fn pending_count(&self) -> usize {
        self.pending.len()
    }

    /// The earliest instant at which [`arrival`](Self::arrival) will close something by itself.
    #[must_use]
    pub fn next_deadline(&self) -> Option<Stamp<Realtime>> {
        self.pending.iter().map(|p| p.deadline).min()
    }

    /// Takes what an exposure tracker said, at the arrival of the input that made it speak.
    pub fn exposure(
        &mut self,
        event: &ExposureEvent,
        map: Option<&ClockMap<Evk4, Tai>>,
        now: Stamp<Realtime>,
        emit: &mut impl FnMut(BundleDecision),
    ) {
        self.set_now(now, emit);
        match *event {
            ExposureEvent::Opened {
                id,
                open,
                close_predicted,
                flags,
            } => {
                let close = close_predicted.unwrap_or(open);
                self.open(
                    Exposure {
                        id,
                        open,
                        close,
                        image: None,
                        flags,
                    },
                    emit,
                );
            }
            ExposureEvent::Closed(exposure) => {
                let deadline = self.now.offset_nanos(self.config.deadline_ns);
                self.update(exposure, map, |p| {
                    p.is_closed = true;
                    p.deadline = deadline;
                });
            }
            ExposureEvent::Imaged { exposure, .. } => self.update(exposure, map, |p| {
                p.passed = p.passed.with(Stream::Images);
            }),
            ExposureEvent::ImageMissing(exposure) => self.update(exposure, map, |p| {
                p.given_up = p.given_up.with(Stream::Images);
            }),
            ExposureEvent::Discarded { id, .. } => self.discard(id),
            ExposureEvent::ImageLeftOut { .. } => {}
        }
        self.close_ready(emit);
    }

    /// No event stamped before `watermark` will follow.
    pub fn events_passed(
        &mut self,
        watermark: Stamp<Evk4>,
        now: Stamp<Realtime>,
        emit: &mut impl FnMut(BundleDecision),
    ) {
        self.set_now(now, emit);
        self.events = Some(watermark);
        self.note_passed();
        self.close_ready(emit);
    }

    /// No sample of `stream` older than `watermark` will follow.
    pub fn passed(
        &mut self,
        stream: Stream,
        watermark: Stamp<Tai>,
        now: Stamp<Realtime>,
        emit: &mut impl FnMut(BundleDecision),
    ) {
        self.set_now(now, emit);
        self.watermarks[stream.index()] = Some(watermark);
        self.note_passed();
        self.close_ready(emit);
    }

    /// `stream` lost `count` units; charged to the oldest exposure it has not passed, or to the
    /// next one.
    pub fn lost(&mut self, stream: Stream, count: u64) {
        let index = stream.index();
        self.counts.lost[index] = self.counts.lost[index].saturating_add(count);
        let charged = self.pending.iter_mut().find(|p| !p.passed.contains(stream));
        let lost = charged.map_or(&mut self.carried[index], |p| &mut p.lost[index]);
        *lost = lost.saturating_add(count);
    }

    /// `stream` restarted or its clock jumped: what it still owed the pending exposures will not
    /// come, and its old watermark means nothing.
    pub fn restarted(
        &mut self,
        stream: Stream,
        now: Stamp<Realtime>,
        emit: &mut impl FnMut(BundleDecision),
    ) {
        self.set_now(now, emit);
        self.watermarks[stream.index()] = None;
        if stream == Stream::Events {
            self.events = None;
        }
        for pending in &mut self.pending {
            pending.restarted = pending.restarted.with(stream);
            if !pending.passed.contains(stream) {
                pending.given_up = pending.given_up.with(stream);
            }
        }
        self.close_ready(emit);
    }

    /// Something arrived at `now`, from whatever stream: closes what is due.
    pub fn arrival(&mut self, now: Stamp<Realtime>, emit: &mut impl FnMut(BundleDecision)) {
        self.set_now(now, emit);
    }

    /// The input has ended: everything pending goes out as it is.
    pub fn finish(&mut self, emit: &mut impl FnMut(BundleDecision)) {
        self.close_ready(emit);
        while !self.pending.is_empty() {
            self.close_oldest(ClosedBy::End, emit);
        }
    }

    /// Arrival time has come to `now`: closes what is due before the input itself is considered,
    /// so that inputs of one instant may come in any order. Arrival time never goes back; when the
    /// host's clock was set back, deadlines move with it.
    fn set_now(&mut self, now: Stamp<Realtime>, emit: &mut impl FnMut(BundleDecision)) {
        let step = now.diff_nanos(self.now);
        if step < -HICCUP_NS {
            self.counts.arrival_steps += 1;
            for pending in &mut self.pending {
                pending.deadline = pending.deadline.offset_nanos(step);
            }
            self.now = now;
        } else {
            self.now = self.now.max(now);
        }
        self.close_ready(emit);
    }

    fn open(&mut self, exposure: Exposure, emit: &mut impl FnMut(BundleDecision)) {
        if self.pending.len() == self.config.pending_max {
            self.close_oldest(ClosedBy::Overflow, emit);
        }
        let wait = self
            .config
            .open_ns_max
            .saturating_add(self.config.deadline_ns);
        self.pending.push(Pending {
            exposure,
            is_closed: false,
            tai: None,
            passed: Streams::NONE,
            given_up: Streams::NONE,
            restarted: Streams::NONE,
            lost: core::mem::take(&mut self.carried),
            deadline: self.now.offset_nanos(wait),
        });
    }

    fn update(
        &mut self,
        exposure: Exposure,
        map: Option<&ClockMap<Evk4, Tai>>,
        change: impl FnOnce(&mut Pending),
    ) {
        let Some(pending) = self
            .pending
            .iter_mut()
            .find(|p| p.exposure.id == exposure.id)
        else {
            self.counts.too_late += 1;
            return;
        };
        pending.exposure = exposure;
        if let Some(map) = map {
            let bound = map
                .uncertainty_at(exposure.open)
                .max(map.uncertainty_at(exposure.close));
            pending.tai = Some((map.apply(exposure.open), map.apply(exposure.close), bound));
        }
        change(pending);
        self.note_passed();
    }

    fn discard(&mut self, id: u64) {
        let Some(index) = self.pending.iter().position(|p| p.exposure.id == id) else {
            self.counts.too_late += 1;
            return;
        };
        let lost = self.pending.remove(index).lost;
        self.counts.discarded += 1;
        // Its losses are still losses: they go to the neighbour that is left, or to the next.
        let heir = self
            .pending
            .get_mut(index)
            .map_or(&mut self.carried, |p| &mut p.lost);
        for (heir, lost) in heir.iter_mut().zip(lost) {
            *heir = heir.saturating_add(lost);
        }
    }

    /// Latches, for every closed exposure, the streams whose watermark has reached its close.
    fn note_passed(&mut self) {
        for pending in self.pending.iter_mut().filter(|p| p.is_closed) {
            if self.events.is_some_and(|w| w >= pending.exposure.close) {
                pending.passed = pending.passed.with(Stream::Events);
            }
            let Some((_, close, _)) = pending.tai else {
                continue;
            };
            for stream in [Stream::Lidar, Stream::Motion] {
                if self.watermarks[stream.index()].is_some_and(|w| w >= close) {
                    pending.passed = pending.passed.with(stream);
                }
            }
        }
    }

    /// Closes from the oldest on as long as one is ready or due.
    fn close_ready(&mut self, emit: &mut impl FnMut(BundleDecision)) {
        while let Some(oldest) = self.pending.first() {
            let open = self.config.enabled.less(oldest.passed);
            let by = if oldest.is_closed && open.is_empty() {
                ClosedBy::Complete
            } else if oldest.is_closed && open.less(oldest.given_up).is_empty() {
                ClosedBy::NothingMissingCanCome
            } else if self.pending.iter().any(|p| self.now >= p.deadline) {
                // One that is due pushes out the older ones it has overtaken.
                ClosedBy::Deadline
            } else {
                return;
            };
            self.close_oldest(by, emit);
        }
    }

    fn close_oldest(&mut self, closed_by: ClosedBy, emit: &mut impl FnMut(BundleDecision)) {
        let pending = self.pending.remove(0);
        let mut exposure = pending.exposure;
        let missing = self.config.enabled.less(pending.passed);
        if missing.contains(Stream::Images) {
            exposure.flags |= ExposureFlags::IMAGE_MISSING;
        }
        if missing.is_empty() {
            self.counts.complete += 1;
        } else {
            self.counts.partial += 1;
        }
        self.counts.by_deadline += u64::from(closed_by == ClosedBy::Deadline);
        self.counts.by_overflow += u64::from(closed_by == ClosedBy::Overflow);
        let sequence = self.sequence;
        self.sequence += 1;
        emit(BundleDecision {
            sequence,
            exposure,
            open_tai: pending.tai.map(|(open, _, _)| open),
            close_tai: pending.tai.map(|(_, close, _)| close),
            uncertainty_ns: pending.tai.map_or(u64::MAX, |(_, _, bound)| bound),
            closed_by,
            missing,
            restarted: pending.restarted,
            lost: pending.lost,
            closed_at: self.now,
        });
    }
}

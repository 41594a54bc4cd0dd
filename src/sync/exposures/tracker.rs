//! Exposures and their images: who belongs to whom, and when to say that nobody will come.
//!
//! An image is placed by mapping edges onto the clock of its driver stamp; the width must agree
//! with what the camera was set to, and no second exposure may be near. Whatever is in doubt is
//! left out and counted: a missing image costs one bundle, a wrong one is a lie.

use noctule_sensor::{ClockMap, Evk4, Monotonic, Stamp, TriggerEdge};

use super::exposure::{
    DiscardReason, Exposure, ExposureCounts, ExposureEvent, ExposureFlags, ImageStamp,
    LeftOutReason, StampedAt, StrobePair,
};
use super::strobe::{Shutter, Strobe, StrobeConfig};
use crate::sync::MapSource;

/// A clock map to place images with, and what it rests on.
pub type ImageMap = (ClockMap<Evk4, Monotonic>, MapSource);

/// Settings of an [`ExposureTracker`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TrackerConfig {
    /// The strobe line.
    pub strobe: StrobeConfig,
    /// How far a driver stamp may lie from its edge under a map from edges, beyond the map's
    /// bound; nanoseconds.
    pub edge_slack_ns: i64,
    /// The same under a map from arrivals, whose constant delay is not known; nanoseconds. Images
    /// are withheld while this and the map's bound exceed a quarter of the period, so a fast camera
    /// needs its transfers' delay calibrated and this set accordingly.
    pub arrival_slack_ns: i64,
    /// How far a measured width may lie from the exposure set, nanoseconds.
    pub width_slack_ns: i64,
    /// How long after its close an exposure waits for its image, nanoseconds of the event
    /// camera's counter.
    pub image_wait_ns: i64,
    /// Closed exposures held while they wait for images.
    pub exposures_max: usize,
    /// Images held while they wait for edges or for a map.
    pub images_max: usize,
}

impl Default for TrackerConfig {
    fn default() -> Self {
        Self {
            strobe: StrobeConfig::default(),
            edge_slack_ns: 300_000,
            arrival_slack_ns: 10_000_000,
            width_slack_ns: 1_000_000,
            image_wait_ns: 2_000_000_000,
            exposures_max: 16,
            images_max: 8,
        }
    }
}

/// A closed exposure, until it is certain that no further image can be confused with it.
#[derive(Debug, Clone, Copy)]
struct Candidate {
    exposure: Exposure,
    /// `Imaged` or `ImageMissing` has been said.
    is_done: bool,
}

/// Where an image belongs.
enum Place {
    /// To the candidate at this index.
    At(usize),
    /// Undecided: its edges or its map may still come.
    Wait,
    Nowhere(LeftOutReason),
}

/// Turns strobe edges and image stamps into exposures with images.
#[derive(Debug)]
pub struct ExposureTracker {
    config: TrackerConfig,
    strobe: Strobe,
    next_id: u64,
    /// The exposure now open: announced, not closed.
    open: Option<(u64, Stamp<Evk4>)>,
    /// Oldest first; at most `config.exposures_max`.
    candidates: Vec<Candidate>,
    /// Oldest first; at most `config.images_max`.
    images: Vec<ImageStamp>,
    last_image: Option<ImageStamp>,
    watermark: Option<Stamp<Evk4>>,
    counts: ExposureCounts,
}

impl ExposureTracker {
    /// A tracker that has seen nothing. Allocates here and nothing afterwards.
    #[must_use]
    pub fn new(config: TrackerConfig) -> Self {
        let config = TrackerConfig {
            exposures_max: config.exposures_max.max(2),
            images_max: config.images_max.max(1),
            ..config
        };
        Self {
            config,
            strobe: Strobe::new(config.strobe),
            next_id: 0,
            open: None,
            candidates: Vec::with_capacity(config.exposures_max),
            images: Vec::with_capacity(config.images_max),
            last_image: None,
            watermark: None,
            counts: ExposureCounts::default(),
        }
    }

    /// What became of edges, exposures and images.
    #[must_use]
    pub fn counts(&self) -> ExposureCounts {
        self.counts
    }

    /// Takes one edge, in the order of the event camera's stream.
    pub fn edge(
        &mut self,
        edge: TriggerEdge,
        map: Option<&ImageMap>,
        emit: &mut impl FnMut(ExposureEvent),
    ) {
        let mut steps = Steps::default();
        self.strobe
            .edge(edge, &mut self.counts, &mut |s| steps.push(s));
        self.take(&steps, emit);
        self.place_images(map, emit);
    }

    /// The event camera's stream has come as far as `watermark`.
    pub fn advance(
        &mut self,
        watermark: Stamp<Evk4>,
        map: Option<&ImageMap>,
        emit: &mut impl FnMut(ExposureEvent),
    ) {
        let mut steps = Steps::default();
        self.strobe
            .advance(watermark, &mut self.counts, &mut |s| steps.push(s));
        self.take(&steps, emit);
        self.watermark = Some(watermark);
        self.place_images(map, emit);
        self.give_up_waiting(watermark, emit);
    }

    /// Takes one image, in the order of the driver's stream.
    pub fn image(
        &mut self,
        image: ImageStamp,
        map: Option<&ImageMap>,
        emit: &mut impl FnMut(ExposureEvent),
    ) {
        self.counts.images += 1;
        if let Some(last) = self.last_image {
            if image.driver <= last.driver {
                self.leave_out(image.sequence, LeftOutReason::Duplicate, emit);
                return;
            }
            // A sequence that went back is a restarted stream: nothing can be said about loss.
            let skipped = image
                .sequence
                .saturating_sub(last.sequence.saturating_add(1));
            self.counts.images_lost = self.counts.images_lost.saturating_add(skipped);
        }
        self.last_image = Some(image);
        if self.images.len() == self.config.images_max {
            let oldest = self.images.remove(0);
            let reason = if map.is_none() {
                LeftOutReason::NoMap
            } else {
                LeftOutReason::NoExposure
            };
            self.leave_out(oldest.sequence, reason, emit);
        }
        self.images.push(image);
        self.place_images(map, emit);
    }

    /// The event camera's counter was restarted or jumped: nothing in flight can be placed.
    pub fn clock_changed(&mut self, emit: &mut impl FnMut(ExposureEvent)) {
        self.strobe.forget();
        self.take_clock_change(emit);
    }

    /// The input has ended: says the last word about everything in flight.
    pub fn finish(&mut self, map: Option<&ImageMap>, emit: &mut impl FnMut(ExposureEvent)) {
        self.advance(Stamp::MAX, map, emit);
        while !self.images.is_empty() {
            let image = self.images.remove(0);
            let reason = if map.is_none() {
                LeftOutReason::NoMap
            } else {
                LeftOutReason::NoExposure
            };
            self.leave_out(image.sequence, reason, emit);
        }
        if let Some((id, _)) = self.open.take() {
            self.discard(id, DiscardReason::NeverClosed, emit);
        }
        self.strobe.forget();
    }

    fn take(&mut self, steps: &Steps, emit: &mut impl FnMut(ExposureEvent)) {
        for &shutter in steps.iter() {
            match shutter {
                Shutter::Opened {
                    open,
                    close_predicted,
                    flags,
                } => {
                    let id = self.next_id;
                    self.next_id += 1;
                    self.open = Some((id, open));
                    self.counts.opened += 1;
                    emit(ExposureEvent::Opened {
                        id,
                        open,
                        close_predicted,
                        flags,
                    });
                }
                Shutter::Closed { open, close, flags } => {
                    if let Some((id, _)) = self.open.take() {
                        let exposure = Exposure {
                            id,
                            open,
                            close,
                            image: None,
                            flags,
                        };
                        self.close(exposure, emit);
                    }
                }
                Shutter::Discarded(reason) => {
                    if let Some((id, _)) = self.open.take() {
                        self.discard(id, reason, emit);
                    }
                }
                Shutter::ClockChanged => self.take_clock_change(emit),
            }
        }
    }

    fn close(&mut self, exposure: Exposure, emit: &mut impl FnMut(ExposureEvent)) {
        if self.candidates.len() == self.config.exposures_max {
            self.miss(0, ExposureFlags::NONE, emit);
            self.candidates.remove(0);
        }
        self.candidates.push(Candidate {
            exposure,
            is_done: false,
        });
        self.counts.closed += 1;
        emit(ExposureEvent::Closed(exposure));
    }

    fn discard(&mut self, id: u64, reason: DiscardReason, emit: &mut impl FnMut(ExposureEvent)) {
        self.counts.discarded += 1;
        emit(ExposureEvent::Discarded { id, reason });
    }

    /// Says that the candidate will have no image, unless its last word was said.
    fn miss(&mut self, index: usize, flags: ExposureFlags, emit: &mut impl FnMut(ExposureEvent)) {
        let candidate = &mut self.candidates[index];
        if candidate.is_done {
            return;
        }
        candidate.is_done = true;
        candidate.exposure.flags |= ExposureFlags::IMAGE_MISSING | flags;
        self.counts.images_missing += 1;
        emit(ExposureEvent::ImageMissing(candidate.exposure));
    }

    fn leave_out(
        &mut self,
        sequence: u64,
        reason: LeftOutReason,
        emit: &mut impl FnMut(ExposureEvent),
    ) {
        let count = match reason {
            LeftOutReason::NoExposure => &mut self.counts.left_out_no_exposure,
            LeftOutReason::Ambiguous => &mut self.counts.left_out_ambiguous,
            LeftOutReason::WidthMismatch => &mut self.counts.left_out_width,
            LeftOutReason::Duplicate => &mut self.counts.left_out_duplicate,
            LeftOutReason::NoMap => &mut self.counts.left_out_no_map,
            LeftOutReason::ClockChanged => &mut self.counts.left_out_clock,
        };
        *count += 1;
        emit(ExposureEvent::ImageLeftOut { sequence, reason });
    }

    fn take_clock_change(&mut self, emit: &mut impl FnMut(ExposureEvent)) {
        self.counts.clock_changes += 1;
        if let Some((id, _)) = self.open.take() {
            self.discard(id, DiscardReason::ClockChanged, emit);
        }
        for index in 0..self.candidates.len() {
            self.miss(index, ExposureFlags::CLOCK_CHANGED, emit);
        }
        self.candidates.clear();
        while !self.images.is_empty() {
            let image = self.images.remove(0);
            self.leave_out(image.sequence, LeftOutReason::ClockChanged, emit);
        }
        self.watermark = None;
    }

    /// Places every image that can be placed; the others go on waiting.
    fn place_images(&mut self, map: Option<&ImageMap>, emit: &mut impl FnMut(ExposureEvent)) {
        let Some(map) = map else {
            return;
        };
        let mut index = 0;
        while index < self.images.len() {
            let image = self.images[index];
            match self.place(&image, map) {
                Place::Wait => {
                    index += 1;
                    continue;
                }
                Place::At(candidate) => self.attach(candidate, &image, emit),
                Place::Nowhere(reason) => self.leave_out(image.sequence, reason, emit),
            }
            self.images.remove(index);
        }
        self.give_up_passed(map, emit);
    }

    /// Distance of an image's stamp from where it would lie had it been taken with an exposure.
    fn distance_ns(
        image: &ImageStamp,
        map: &ImageMap,
        open: Stamp<Evk4>,
        close: Stamp<Evk4>,
    ) -> i64 {
        let edge = match image.stamped_at {
            StampedAt::Start => open,
            StampedAt::End => close,
        };
        image.driver.diff_nanos(map.0.apply(edge))
    }

    /// How far a stamp may lie from its edge under this map.
    fn slack_ns(&self, map: &ImageMap, at: Stamp<Evk4>) -> i64 {
        let slack = match map.1 {
            MapSource::Edges => self.config.edge_slack_ns,
            MapSource::Arrivals | MapSource::Offset => self.config.arrival_slack_ns,
        };
        let bound = i64::try_from(map.0.uncertainty_at(at)).unwrap_or(i64::MAX);
        slack.saturating_add(bound)
    }

    fn place(&self, image: &ImageStamp, map: &ImageMap) -> Place {
        let mut best: Option<(usize, i64)> = None;
        let mut second = i64::MAX;
        for (index, candidate) in self.candidates.iter().enumerate() {
            let Exposure { open, close, .. } = candidate.exposure;
            let distance = Self::distance_ns(image, map, open, close).saturating_abs();
            match best {
                Some((_, nearest)) if nearest <= distance => second = second.min(distance),
                _ => {
                    second = best.map_or(second, |(_, nearest)| second.min(nearest));
                    best = Some((index, distance));
                }
            }
        }
        let at = best.map_or(self.watermark.unwrap_or(Stamp::ZERO), |(index, _)| {
            self.candidates[index].exposure.close
        });
        let slack = self.slack_ns(map, at);
        // Exposures do not overlap: without a period, the width bounds the distance of neighbours.
        let width = best.map(|(index, _)| self.candidates[index].exposure.width_ns());
        if self
            .strobe
            .period_ns()
            .or(width)
            .is_some_and(|spacing| slack > spacing / 4)
        {
            return Place::Wait; // The map cannot tell neighbours apart; a better one may come.
        }
        match best {
            Some((index, distance)) if distance <= slack => {
                self.judge(index, second, slack, image, map)
            }
            _ if self.edges_have_passed(image, map, slack) => {
                Place::Nowhere(LeftOutReason::NoExposure)
            }
            _ => Place::Wait,
        }
    }

    /// Whether an image that lies at a candidate really belongs to it.
    fn judge(
        &self,
        index: usize,
        second: i64,
        slack: i64,
        image: &ImageStamp,
        map: &ImageMap,
    ) -> Place {
        let candidate = &self.candidates[index];
        let Exposure { flags, .. } = candidate.exposure;
        let opening = self.open.map(|(_, open)| {
            let close = open.offset_nanos(candidate.exposure.width_ns());
            Self::distance_ns(image, map, open, close).saturating_abs()
        });
        let second = second.min(opening.unwrap_or(i64::MAX));
        if second <= slack.saturating_mul(2) {
            return Place::Nowhere(LeftOutReason::Ambiguous);
        }
        if candidate.is_done {
            return Place::Nowhere(LeftOutReason::Duplicate);
        }
        let measured =
            !flags.intersects(ExposureFlags::OPEN_REPAIRED | ExposureFlags::CLOSE_REPAIRED);
        let off = image
            .exposure_ns
            .map_or(0, |n| n.saturating_sub(candidate.exposure.width_ns()));
        if measured && off.saturating_abs() > self.config.width_slack_ns {
            return Place::Nowhere(LeftOutReason::WidthMismatch);
        }
        Place::At(index)
    }

    /// Whether every edge this image could belong to has been delivered.
    fn edges_have_passed(&self, image: &ImageStamp, map: &ImageMap, slack: i64) -> bool {
        let Some(watermark) = self.watermark else {
            return false;
        };
        // An opening edge at the stamp becomes a candidate only when it closes.
        let until_close = match image.stamped_at {
            StampedAt::Start => self.config.strobe.width_ns_max,
            StampedAt::End => 0,
        };
        let passed = map.0.apply(watermark).diff_nanos(image.driver);
        passed > slack.saturating_add(until_close)
    }

    fn attach(&mut self, index: usize, image: &ImageStamp, emit: &mut impl FnMut(ExposureEvent)) {
        let candidate = &mut self.candidates[index];
        let exposure = &mut candidate.exposure;
        exposure.image = Some(image.sequence);
        candidate.is_done = true;
        let repaired = match image.stamped_at {
            StampedAt::Start => ExposureFlags::OPEN_REPAIRED,
            StampedAt::End => ExposureFlags::CLOSE_REPAIRED,
        };
        let edge = match image.stamped_at {
            StampedAt::Start => exposure.open,
            StampedAt::End => exposure.close,
        };
        let is_measured = !exposure.flags.intersects(repaired | ExposureFlags::VIRTUAL);
        let pair = is_measured.then_some(StrobePair {
            edge,
            driver: image.driver,
        });
        if let Some(nominal) = image.exposure_ns {
            if exposure.flags.contains(ExposureFlags::CLOSE_REPAIRED) {
                exposure.close = exposure.open.offset_nanos(nominal);
                exposure.flags |= ExposureFlags::WIDTH_NOMINAL;
            } else if exposure.flags.contains(ExposureFlags::OPEN_REPAIRED) {
                exposure.open = exposure.close.offset_nanos(nominal.saturating_neg());
                exposure.flags |= ExposureFlags::WIDTH_NOMINAL;
            }
        }
        let exposure = *exposure;
        self.counts.images_matched += 1;
        emit(ExposureEvent::Imaged { exposure, pair });
    }

    /// Images come in order: once one lies clearly behind an exposure, that exposure's own image
    /// is lost, unless it is among those still waiting.
    fn give_up_passed(&mut self, map: &ImageMap, emit: &mut impl FnMut(ExposureEvent)) {
        let Some(last) = self.last_image else {
            return;
        };
        for index in 0..self.candidates.len() {
            let Exposure { open, close, .. } = self.candidates[index].exposure;
            let slack = self.slack_ns(map, close);
            let may_be = |image: &ImageStamp| {
                Self::distance_ns(image, map, open, close).saturating_abs() <= slack
            };
            let passed = Self::distance_ns(&last, map, open, close) > slack;
            if passed && !self.images.iter().any(may_be) {
                self.miss(index, ExposureFlags::NONE, emit);
            }
        }
    }

    /// Gives up exposures that have waited for long enough.
    fn give_up_waiting(&mut self, watermark: Stamp<Evk4>, emit: &mut impl FnMut(ExposureEvent)) {
        for index in 0..self.candidates.len() {
            let close = self.candidates[index].exposure.close;
            if watermark.diff_nanos(close) > self.config.image_wait_ns {
                self.miss(index, ExposureFlags::NONE, emit);
            }
        }
    }
}

/// What one edge can amount to: at most a clock change, an end, a beginning and another end.
#[derive(Debug, Default)]
struct Steps {
    steps: [Option<Shutter>; 6],
    len: usize,
}

impl Steps {
    fn push(&mut self, shutter: Shutter) {
        // INVARIANT: one edge causes at most four steps.
        self.steps[self.len] = Some(shutter);
        self.len += 1;
    }

    fn iter(&self) -> impl Iterator<Item = &Shutter> {
        self.steps.iter().flatten()
    }
}

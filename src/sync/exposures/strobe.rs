//! Strobe edges to exposures: polarity, delays, bounces, and edges that are missing, doubled or
//! inverted. Knows nothing of images.
//!
//! Edges are judged by width and spacing: the median of recent widths, and the camera's period
//! where it keeps one. An edge that contradicts the present state is taken as the repair that puts
//! it in step, or for a stray; never by its place in a count.

use noctule_sensor::{Evk4, Stamp, TriggerEdge};

use super::exposure::{DiscardReason, ExposureCounts, ExposureFlags};
use super::rhythm::Rhythm;

/// Settings of the strobe line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StrobeConfig {
    /// Trigger input the strobe is wired to; `None` takes edges of any input.
    pub channel: Option<u8>,
    /// The shutter opens with a falling edge (an opto-isolated output inverts).
    pub is_inverted: bool,
    /// Delay of the opening edge behind the shutter, nanoseconds.
    pub open_delay_ns: i64,
    /// Delay of the closing edge behind the shutter, nanoseconds.
    pub close_delay_ns: i64,
    /// Two edges closer than this are one, nanoseconds.
    pub bounce_ns: i64,
    /// Shortest exposure, nanoseconds.
    pub width_ns_min: i64,
    /// Longest exposure, nanoseconds; an exposure open for longer is closed by force.
    pub width_ns_max: i64,
    /// Distance from its expected place within which an edge is in step, nanoseconds.
    pub step_tolerance_ns: i64,
}

impl Default for StrobeConfig {
    fn default() -> Self {
        Self {
            channel: None,
            is_inverted: false,
            open_delay_ns: 0,
            close_delay_ns: 0,
            bounce_ns: 50_000,
            width_ns_min: 500_000,
            width_ns_max: 1_000_000_000,
            step_tolerance_ns: 2_000_000,
        }
    }
}

/// What an edge turned out to mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Shutter {
    Opened {
        open: Stamp<Evk4>,
        close_predicted: Option<Stamp<Evk4>>,
        flags: ExposureFlags,
    },
    Closed {
        open: Stamp<Evk4>,
        close: Stamp<Evk4>,
        flags: ExposureFlags,
    },
    Discarded(DiscardReason),
    ClockChanged,
}

/// State machine of the strobe line.
#[derive(Debug)]
pub(super) struct Strobe {
    config: StrobeConfig,
    rhythm: Rhythm,
    current: Option<(Stamp<Evk4>, ExposureFlags)>,
    /// Newest edge accepted, and whether it opened.
    last_edge: Option<(Stamp<Evk4>, bool)>,
    last_close: Option<Stamp<Evk4>>,
}

impl Strobe {
    pub fn new(config: StrobeConfig) -> Self {
        Self {
            config,
            rhythm: Rhythm::default(),
            current: None,
            last_edge: None,
            last_close: None,
        }
    }

    pub fn period_ns(&self) -> Option<i64> {
        self.rhythm.period_ns()
    }

    /// Forgets everything: the counter is no longer the one that stamped it.
    pub fn forget(&mut self) {
        *self = Self::new(self.config);
    }

    /// Takes one edge.
    pub fn edge(
        &mut self,
        edge: TriggerEdge,
        counts: &mut ExposureCounts,
        emit: &mut impl FnMut(Shutter),
    ) {
        if self.config.channel.is_some_and(|c| c != edge.channel) {
            counts.edges_elsewhere += 1;
            return;
        }
        counts.edges += 1;
        let opens = edge.rising != self.config.is_inverted;
        let delay = if opens {
            self.config.open_delay_ns
        } else {
            self.config.close_delay_ns
        };
        let t = edge.t.offset_nanos(delay.saturating_neg());
        if let Some((last, _)) = self.last_edge {
            let since = t.diff_nanos(last);
            if since < -self.config.bounce_ns {
                emit(Shutter::ClockChanged);
                self.forget();
            } else if since < self.config.bounce_ns {
                counts.edges_doubled += 1;
                return;
            }
        }
        match (self.current, opens) {
            (None, true) => self.open(t, ExposureFlags::NONE, emit),
            (None, false) => self.lone_close(t, counts, emit),
            (Some((open, flags)), true) => self.open_again(open, flags, t, counts, emit),
            (Some((open, flags)), false) => self.close(open, flags, t, counts, emit),
        }
    }

    /// Closes by force an exposure that has been open for too long.
    pub fn advance(
        &mut self,
        watermark: Stamp<Evk4>,
        counts: &mut ExposureCounts,
        emit: &mut impl FnMut(Shutter),
    ) {
        let Some((open, flags)) = self.current else {
            return;
        };
        if watermark.diff_nanos(open) > self.config.width_ns_max {
            self.close_by_width(open, flags, counts, emit);
        }
    }

    fn open(&mut self, open: Stamp<Evk4>, flags: ExposureFlags, emit: &mut impl FnMut(Shutter)) {
        let close_predicted = self.rhythm.last_width_ns().map(|w| open.offset_nanos(w));
        emit(Shutter::Opened {
            open,
            close_predicted,
            flags,
        });
        self.current = Some((open, flags));
        self.last_edge = Some((open, true));
    }

    /// The whole of an exposure is known.
    fn finish(
        &mut self,
        open: Stamp<Evk4>,
        close: Stamp<Evk4>,
        flags: ExposureFlags,
        emit: &mut impl FnMut(Shutter),
    ) {
        let repaired = ExposureFlags::OPEN_REPAIRED | ExposureFlags::CLOSE_REPAIRED;
        if !flags.intersects(repaired) {
            self.rhythm.width(close.diff_nanos(open));
        }
        if !flags.contains(ExposureFlags::OPEN_REPAIRED) {
            self.rhythm.open(open);
        }
        emit(Shutter::Closed { open, close, flags });
        self.current = None;
        self.last_close = Some(close);
    }

    /// The closing edge is missing: puts it back, or gives the exposure up.
    fn close_by_width(
        &mut self,
        open: Stamp<Evk4>,
        flags: ExposureFlags,
        counts: &mut ExposureCounts,
        emit: &mut impl FnMut(Shutter),
    ) {
        self.current = None;
        match self.rhythm.width_ns() {
            Some(width) => {
                counts.edges_repaired += 1;
                let flags = flags | ExposureFlags::CLOSE_REPAIRED;
                self.finish(open, open.offset_nanos(width), flags, emit);
            }
            None => emit(Shutter::Discarded(DiscardReason::NeverClosed)),
        }
    }

    /// A closing edge with nothing open: its opening edge is missing, or it is the opening edge
    /// with the wrong polarity, or it is a stray. Only a kept rhythm can tell.
    fn lone_close(
        &mut self,
        t: Stamp<Evk4>,
        counts: &mut ExposureCounts,
        emit: &mut impl FnMut(Shutter),
    ) {
        let tolerance = self.config.step_tolerance_ns;
        let in_step = |at: Stamp<Evk4>| self.rhythm.is_in_step(at, tolerance);
        let repaired = self.rhythm.width_ns().map(|w| t.offset_nanos(-w));
        let free = |at: Stamp<Evk4>| self.last_close.is_none_or(|close| at > close);
        match repaired.filter(|&open| free(open) && in_step(open)) {
            Some(open) => {
                counts.edges_repaired += 1;
                self.open(open, ExposureFlags::OPEN_REPAIRED, emit);
                self.finish(open, t, ExposureFlags::OPEN_REPAIRED, emit);
                self.last_edge = Some((t, false));
            }
            None if in_step(t) => {
                counts.edges_inverted += 1;
                self.open(t, ExposureFlags::EDGE_INVERTED, emit);
            }
            None => counts.edges_stray += 1,
        }
    }

    /// An opening edge while open: the closing edge between is missing or came inverted, or one
    /// of the two opening edges is noise.
    fn open_again(
        &mut self,
        open: Stamp<Evk4>,
        flags: ExposureFlags,
        t: Stamp<Evk4>,
        counts: &mut ExposureCounts,
        emit: &mut impl FnMut(Shutter),
    ) {
        let tolerance = self.config.step_tolerance_ns;
        let since = t.diff_nanos(open);
        let in_step = |at: Stamp<Evk4>| self.rhythm.is_in_step(at, tolerance);
        let width = self.rhythm.width_ns();
        let is_width = width.is_some_and(|w| (since - w).abs() <= tolerance);
        if is_width && !in_step(t) {
            counts.edges_inverted += 1;
            self.finish(open, t, flags | ExposureFlags::EDGE_INVERTED, emit);
            self.last_edge = Some((t, false));
        } else if width.is_some_and(|w| since <= w + tolerance) {
            if in_step(t) && !in_step(open) {
                emit(Shutter::Discarded(DiscardReason::OutOfStep));
                self.open(t, ExposureFlags::NONE, emit);
            } else {
                counts.edges_stray += 1;
            }
        } else {
            self.close_by_width(open, flags, counts, emit);
            self.open(t, ExposureFlags::NONE, emit);
        }
    }

    /// A closing edge while open: the regular end, a glitch, or the end of a later exposure.
    fn close(
        &mut self,
        open: Stamp<Evk4>,
        flags: ExposureFlags,
        t: Stamp<Evk4>,
        counts: &mut ExposureCounts,
        emit: &mut impl FnMut(Shutter),
    ) {
        let width = t.diff_nanos(open);
        self.last_edge = Some((t, false));
        if width < self.config.width_ns_min {
            self.current = None;
            counts.edges_stray += 2;
            emit(Shutter::Discarded(DiscardReason::Glitch));
            return;
        }
        let period = self.rhythm.period_ns();
        let fits = width <= self.config.width_ns_max && period.is_none_or(|p| width < p);
        if fits {
            self.finish(open, t, flags, emit);
            return;
        }
        // Two edges are missing between these two, if the rhythm agrees.
        self.close_by_width(open, flags, counts, emit);
        self.lone_close(t, counts, emit);
    }
}

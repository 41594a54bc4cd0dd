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

#[cfg(test)]
#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "times here are positive and small"
)]
mod tests {
    use super::*;

    /// Edges as (milliseconds, rising).
    fn run(config: StrobeConfig, edges: &[(f64, bool)]) -> (Vec<Shutter>, ExposureCounts) {
        let mut strobe = Strobe::new(config);
        let mut counts = ExposureCounts::default();
        let mut out = Vec::new();
        for &(ms, rising) in edges {
            let t = Stamp::from_nanos((ms * 1e6) as u64);
            let edge = TriggerEdge {
                t,
                channel: 0,
                rising,
            };
            strobe.edge(edge, &mut counts, &mut |s| out.push(s));
        }
        (out, counts)
    }

    /// Regular exposures of 80 ms every 200 ms.
    fn regular(count: u32) -> Vec<(f64, bool)> {
        let open = |i: u32| 1000.0 + f64::from(i) * 200.0;
        (0..count)
            .flat_map(|i| [(open(i), true), (open(i) + 80.0, false)])
            .collect()
    }

    /// Closed intervals in milliseconds, with their flags.
    fn closed(out: &[Shutter]) -> Vec<(u64, u64, ExposureFlags)> {
        out.iter()
            .filter_map(|s| match *s {
                Shutter::Closed { open, close, flags } => {
                    Some((open.as_micros() / 1000, close.as_micros() / 1000, flags))
                }
                _ => None,
            })
            .collect()
    }

    #[test]
    fn regular_edges_open_and_close_with_a_prediction() {
        let (out, counts) = run(StrobeConfig::default(), &regular(3));
        let expected = [1000, 1200, 1400].map(|o| (o, o + 80, ExposureFlags::NONE));
        assert_eq!(closed(&out), expected);
        assert_eq!(
            counts,
            ExposureCounts {
                edges: 6,
                ..ExposureCounts::default()
            }
        );
        let Shutter::Opened {
            close_predicted, ..
        } = out[2]
        else {
            panic!("{out:?}")
        };
        assert_eq!(close_predicted, Some(Stamp::from_micros(1_280_000)));
    }

    #[test]
    fn polarity_and_delays_are_taken_off() {
        let config = StrobeConfig {
            is_inverted: true,
            open_delay_ns: 5_000,
            close_delay_ns: 30_000,
            ..StrobeConfig::default()
        };
        let (out, _) = run(config, &[(10.0, false), (90.0, true)]);
        let Shutter::Closed { open, close, .. } = out[1] else {
            panic!("{out:?}")
        };
        assert_eq!((open.as_micros(), close.as_micros()), (9_995, 89_970));
    }

    #[test]
    fn each_missing_edge_is_put_back_where_the_rhythm_says() {
        for (missing, flags) in [
            (10, ExposureFlags::OPEN_REPAIRED),
            (11, ExposureFlags::CLOSE_REPAIRED),
        ] {
            let mut edges = regular(8);
            edges.remove(missing);
            let (out, counts) = run(StrobeConfig::default(), &edges);
            let closed = closed(&out);
            assert_eq!(closed.len(), 8);
            assert_eq!(closed[5], (2000, 2080, flags));
            assert_eq!(counts.edges_repaired, 1);
        }
    }

    #[test]
    fn a_close_and_the_next_opening_missing_are_both_put_back() {
        let mut edges = regular(8);
        edges.drain(11..13);
        let (out, counts) = run(StrobeConfig::default(), &edges);
        let closed = closed(&out);
        assert_eq!(closed[5], (2000, 2080, ExposureFlags::CLOSE_REPAIRED));
        assert_eq!(closed[6], (2200, 2280, ExposureFlags::OPEN_REPAIRED));
        assert_eq!((closed.len(), counts.edges_repaired), (8, 2));
    }

    #[test]
    fn inverted_edges_are_known_by_their_place() {
        for wrong in [10, 11] {
            let mut edges = regular(8);
            edges[wrong].1 ^= true;
            let (out, counts) = run(StrobeConfig::default(), &edges);
            let closed = closed(&out);
            assert_eq!(
                closed[5],
                (2000, 2080, ExposureFlags::EDGE_INVERTED),
                "edge {wrong}"
            );
            assert_eq!((closed.len(), counts.edges_inverted), (8, 1));
        }
    }

    #[test]
    fn doubled_edges_and_glitches_change_nothing() {
        let mut edges = regular(6);
        edges.insert(5, (1400.02, true)); // a bounce
        edges.insert(7, (1481.0, false)); // reported again a millisecond later
        edges.insert(8, (1550.0, true)); // 0.1 ms of noise between exposures
        edges.insert(9, (1550.1, false));
        let (out, counts) = run(StrobeConfig::default(), &edges);
        assert_eq!(closed(&out).len(), 6);
        assert!(closed(&out).iter().all(|c| c.1 - c.0 == 80));
        assert_eq!((counts.edges_doubled, counts.edges_stray), (1, 3));
        assert!(out.contains(&Shutter::Discarded(DiscardReason::Glitch)));
    }

    #[test]
    fn a_counter_that_goes_back_is_a_new_clock() {
        let mut edges = regular(5);
        edges.extend([(3.0, true), (83.0, false)]);
        let (out, _) = run(StrobeConfig::default(), &edges);
        assert!(out.contains(&Shutter::ClockChanged));
        assert_eq!(closed(&out).last(), Some(&(3, 83, ExposureFlags::NONE)));
    }

    #[test]
    fn an_exposure_that_never_ends_is_ended_by_force() {
        let config = StrobeConfig {
            width_ns_max: 150_000_000,
            ..StrobeConfig::default()
        };
        let mut strobe = Strobe::new(config);
        let mut counts = ExposureCounts::default();
        let mut out = Vec::new();
        let edge = TriggerEdge {
            t: Stamp::from_micros(1_000_000),
            channel: 0,
            rising: true,
        };
        strobe.edge(edge, &mut counts, &mut |s| out.push(s));
        strobe.advance(Stamp::from_micros(1_150_000), &mut counts, &mut |s| {
            out.push(s)
        });
        assert_eq!(out.len(), 1);
        strobe.advance(Stamp::from_micros(1_150_001), &mut counts, &mut |s| {
            out.push(s)
        });
        assert_eq!(out[1], Shutter::Discarded(DiscardReason::NeverClosed));
    }
}

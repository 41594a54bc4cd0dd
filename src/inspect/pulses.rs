//! Exposures as the strobe's edges show them: how many, how long, and which edges found no partner.
//!
//! Counts what is on the wire. Matching pulses to images, and repairing missed or doubled edges,
//! is what synchronisation does.

use noctule_recording::{EdgeTruth, ExposureTruth, StrobeMeta, StrobePolarity};
use noctule_sensor::TriggerEdge;
use serde::Serialize;

/// Exposures of a recording.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct ExposureReport {
    /// Trigger input of the strobe; null when none is connected.
    pub strobe_channel: Option<u8>,
    /// Opening edges followed by a closing edge.
    pub pulses: u64,
    /// Edges without a partner: doubled, or the other one missed.
    pub unpaired_edges: u64,
    /// Shortest pulse, microseconds.
    pub width_us_min: Option<u64>,
    /// Longest pulse, microseconds.
    pub width_us_max: Option<u64>,
    /// Sum of all pulses' widths, microseconds.
    pub width_us_sum: u64,
    /// First opening edge of a pulse, microseconds of the event camera's clock.
    pub first_us: Option<u64>,
    /// Last closing edge of a pulse, microseconds of the event camera's clock.
    pub last_us: Option<u64>,
    /// What a synthetic recording knows better; null where there is no truth.
    pub truth: Option<TruthReport>,
}

/// True exposures of a synthetic recording.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct TruthReport {
    /// Exposures.
    pub exposures: u64,
    /// Images that never reached the host.
    pub images_dropped: u64,
    /// Edges that were not reported.
    pub edges_missed: u64,
    /// Edges that were reported twice.
    pub edges_doubled: u64,
}

impl TruthReport {
    pub(super) fn add(&mut self, truth: &ExposureTruth) {
        self.exposures += 1;
        self.images_dropped += u64::from(truth.image_dropped);
        for edge in [truth.open_edge, truth.close_edge] {
            self.edges_missed += u64::from(edge == EdgeTruth::Missed);
            self.edges_doubled += u64::from(edge == EdgeTruth::Doubled);
        }
    }
}

/// Pairs the edges of one strobe.
#[derive(Debug)]
pub(super) struct Pulses {
    channel: u8,
    rising_opens: bool,
    open_us: Option<u64>,
    report: ExposureReport,
}

impl Pulses {
    pub(super) fn new(strobe: &StrobeMeta) -> Self {
        Self {
            channel: strobe.channel,
            rising_opens: strobe.polarity == StrobePolarity::ActiveHigh,
            open_us: None,
            report: ExposureReport {
                strobe_channel: Some(strobe.channel),
                ..ExposureReport::default()
            },
        }
    }

    /// Takes the next edge of any channel.
    pub(super) fn edge(&mut self, edge: TriggerEdge) {
        if edge.channel != self.channel {
            return;
        }
        let now_us = edge.t.as_micros();
        if edge.rising == self.rising_opens {
            let before = self.open_us.replace(now_us);
            self.report.unpaired_edges += u64::from(before.is_some());
            return;
        }
        // A counter that was reset in between makes no pulse.
        let pulse = self.open_us.take();
        let Some((from, width)) = pulse.and_then(|from| Some((from, now_us.checked_sub(from)?)))
        else {
            self.report.unpaired_edges += 1 + u64::from(pulse.is_some());
            return;
        };
        let report = &mut self.report;
        report.pulses += 1;
        report.width_us_min = Some(report.width_us_min.map_or(width, |min| min.min(width)));
        report.width_us_max = report.width_us_max.max(Some(width));
        report.width_us_sum += width;
        report.first_us.get_or_insert(from);
        report.last_us = Some(now_us);
    }

    /// What was seen; an exposure still open counts as an edge without a partner.
    pub(super) fn report(&self) -> ExposureReport {
        let mut report = self.report;
        report.unpaired_edges += u64::from(self.open_us.is_some());
        report
    }
}

#[cfg(test)]
mod tests {
    use noctule_sensor::Stamp;

    use super::*;

    fn pulses(polarity: StrobePolarity, edges: &[(u64, bool)]) -> ExposureReport {
        let mut pulses = Pulses::new(&StrobeMeta {
            channel: 2,
            polarity,
            open_delay_ns: 0,
            close_delay_ns: 0,
        });
        for &(us, rising) in edges {
            let t = Stamp::from_micros(us);
            pulses.edge(TriggerEdge {
                t,
                channel: 2,
                rising,
            });
            pulses.edge(TriggerEdge {
                t,
                channel: 0,
                rising: !rising,
            });
        }
        pulses.report()
    }

    #[test]
    fn pulses_are_paired_and_strays_are_counted() {
        let edges = [
            (10, false), // closes nothing
            (100, true),
            (160, false),
            (200, true),
            (205, true), // doubled: the later one counts
            (300, false),
            (310, false), // doubled
            (400, true),  // never closed
        ];
        let report = pulses(StrobePolarity::ActiveHigh, &edges);
        assert_eq!((report.pulses, report.unpaired_edges), (2, 4));
        assert_eq!(
            (report.width_us_min, report.width_us_max),
            (Some(60), Some(95))
        );
        assert_eq!(
            (report.first_us, report.last_us, report.width_us_sum),
            (Some(100), Some(300), 155)
        );
    }

    #[test]
    fn an_inverted_strobe_opens_on_the_falling_edge() {
        let report = pulses(
            StrobePolarity::ActiveLow,
            &[(5, false), (25, true), (40, false)],
        );
        assert_eq!(
            (report.pulses, report.width_us_sum, report.unpaired_edges),
            (1, 20, 1)
        );
    }

    #[test]
    fn a_counter_that_steps_back_makes_no_pulse() {
        let report = pulses(StrobePolarity::ActiveHigh, &[(500, true), (20, false)]);
        assert_eq!((report.pulses, report.unpaired_edges), (0, 2));
    }
}

//! Bundles that are decided on: completed, described and sent.

use super::Assembler;
use crate::bus::BusError;
use crate::frame::{BundleHeader, HostStages, Lost, flag};
use crate::host::bay::Berth;
use crate::host::outlet::Outlet;
use crate::sync::{BundleDecision, ExposureFlags, Stream};

impl<O: Outlet> Assembler<O> {
    /// Sends what was decided.
    pub(super) fn decide(&mut self) -> Result<(), BusError> {
        while !self.decided.is_empty() {
            let decision = self.decided.remove(0);
            let decided_ns = self.outlet.now_ns();
            let Some(mut berth) = self.bay.take(decision.exposure.id) else {
                continue;
            };
            let was_open = self.rastering == Some(berth.id);
            self.rastering = self.rastering.filter(|_| !was_open);
            self.complete(&mut berth, &decision, was_open);
            self.send(berth, &decision, decided_ns)?;
        }
        Ok(())
    }

    pub(super) fn send(
        &mut self,
        berth: Berth<O::Slot>,
        decision: &BundleDecision,
        decided_ns: u64,
    ) -> Result<(), BusError> {
        let header = self.header_of(&berth, decision, decided_ns);
        let sent = self.outlet.send(berth.slot, header)?;
        self.bundles.sent += 1;
        let stages = sent.stages;
        self.latency
            .close_to_decided
            .record(stages.close_received_ns, stages.decided_ns);
        self.latency
            .close_to_sent
            .record(stages.close_received_ns, stages.sent_ns);
        self.latency
            .decided_to_sent
            .record(stages.decided_ns, stages.sent_ns);
        self.latency
            .inputs_to_sent
            .record(stages.inputs_received_ns, stages.sent_ns);
        Ok(())
    }

    pub(super) fn header_of(
        &self,
        berth: &Berth<O::Slot>,
        decision: &BundleDecision,
        decided_ns: u64,
    ) -> BundleHeader {
        let lost =
            |stream: Stream| u32::try_from(decision.lost[stream.index()]).unwrap_or(u32::MAX);
        let flags = self.flags_of(berth, decision);
        let mut header = BundleHeader {
            sequence: decision.sequence,
            events: berth.events,
            events_outside: berth.events_outside,
            flags,
            image_sequence: berth.image.unwrap_or(0),
            returns: berth.returns,
            lost: Lost {
                events: lost(Stream::Events),
                lidar: lost(Stream::Lidar),
                images: lost(Stream::Images),
                motion: lost(Stream::Motion),
            },
            stages: HostStages {
                close_received_ns: berth.close_received_ns,
                inputs_received_ns: berth.inputs_received_ns,
                decided_ns,
                sent_ns: 0,
            },
            ..self.header
        };
        if let Some(times) = berth.times {
            header.open_tai_ns = times.open.as_nanos();
            header.close_tai_ns = times.close.as_nanos();
            header.uncertainty_ns = times.uncertainty_ns;
            for (out, centre) in header.step_tai_ns.iter_mut().zip(times.centres) {
                *out = centre.as_nanos();
            }
        }
        header
    }

    pub(super) fn flags_of(&self, berth: &Berth<O::Slot>, decision: &BundleDecision) -> u32 {
        let of = decision.exposure.flags;
        let repaired = ExposureFlags::OPEN_REPAIRED
            | ExposureFlags::CLOSE_REPAIRED
            | ExposureFlags::EDGE_INVERTED;
        let epoch = of.intersects(ExposureFlags::CLOCK_CHANGED) || !decision.restarted.is_empty();
        let unsettled =
            berth.times.is_none_or(|t| !t.is_settled) || self.timeline.is_evk4_suspect();
        [
            (decision.is_partial(), flag::PARTIAL),
            (berth.image.is_none(), flag::NO_IMAGE),
            (self.voxels.is_none(), flag::NO_EVENTS),
            (!berth.has_pass, flag::NO_LIDAR),
            (!berth.has_motion, flag::NO_MOTION),
            (of.intersects(ExposureFlags::VIRTUAL), flag::VIRTUAL),
            (of.intersects(repaired), flag::EDGE_REPAIRED),
            (epoch, flag::EPOCH_CHANGED),
            (berth.events_forgotten > 0, flag::EVENTS_TRUNCATED),
            (unsettled, flag::CLOCK_UNSETTLED),
        ]
        .into_iter()
        .filter(|(set, _)| *set)
        .fold(0, |flags, (_, bit)| flags | bit)
    }
}

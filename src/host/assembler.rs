//! From blocks to bundles: keeps the clocks, follows the exposures, writes the rasters.
//!
//! Reads no clock: instants come with the blocks, and the outlet stamps what it sends.

use noctule_camera::StampedAt as CameraStampedAt;
use noctule_raster::{
    EgoPolicy, EventHistory, Exposure as RasterExposure, Grid, ImagePlanes, ImageView, Retimed,
    Samples, SparseRaster, VoxelRaster,
};
use noctule_sensor::{Evk4, Realtime, Stamp, Tai};

use super::bay::{Bay, Berth, Times};
use super::blocks::{EventBlock, ImageBlock, MotionBlock, ReturnBlock};
use super::outlet::{Outlet, Slot};
use super::report::{BundleReport, RasterReport};
use super::rig::{ExposureSource, Rig, RigError};
use crate::bus::BusError;
use crate::frame::{BundleHeader, BundleLayout, HostStages, Lost, STEPS_MAX, flag};
use crate::latency::Latency;
use crate::sync::{
    BundleCloser, BundleDecision, ExposureEvent, ExposureFlags, ExposureTracker, ImageStamp,
    MapSource, Observation, PeriodicExposures, StampedAt, Stream, Timeline, VirtualExposures,
};

/// Events this long before an opening edge in the stream may still belong to its exposure: a
/// sensor steps back by up to 11 us.
const STRAGGLE_US: u64 = 64;
/// Bound on event times above which a clock does not count as settled.
const SETTLED_NS: u64 = 1_000_000;
/// Width assumed of the first exposure ever, to begin rastering with.
const FIRST_WIDTH_NS: i64 = 100_000_000;

enum Exposures {
    Strobe(Box<ExposureTracker>),
    Periodic(PeriodicExposures),
    Sweeps {
        exposures: VirtualExposures,
        sweep: Option<(u32, Stamp<Tai>)>,
    },
}

/// Latencies inside the host.
#[derive(Debug, Default)]
pub struct HostLatency {
    /// Closing edge received to bundle sent.
    pub close_to_sent: Latency,
    /// Closing edge received to the synchroniser's decision: mostly waiting for the image.
    pub close_to_decided: Latency,
    /// Last input received to bundle sent: the host's own work.
    pub inputs_to_sent: Latency,
    /// Decision to bundle sent.
    pub decided_to_sent: Latency,
}

/// An image block lent by its lane, handed on as it is.
type ImageLease = Box<ImageBlock>;

/// The host's core.
pub struct Assembler<O: Outlet> {
    layout: BundleLayout,
    header: BundleHeader,
    outlet: O,
    timeline: Timeline,
    exposures: Exposures,
    closer: BundleCloser,
    history: EventHistory,
    voxels: Option<VoxelRaster>,
    /// Exposure that `voxels` is working on.
    rastering: Option<u64>,
    sparse: Option<SparseRaster>,
    planes: Option<(ImagePlanes, Grid)>,
    bay: Bay<O::Slot>,
    images: Vec<ImageLease>,
    images_held: usize,
    returned: Vec<ImageLease>,
    said: Vec<ExposureEvent>,
    decided: Vec<BundleDecision>,
    events_passed: Option<Stamp<Evk4>>,
    lidar_passed: Option<Stamp<Tai>>,
    received_ns: u64,
    /// How fast it was.
    pub latency: HostLatency,
    bundles: BundleReport,
    raster: RasterReport,
}

impl<O: Outlet> Assembler<O> {
    /// Allocates everything it will ever need.
    ///
    /// # Errors
    /// When the rig's geometry cannot be rastered.
    pub fn new(rig: &Rig, outlet: O) -> Result<Self, RigError> {
        let layout = rig.layout;
        let voxels = rig
            .voxels
            .clone()
            .map(|map| VoxelRaster::new(layout.steps, map))
            .transpose()?;
        let exposures = match rig.exposures {
            ExposureSource::Strobe(config) => {
                Exposures::Strobe(Box::new(ExposureTracker::new(config)))
            }
            ExposureSource::Periodic { period, width } => {
                let nanos =
                    |d: std::time::Duration| i64::try_from(d.as_nanos()).unwrap_or(i64::MAX);
                PeriodicExposures::new(nanos(period), nanos(width))
                    .map(Exposures::Periodic)
                    .ok_or(RigError::NoSensor)?
            }
            ExposureSource::Sweeps => Exposures::Sweeps {
                exposures: VirtualExposures::new(),
                sweep: None,
            },
        };
        let dimension = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
        Ok(Self {
            layout,
            header: BundleHeader {
                steps: dimension(layout.steps),
                bins: dimension(layout.bins),
                height: dimension(layout.height),
                width: dimension(layout.width),
                encoding: rig.encoding,
                bit_depth: rig.bit_depth,
                depth_m_max: rig.depth_m_max,
                ..BundleHeader::default()
            },
            outlet,
            timeline: Timeline::new(rig.timeline),
            exposures,
            closer: BundleCloser::new(rig.bundles),
            history: EventHistory::new(if voxels.is_some() {
                rig.history_events
            } else {
                1
            })?,
            voxels,
            rastering: None,
            sparse: rig.sparse.as_ref().map(SparseRaster::new).transpose()?,
            planes: rig
                .image
                .map(|rescale| (ImagePlanes::new(rescale), rescale.sensor())),
            // One more than may be pending: a decision makes room after a new one has opened.
            bay: Bay::new(rig.bundles.pending_max),
            images: Vec::with_capacity(rig.images_held + 1),
            images_held: rig.images_held,
            returned: Vec::with_capacity(rig.images_held + 2),
            said: Vec::with_capacity(64),
            decided: Vec::with_capacity(16),
            events_passed: None,
            lidar_passed: None,
            received_ns: 0,
            latency: HostLatency::default(),
            bundles: BundleReport::default(),
            raster: RasterReport::default(),
        })
    }

    /// Takes the events of a transfer, edges among them.
    ///
    /// # Errors
    /// When the outlet fails.
    pub fn events(&mut self, block: &EventBlock) -> Result<(), BusError> {
        self.received_ns = block.received_ns;
        self.due(block.arrival)?;
        if block.lost_before > 0 {
            self.closer.lost(Stream::Events, block.lost_before.into());
        }
        let mut done = 0;
        for mark in &block.edges {
            let upto = mark.events_before.min(block.events.len());
            self.history.extend(&block.events[done..upto.max(done)]);
            done = upto.max(done);
            let map = self.timeline.evk4_to_monotonic();
            if let Exposures::Strobe(tracker) = &mut self.exposures {
                tracker.edge(mark.edge, map.as_ref(), &mut |event| self.said.push(event));
            }
            self.hear(block.arrival);
        }
        self.history.extend(&block.events[done..]);
        self.advance_voxels();
        // Only where a transfer ends do its newest word and its arrival belong together; and only
        // there may time move on, or results would depend on how the bytes were cut.
        if let (true, Some(watermark)) = (block.ends_transfer, block.watermark) {
            let newest = block.newest.unwrap_or(watermark);
            match self.timeline.evk4_arrival(newest, block.arrival) {
                Observation::Used => self.advance(watermark, block.arrival),
                Observation::NewEpoch(_) => {
                    self.evk4_restarted(block.arrival);
                    self.advance(watermark, block.arrival);
                }
                Observation::Late | Observation::Suspect => {}
            }
        }
        self.decide()
    }

    fn advance(&mut self, watermark: Stamp<Evk4>, now: Stamp<Realtime>) {
        self.events_passed = Some(watermark);
        let map = self.timeline.evk4_to_monotonic();
        match &mut self.exposures {
            Exposures::Strobe(tracker) => {
                tracker.advance(watermark, map.as_ref(), &mut |event| self.said.push(event));
            }
            Exposures::Periodic(periodic) => {
                periodic.advance(watermark, &mut |event| self.said.push(event));
            }
            Exposures::Sweeps { .. } => {}
        }
        self.hear(now);
        self.finish_passed_voxels();
        self.closer
            .events_passed(watermark, now, &mut |d| self.decided.push(d));
    }

    fn evk4_restarted(&mut self, now: Stamp<Realtime>) {
        self.events_passed = None;
        if let Exposures::Strobe(tracker) = &mut self.exposures {
            tracker.clock_changed(&mut |event| self.said.push(event));
        }
        self.hear(now);
        self.closer
            .restarted(Stream::Events, now, &mut |d| self.decided.push(d));
    }

    /// Takes the returns of a packet.
    ///
    /// # Errors
    /// When the outlet fails.
    pub fn returns(&mut self, block: &ReturnBlock) -> Result<(), BusError> {
        self.received_ns = block.received_ns;
        self.due(block.arrival)?;
        if block.lost_before > 0 {
            self.closer.lost(Stream::Lidar, block.lost_before.into());
        }
        let observed = self.timeline.lidar_arrival(block.end, block.arrival);
        if matches!(observed, Observation::NewEpoch(_)) || block.clock_jumped {
            self.lidar_passed = None;
            self.closer
                .restarted(Stream::Lidar, block.arrival, &mut |d| self.decided.push(d));
        }
        let usable = matches!(observed, Observation::Used | Observation::NewEpoch(_));
        let Some(map) = self.timeline.lidar_to_tai().filter(|_| usable) else {
            return self.decide();
        };
        if let Some(sparse) = &mut self.sparse {
            sparse.note_block(map.apply(block.start), block.azimuth_cdeg);
            for echo in &block.returns {
                sparse.push_return(map.apply(echo.t), echo);
            }
        }
        if let Some(watermark) = block.watermark {
            let passed = map.apply(watermark);
            self.lidar_passed = Some(passed);
            self.draw_passed_sparse(passed);
            self.closer
                .passed(Stream::Lidar, passed, block.arrival, &mut |d| {
                    self.decided.push(d)
                });
            self.sweep(block.sweep, passed, block.arrival);
        }
        self.decide()
    }

    /// Without an event camera, every sweep is an exposure.
    fn sweep(&mut self, number: u32, at: Stamp<Tai>, now: Stamp<Realtime>) {
        let Exposures::Sweeps { exposures, sweep } = &mut self.exposures else {
            return;
        };
        match *sweep {
            Some((known, _)) if known == number => return,
            Some((_, began)) => {
                // The counter stands for TAI here.
                let on_counter = |t: Stamp<Tai>| Stamp::<Evk4>::from_nanos(t.as_nanos());
                let interval = (on_counter(began), on_counter(at));
                exposures.interval(interval.0, interval.1, None, &mut |e| self.said.push(e));
            }
            None => {}
        }
        *sweep = Some((number, at));
        self.hear(now);
        self.draw_passed_sparse(at);
        self.closer
            .passed(Stream::Lidar, at, now, &mut |d| self.decided.push(d));
    }

    /// Takes an image; it comes back through [`take_returned`](Self::take_returned).
    ///
    /// # Errors
    /// When the outlet fails.
    pub fn image(&mut self, block: Box<ImageBlock>) -> Result<(), BusError> {
        self.received_ns = block.received_ns;
        let stamp = block.stamp;
        self.due(stamp.arrival)?;
        if block.lost_before > 0 {
            self.closer.lost(Stream::Images, block.lost_before.into());
        }
        let image = ImageStamp {
            sequence: stamp.sequence.into(),
            driver: stamp.driver,
            stamped_at: match stamp.at {
                CameraStampedAt::StartOfExposure => StampedAt::Start,
                CameraStampedAt::EndOfExposure => StampedAt::End,
            },
            exposure_ns: i64::try_from(stamp.exposure_set_ns)
                .ok()
                .filter(|&ns| ns > 0),
            arrival: stamp.arrival,
        };
        if self.images.len() >= self.images_held {
            let oldest = self.images.remove(0);
            self.returned.push(oldest);
        }
        self.images.push(block);
        let map = self.timeline.evk4_to_monotonic();
        match &mut self.exposures {
            Exposures::Strobe(tracker) => {
                tracker.image(image, map.as_ref(), &mut |event| self.said.push(event));
            }
            // Nothing says when this image was taken: it belongs to no exposure.
            _ => self.release(image.sequence),
        }
        self.hear(stamp.arrival);
        self.decide()
    }

    /// Takes a motion sample or a clock reading.
    ///
    /// # Errors
    /// When the outlet fails.
    pub fn motion(&mut self, block: &MotionBlock) -> Result<(), BusError> {
        self.due(block.arrival())?;
        match block {
            MotionBlock::Clocks { reading } => {
                self.timeline.clocks(*reading);
            }
            MotionBlock::Motion { motion } => {
                if let (Some(map), Some(sparse)) =
                    (self.timeline.realtime_to_tai(), &mut self.sparse)
                {
                    let at = map.apply(motion.t);
                    // A sample out of order says nothing new.
                    let _ = sparse.push_motion(at, motion.speed_mps, motion.yaw_rate_rps);
                }
            }
        }
        self.decide()
    }

    /// The inputs have come as far as `now`: closes what is due.
    ///
    /// # Errors
    /// When the outlet fails.
    pub fn due(&mut self, now: Stamp<Realtime>) -> Result<(), BusError> {
        self.closer.arrival(now, &mut |d| self.decided.push(d));
        self.decide()
    }

    /// The inputs have ended: everything pending goes out.
    ///
    /// # Errors
    /// When the outlet fails.
    pub fn finish(&mut self, now: Stamp<Realtime>) -> Result<(), BusError> {
        let map = self.timeline.evk4_to_monotonic();
        if let Exposures::Strobe(tracker) = &mut self.exposures {
            tracker.finish(map.as_ref(), &mut |event| self.said.push(event));
        }
        self.hear(now);
        self.closer.finish(&mut |d| self.decided.push(d));
        self.decide()
    }

    /// Image leases that are no longer needed.
    pub fn take_returned(&mut self) -> Option<Box<ImageBlock>> {
        self.returned.pop()
    }

    /// Acts on what the exposure source said.
    fn hear(&mut self, now: Stamp<Realtime>) {
        let mut index = 0;
        while let Some(&event) = self.said.get(index) {
            index += 1;
            match event {
                ExposureEvent::Opened {
                    id,
                    open,
                    close_predicted,
                    ..
                } => {
                    self.opened(id, open, close_predicted);
                }
                ExposureEvent::Closed(exposure) => {
                    if let Some(berth) = self.bay.get(exposure.id) {
                        (berth.open, berth.close) = (exposure.open, Some(exposure.close));
                        berth.close_received_ns = self.received_ns;
                        berth.inputs_received_ns = self.received_ns;
                    }
                    // The next exposure may open within the same transfer.
                    self.finish_passed_voxels();
                }
                ExposureEvent::Imaged { exposure, pair } => {
                    if let Some(pair) = pair {
                        self.timeline.strobe_pair(pair.edge, pair.driver);
                    }
                    self.imaged(exposure.id, exposure.open, exposure.close, exposure.image);
                }
                ExposureEvent::ImageMissing(exposure) => {
                    if let Some(berth) = self.bay.get(exposure.id) {
                        (berth.open, berth.close) = (exposure.open, Some(exposure.close));
                    }
                }
                ExposureEvent::Discarded { id, .. } => {
                    self.bundles.discarded += 1;
                    self.rastering = self.rastering.filter(|&r| r != id);
                    drop(self.bay.take(id));
                }
                ExposureEvent::ImageLeftOut { sequence, .. } => {
                    self.bundles.images_left_out += 1;
                    self.release(sequence);
                }
            }
            let map = self.timeline.evk4_to_tai().map(|(map, _)| map);
            self.closer
                .exposure(&event, map.as_ref(), now, &mut |d| self.decided.push(d));
        }
        self.said.clear();
    }

    fn opened(&mut self, id: u64, open: Stamp<Evk4>, close_predicted: Option<Stamp<Evk4>>) {
        self.bundles.exposures += 1;
        self.finish_voxels_before(open);
        if self.bay.is_full() {
            self.bundles.without_memory += 1;
            return;
        }
        let Some(slot) = self.outlet.lend() else {
            self.bundles.without_memory += 1;
            return;
        };
        let close = close_predicted.unwrap_or_else(|| open.offset_nanos(FIRST_WIDTH_NS));
        if let (Some(voxels), Ok(predicted)) = (&mut self.voxels, RasterExposure::new(open, close))
        {
            voxels.begin(predicted, first_event(&self.history, open));
            self.rastering = Some(id);
        }
        self.bay.add(id, slot, open);
    }

    fn imaged(&mut self, id: u64, open: Stamp<Evk4>, close: Stamp<Evk4>, image: Option<u64>) {
        let Some(sequence) = image else { return };
        let lease = self
            .images
            .iter()
            .position(|i| u64::from(i.stamp.sequence) == sequence);
        if let Some(berth) = self.bay.get(id) {
            if berth.close != Some(close) || berth.open != open {
                berth.times = None;
                berth.sparse_drawn = false;
            }
            (berth.open, berth.close) = (open, Some(close));
            berth.inputs_received_ns = berth.inputs_received_ns.max(self.received_ns);
            if let (Some((writer, size)), Some(lease), Some(planes)) =
                (&self.planes, lease, berth.slot.planes(&self.layout))
                && write_image(writer, *size, &self.images[lease], planes.image)
            {
                berth.image = u32::try_from(sequence).ok();
                self.bundles.images_matched += 1;
            }
        }
        self.release(sequence);
    }

    fn release(&mut self, sequence: u64) {
        if let Some(index) = self
            .images
            .iter()
            .position(|i| u64::from(i.stamp.sequence) == sequence)
        {
            let image = self.images.remove(index);
            self.returned.push(image);
        }
    }

    /// Rasters new events of the open exposure.
    fn advance_voxels(&mut self) {
        let Some(id) = self.rastering else { return };
        if let (Some(voxels), Some(berth)) = (&mut self.voxels, self.bay.get(id))
            && berth.voxels.is_none()
            && let Some(planes) = berth.slot.planes(&self.layout)
        {
            // Fails only for memory of another size, which a slot never has.
            let _ = voxels.advance(&self.history, planes.voxels);
        }
    }

    /// Finishes the voxels of closed exposures whose events are all here.
    fn finish_passed_voxels(&mut self) {
        let (Some(voxels), Some(passed)) = (&mut self.voxels, self.events_passed) else {
            return;
        };
        for berth in self.bay.iter_mut() {
            if berth.voxels.is_none() && berth.close.is_some_and(|close| close <= passed) {
                let was_open = self.rastering == Some(berth.id);
                finish_voxels(
                    voxels,
                    &self.history,
                    &self.layout,
                    berth,
                    was_open,
                    &mut self.raster,
                );
                self.rastering = self.rastering.filter(|_| !was_open);
            }
        }
    }

    /// Finishes the exposure under way when the next one opens: every event of it that precedes
    /// this edge in the stream is here, and none follows that far behind.
    fn finish_voxels_before(&mut self, open: Stamp<Evk4>) {
        let Some(id) = self.rastering else { return };
        let (Some(voxels), Some(berth)) = (&mut self.voxels, self.bay.get(id)) else {
            return;
        };
        let straggle_ns = i64::try_from(STRAGGLE_US * 1000).unwrap_or(i64::MAX);
        if berth
            .close
            .is_some_and(|close| close.offset_nanos(straggle_ns) <= open)
        {
            finish_voxels(
                voxels,
                &self.history,
                &self.layout,
                berth,
                true,
                &mut self.raster,
            );
            self.rastering = None;
        }
    }

    fn draw_passed_sparse(&mut self, passed: Stamp<Tai>) {
        let Some(sparse) = &mut self.sparse else {
            return;
        };
        for berth in self.bay.iter_mut() {
            if berth.close.is_none() || berth.sparse_drawn {
                continue;
            }
            if berth.times.is_none() {
                berth.times = times(&self.timeline, &self.layout, berth);
            }
            if berth.times.is_some_and(|t| t.close <= passed) {
                draw_sparse(sparse, &self.layout, berth, &mut self.raster);
                berth.inputs_received_ns = berth.inputs_received_ns.max(self.received_ns);
            }
        }
    }

    /// Sends what was decided.
    fn decide(&mut self) -> Result<(), BusError> {
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

    /// Rasters what is still missing of a bundle that goes out now.
    fn complete(&mut self, berth: &mut Berth<O::Slot>, decision: &BundleDecision, was_open: bool) {
        let exposure = &decision.exposure;
        if (berth.open, berth.close) != (exposure.open, Some(exposure.close)) {
            (berth.open, berth.close) = (exposure.open, Some(exposure.close));
            (berth.times, berth.sparse_drawn) = (None, false);
        }
        if let Some(voxels) = &mut self.voxels
            && berth.voxels != Some((exposure.open, exposure.close))
        {
            let was_open = was_open && berth.voxels.is_none();
            finish_voxels(
                voxels,
                &self.history,
                &self.layout,
                berth,
                was_open,
                &mut self.raster,
            );
            // A raster of another exposure that was under way has been abandoned for this one.
            self.rastering = None;
        }
        if berth.times.is_none() {
            berth.times = times(&self.timeline, &self.layout, berth);
        }
        if let (Some(sparse), false) = (&mut self.sparse, berth.sparse_drawn) {
            draw_sparse(sparse, &self.layout, berth, &mut self.raster);
        }
    }

    fn send(
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

    fn header_of(
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

    fn flags_of(&self, berth: &Berth<O::Slot>, decision: &BundleDecision) -> u32 {
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

    /// Bundles by how they went out, so far.
    #[must_use]
    pub fn bundle_report(&self) -> BundleReport {
        let counts = self.closer.counts();
        let repaired = match &self.exposures {
            Exposures::Strobe(tracker) => tracker.counts().edges_repaired,
            _ => 0,
        };
        BundleReport {
            complete: counts.complete,
            partial: counts.partial,
            by_deadline: counts.by_deadline,
            edges_repaired: repaired,
            ..self.bundles
        }
    }

    /// How exposures were rastered, so far.
    #[must_use]
    pub fn raster_report(&self) -> RasterReport {
        self.raster
    }

    /// The clock maps.
    #[must_use]
    pub fn timeline(&self) -> &Timeline {
        &self.timeline
    }

    /// The newest watermark of the events.
    #[must_use]
    pub fn events_passed(&self) -> Option<Stamp<Evk4>> {
        self.events_passed
    }

    /// The outlet, as for a test to look into.
    pub fn outlet(&mut self) -> &mut O {
        &mut self.outlet
    }
}

fn first_event(history: &EventHistory, open: Stamp<Evk4>) -> u64 {
    let from = open.as_micros().saturating_sub(STRAGGLE_US);
    // Packed times are the low 32 bits.
    #[expect(clippy::cast_possible_truncation, reason = "packed times wrap")]
    history.first_since(from as u32)
}

fn write_image(writer: &ImagePlanes, size: Grid, image: &ImageBlock, out: &mut [f32]) -> bool {
    let view = ImageView {
        data: &image.rgb,
        size,
        stride_bytes: size.width as usize * 3,
        samples: Samples::U8,
    };
    writer.write(&view, out).is_ok()
}

/// Steps of a berth's exposure on TAI, as the clocks say now.
fn times<L>(timeline: &Timeline, layout: &BundleLayout, berth: &Berth<L>) -> Option<Times> {
    let (map, source) = timeline.evk4_to_tai()?;
    let close = berth.close?;
    let width = close.diff_nanos(berth.open);
    let steps = i64::try_from(layout.steps).unwrap_or(1);
    let mut centres = [Stamp::ZERO; STEPS_MAX];
    for (k, centre) in (0..steps).zip(&mut centres) {
        *centre = map.apply(berth.open.offset_nanos(width * (2 * k + 1) / (2 * steps)));
    }
    let uncertainty_ns = map
        .uncertainty_at(berth.open)
        .max(map.uncertainty_at(close));
    Some(Times {
        open: map.apply(berth.open),
        close: map.apply(close),
        centres,
        uncertainty_ns,
        is_settled: source == MapSource::Offset || uncertainty_ns <= SETTLED_NS,
    })
}

fn draw_sparse<L: Slot>(
    sparse: &mut SparseRaster,
    layout: &BundleLayout,
    berth: &mut Berth<L>,
    report: &mut RasterReport,
) {
    let Some(times) = berth.times else { return };
    let Some(planes) = berth.slot.planes(layout) else {
        return;
    };
    berth.sparse_drawn = true;
    (berth.returns, berth.has_pass, berth.has_motion) = (0, false, true);
    for (centre, out) in times
        .centres
        .iter()
        .zip(planes.sparse.chunks_exact_mut(layout.plane()))
    {
        let moved = sparse.draw(*centre, EgoPolicy::Compensate, out);
        let drawn = match moved {
            Ok(drawn) => Some(drawn),
            Err(_) => {
                berth.has_motion = false;
                report.steps_without_motion += 1;
                sparse.draw(*centre, EgoPolicy::Still, out).ok()
            }
        };
        match drawn {
            Some(drawn) if drawn.pass.is_some() => {
                berth.has_pass = true;
                berth.returns += drawn.drawn;
            }
            _ => report.steps_without_pass += 1,
        }
    }
}

fn finish_voxels<L: Slot>(
    voxels: &mut VoxelRaster,
    history: &EventHistory,
    layout: &BundleLayout,
    berth: &mut Berth<L>,
    was_open: bool,
    report: &mut RasterReport,
) {
    let Some(close) = berth.close else { return };
    let Some(planes) = berth.slot.planes(layout) else {
        return;
    };
    let out = planes.voxels;
    let Ok(exposure) = RasterExposure::new(berth.open, close) else {
        out.fill(0.0);
        berth.voxels = Some((berth.open, close));
        return;
    };
    if !was_open {
        voxels.begin(exposure, first_event(history, berth.open));
    }
    match voxels.finish(exposure, history, out) {
        Ok(done) => {
            match done.retimed {
                Retimed::Exact if was_open => report.exact += 1,
                Retimed::Delta { .. } => report.delta += 1,
                _ => report.full += 1,
            }
            report.events += done.tally.rastered;
            report.events_forgotten += done.forgotten;
            berth.events = done.tally.rastered;
            berth.events_outside = done.tally.outside_grid;
            berth.events_forgotten = done.forgotten;
        }
        // More events in a step than a sum can hold: nothing of it can be trusted.
        Err(_) => out.fill(0.0),
    }
    berth.voxels = Some((berth.open, close));
}

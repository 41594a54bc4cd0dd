//! From blocks to bundles: keeps the clocks, follows the exposures, writes the rasters.
//!
//! Reads no clock: instants come with the blocks, and the outlet stamps what it sends.

mod exposures;
mod rasters;
mod sending;

use noctule_camera::StampedAt as CameraStampedAt;
use noctule_raster::{EventHistory, Grid, ImagePlanes, SparseRaster, VoxelRaster};
use noctule_sensor::{Evk4, Realtime, Stamp, Tai};

use crate::bus::BusError;
use crate::frame::{BundleHeader, BundleLayout};
use crate::host::bay::Bay;
use crate::host::blocks::{EventBlock, ImageBlock, MotionBlock, ReturnBlock};
use crate::host::outlet::Outlet;
use crate::host::report::{BundleReport, RasterReport};
use crate::host::rig::{ExposureSource, Rig, RigError};
use crate::latency::Latency;
use crate::sync::{
    BundleCloser, BundleDecision, ExposureEvent, ExposureTracker, ImageStamp, Observation,
    PeriodicExposures, StampedAt, Stream, Timeline, VirtualExposures,
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
                ground: rig.ground.map_or([0.0; 3], |ground| ground.numbers()),
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

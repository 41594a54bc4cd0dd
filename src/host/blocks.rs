//! What the ingest threads hand over, one block per delivery of the device.

use noctule_camera::FrameStamp;
use noctule_raster::PackedEvent;
use noctule_sensor::{Evk4, Lidar, Motion, Realtime, Return, Stamp, TriggerEdge};

/// A strobe edge and its place among the block's events.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EdgeMark {
    /// Events of the block that came before it.
    pub events_before: usize,
    /// The edge.
    pub edge: TriggerEdge,
}

/// Events of one USB transfer, or of a part of it.
#[derive(Debug)]
pub struct EventBlock {
    /// When the transfer reached the host.
    pub arrival: Stamp<Realtime>,
    /// The same instant on `CLOCK_MONOTONIC` of this run, nanoseconds.
    pub received_ns: u64,
    /// Events in stream order; the capacity is the block's limit.
    pub events: Vec<PackedEvent>,
    /// Edges in stream order; the capacity is the block's limit.
    pub edges: Vec<EdgeMark>,
    /// No earlier event follows.
    pub watermark: Option<Stamp<Evk4>>,
    /// The latest instant that the transfer so far tells of: the one that `arrival` belongs to. A
    /// watermark trails it by what the sensor may step back.
    pub newest: Option<Stamp<Evk4>>,
    /// Whether the transfer ends with this block: only then do arrival and `newest` belong
    /// together.
    pub ends_transfer: bool,
    /// Transfers lost before this one.
    pub lost_before: u32,
}

impl EventBlock {
    /// Events in a block.
    pub const EVENTS_MAX: usize = 16_384;
    /// Edges in a block.
    pub const EDGES_MAX: usize = 64;

    /// An empty block.
    #[must_use]
    pub fn new() -> Self {
        Self {
            arrival: Stamp::ZERO,
            received_ns: 0,
            events: Vec::with_capacity(Self::EVENTS_MAX),
            edges: Vec::with_capacity(Self::EDGES_MAX),
            watermark: None,
            newest: None,
            ends_transfer: false,
            lost_before: 0,
        }
    }

    /// Whether another event or edge may not fit.
    #[must_use]
    pub fn is_full(&self) -> bool {
        self.events.len() >= Self::EVENTS_MAX || self.edges.len() >= Self::EDGES_MAX
    }

    /// Makes it empty again.
    pub fn clear(&mut self) {
        self.events.clear();
        self.edges.clear();
        self.watermark = None;
        self.newest = None;
        self.ends_transfer = false;
        self.lost_before = 0;
    }
}

impl Default for EventBlock {
    fn default() -> Self {
        Self::new()
    }
}

/// Returns of one LiDAR packet.
#[derive(Debug)]
pub struct ReturnBlock {
    /// When the packet reached the host.
    pub arrival: Stamp<Realtime>,
    /// The same instant on `CLOCK_MONOTONIC` of this run, nanoseconds.
    pub received_ns: u64,
    /// Returns in packet order, equal dual returns once.
    pub returns: Vec<Return>,
    /// Raw azimuth of the packet's first block, hundredths of a degree.
    pub azimuth_cdeg: u32,
    /// When its first laser fired.
    pub start: Stamp<Lidar>,
    /// When its last laser fired.
    pub end: Stamp<Lidar>,
    /// No earlier return follows.
    pub watermark: Option<Stamp<Lidar>>,
    /// Number of sweeps begun before this packet ended.
    pub sweep: u32,
    /// Packets lost before this one, by their numbering.
    pub lost_before: u32,
    /// Whether the sensor's clock jumped before this packet.
    pub clock_jumped: bool,
}

impl ReturnBlock {
    /// Returns in a packet of the densest model.
    pub const RETURNS_MAX: usize = 512;

    /// An empty block.
    #[must_use]
    pub fn new() -> Self {
        Self {
            arrival: Stamp::ZERO,
            received_ns: 0,
            returns: Vec::with_capacity(Self::RETURNS_MAX),
            azimuth_cdeg: 0,
            start: Stamp::ZERO,
            end: Stamp::ZERO,
            watermark: None,
            sweep: 0,
            lost_before: 0,
            clock_jumped: false,
        }
    }
}

impl Default for ReturnBlock {
    fn default() -> Self {
        Self::new()
    }
}

/// One camera image.
#[derive(Debug)]
pub struct ImageBlock {
    /// Number, stamps and settings.
    pub stamp: FrameStamp,
    /// Arrival on `CLOCK_MONOTONIC` of this run, nanoseconds.
    pub received_ns: u64,
    /// RGB, 8 bits, row by row without gaps.
    pub rgb: Vec<u8>,
    /// Images lost before this one, by their numbering.
    pub lost_before: u32,
}

impl ImageBlock {
    /// An empty block for images of `bytes`.
    #[must_use]
    pub fn new(bytes: usize) -> Self {
        Self {
            stamp: FrameStamp {
                sequence: 0,
                driver: Stamp::ZERO,
                at: noctule_camera::StampedAt::StartOfExposure,
                arrival: Stamp::ZERO,
                exposure_set_ns: 0,
                gain_db: 0.0,
            },
            received_ns: 0,
            rgb: vec![0; bytes],
            lost_before: 0,
        }
    }
}

/// One motion sample, or a reading of the host's clocks, which shares its lane: both are small and
/// slow.
#[derive(Debug, Clone, Copy)]
pub enum MotionBlock {
    /// The vehicle moved.
    Motion {
        /// The sample; its stamp is its arrival.
        motion: Motion,
    },
    /// The host's clocks were read.
    Clocks {
        /// The reading.
        reading: crate::sync::ClockReading,
    },
}

impl MotionBlock {
    /// When it reached the host.
    #[must_use]
    pub fn arrival(&self) -> Stamp<Realtime> {
        match self {
            Self::Motion { motion } => motion.t,
            Self::Clocks { reading } => reading.realtime,
        }
    }
}

//! What travels beside the planes: who made them, when, of what, and what is wrong with them.

use bytemuck::{Pod, Zeroable};
use iceoryx2::prelude::ZeroCopySend;
use noctule_depth::Ground;

use super::{
    BUNDLE_MAGIC, BundleLayout, DEPTH_MAGIC, DepthLayout, FRAME_VERSION, FrameError, STEPS_MAX,
};

/// Flags of a bundle, passed on by every depth frame made from it.
pub mod flag {
    /// The deadline came before every stream had caught up.
    pub const PARTIAL: u32 = 1;
    /// No image belongs to this exposure; the image planes are zero.
    pub const NO_IMAGE: u32 = 1 << 1;
    /// There is no event stream; the voxels are zero.
    pub const NO_EVENTS: u32 = 1 << 2;
    /// No complete LiDAR pass could be placed on any step.
    pub const NO_LIDAR: u32 = 1 << 3;
    /// The vehicle's motion was unknown: returns were not moved to their steps.
    pub const NO_MOTION: u32 = 1 << 4;
    /// There was no strobe: the exposure is a period of the host's choosing.
    pub const VIRTUAL: u32 = 1 << 5;
    /// An edge was missing and its instant follows from the nominal width.
    pub const EDGE_REPAIRED: u32 = 1 << 6;
    /// A clock was stepped or restarted during the exposure.
    pub const EPOCH_CHANGED: u32 = 1 << 7;
    /// Some of the exposure's events had left the bounded history before it was closed.
    pub const EVENTS_TRUNCATED: u32 = 1 << 8;
    /// A clock map that this exposure relies on has not settled yet.
    pub const CLOCK_UNSETTLED: u32 = 1 << 9;
    /// A cheaper model than asked for ran, because time was short.
    pub const STEPPED_DOWN: u32 = 1 << 16;
    /// The sequence ended before its last step, because time ran out.
    pub const ENDED_EARLY: u32 = 1 << 17;
    /// This frame was sent after its bundle's deadline.
    pub const LATE: u32 = 1 << 18;

    /// Names of the set flags, for reports.
    #[must_use]
    pub fn names(flags: u32) -> Vec<&'static str> {
        const ALL: [(u32, &str); 13] = [
            (PARTIAL, "partial"),
            (NO_IMAGE, "no_image"),
            (NO_EVENTS, "no_events"),
            (NO_LIDAR, "no_lidar"),
            (NO_MOTION, "no_motion"),
            (VIRTUAL, "virtual"),
            (EDGE_REPAIRED, "edge_repaired"),
            (EPOCH_CHANGED, "epoch_changed"),
            (EVENTS_TRUNCATED, "events_truncated"),
            (CLOCK_UNSETTLED, "clock_unsettled"),
            (STEPPED_DOWN, "stepped_down"),
            (ENDED_EARLY, "ended_early"),
            (LATE, "late"),
        ];
        ALL.iter()
            .filter(|(bit, _)| flags & bit != 0)
            .map(|(_, name)| *name)
            .collect()
    }
}

/// Samples a stream lost since the previous bundle, one counter per stream.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable, ZeroCopySend)]
#[repr(C)]
pub struct Lost {
    /// Event transfers.
    pub events: u32,
    /// LiDAR packets.
    pub lidar: u32,
    /// Camera images.
    pub images: u32,
    /// CAN frames.
    pub motion: u32,
}

/// Instants at which a bundle passed the host's stages, on `CLOCK_MONOTONIC`, nanoseconds.
///
/// They say how fast this run was, not what it saw: they stay outside every digest.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable, ZeroCopySend)]
#[repr(C)]
pub struct HostStages {
    /// The bytes that close the exposure came in.
    pub close_received_ns: u64,
    /// The last input that the bundle waited for came in.
    pub inputs_received_ns: u64,
    /// The synchroniser let the bundle go.
    pub decided_ns: u64,
    /// The rasters were complete and the bundle was sent.
    pub sent_ns: u64,
}

/// Instants at which a depth frame passed the inference process's stages; as [`HostStages`].
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable, ZeroCopySend)]
#[repr(C)]
pub struct InferStages {
    /// The bundle was taken off the bus.
    pub bundle_received_ns: u64,
    /// The model began with the sequence.
    pub started_ns: u64,
    /// This step's depth was complete.
    pub done_ns: u64,
    /// This frame was sent.
    pub sent_ns: u64,
}

/// What a bundle says about itself.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable, ZeroCopySend)]
#[repr(C)]
pub struct BundleHeader {
    /// [`BUNDLE_MAGIC`].
    pub magic: u32,
    /// [`FRAME_VERSION`].
    pub version: u32,
    /// Counts bundles; a gap means bundles this receiver never saw.
    pub sequence: u64,
    /// Shutter opened, TAI nanoseconds.
    pub open_tai_ns: u64,
    /// Shutter closed, TAI nanoseconds.
    pub close_tai_ns: u64,
    /// 99 % bound on the error of both, nanoseconds.
    pub uncertainty_ns: u64,
    /// Centre of each step, TAI nanoseconds; zero beyond `steps`.
    pub step_tai_ns: [u64; STEPS_MAX],
    /// Events of the exposure that reached the voxel grids.
    pub events: u64,
    /// Events of the exposure outside the network's field of view.
    pub events_outside: u64,
    /// Steps T.
    pub steps: u32,
    /// Voxel bins per step B.
    pub bins: u32,
    /// Rows H.
    pub height: u32,
    /// Columns W.
    pub width: u32,
    /// Bits of [`flag`].
    pub flags: u32,
    /// Image encoding: 0 linear, 1 sRGB, 2 gamma 2.2.
    pub encoding: u32,
    /// Bits per sample of the image as delivered.
    pub bit_depth: u32,
    /// The camera's own number of the image; meaningless with [`flag::NO_IMAGE`].
    pub image_sequence: u32,
    /// Pixels that carry a return, over all steps.
    pub returns: u32,
    /// Largest depth the sensors of this rig report, metres.
    pub depth_m_max: f32,
    /// Level ground in the planes, as [`Ground::numbers`]; zeros where it is not known.
    pub ground: [f32; 3],
    /// Zero.
    pub reserved: u32,
    /// What was lost since the previous bundle.
    pub lost: Lost,
    /// How fast the host was.
    pub stages: HostStages,
}

impl Default for BundleHeader {
    fn default() -> Self {
        Self {
            magic: BUNDLE_MAGIC,
            version: FRAME_VERSION,
            ..Self::zeroed()
        }
    }
}

impl BundleHeader {
    /// The layout of this bundle's payload.
    ///
    /// # Errors
    /// When the header was not written by this version of the program.
    pub fn layout(&self) -> Result<BundleLayout, FrameError> {
        if (self.magic, self.version) != (BUNDLE_MAGIC, FRAME_VERSION) {
            return Err(FrameError::Version {
                magic: self.magic,
                version: self.version,
            });
        }
        BundleLayout::new(self.steps, self.bins, self.height, self.width)
    }

    /// Where level ground lies in the planes; `None` where that is not known.
    #[must_use]
    pub fn ground(&self) -> Option<Ground> {
        Ground::from_numbers(self.ground)
    }

    /// The header with everything removed that differs between two runs over the same recording.
    #[must_use]
    pub fn without_stages(&self) -> Self {
        Self {
            stages: HostStages::default(),
            ..*self
        }
    }
}

/// What a depth frame says about itself.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable, ZeroCopySend)]
#[repr(C)]
pub struct DepthHeader {
    /// [`DEPTH_MAGIC`].
    pub magic: u32,
    /// [`FRAME_VERSION`].
    pub version: u32,
    /// Counts depth frames; a gap means frames this receiver never saw.
    pub frame: u64,
    /// The bundle this frame was made from.
    pub sequence: u64,
    /// Shutter opened, TAI nanoseconds.
    pub open_tai_ns: u64,
    /// Shutter closed, TAI nanoseconds.
    pub close_tai_ns: u64,
    /// The instant this map shows, TAI nanoseconds.
    pub step_tai_ns: u64,
    /// 99 % bound on the error of these times, nanoseconds.
    pub uncertainty_ns: u64,
    /// Step of the sequence, 0 first.
    pub step: u32,
    /// Steps the sequence has when it is complete.
    pub steps: u32,
    /// Rows H.
    pub height: u32,
    /// Columns W.
    pub width: u32,
    /// Which model made it: [`ModelId`](super::ModelId).
    pub model: u32,
    /// Bits of [`flag`].
    pub flags: u32,
    /// How fast the host was.
    pub host: HostStages,
    /// How fast the inference process was.
    pub infer: InferStages,
}

impl Default for DepthHeader {
    fn default() -> Self {
        Self {
            magic: DEPTH_MAGIC,
            version: FRAME_VERSION,
            ..Self::zeroed()
        }
    }
}

impl DepthHeader {
    /// The layout of this frame's payload.
    ///
    /// # Errors
    /// When the header was not written by this version of the program.
    pub fn layout(&self) -> Result<DepthLayout, FrameError> {
        if (self.magic, self.version) != (DEPTH_MAGIC, FRAME_VERSION) {
            return Err(FrameError::Version {
                magic: self.magic,
                version: self.version,
            });
        }
        DepthLayout::new(self.height, self.width)
    }

    /// The header with everything removed that differs between two runs over the same recording.
    #[must_use]
    pub fn without_stages(&self) -> Self {
        Self {
            frame: 0,
            flags: self.flags & !flag::LATE,
            host: HostStages::default(),
            infer: InferStages::default(),
            ..*self
        }
    }
}

//! What crosses shared memory: bundles into the network, depth frames out of it.
//!
//! Everything here is plain old data with a fixed layout: any process built from the same version
//! reads it in place. Payloads are slices of 64-byte [`Block`]s, so every plane starts on a cache
//! line; headers travel beside them. [`FRAME_VERSION`] changes whenever a layout does.

use std::fmt;

use bytemuck::{Pod, Zeroable};
use iceoryx2::prelude::ZeroCopySend;

/// Version of every layout in this file.
pub const FRAME_VERSION: u32 = 1;
/// Marks a bundle header ("NOCB").
pub const BUNDLE_MAGIC: u32 = 0x4243_4f4e;
/// Marks a depth header ("NOCD").
pub const DEPTH_MAGIC: u32 = 0x4443_4f4e;
/// The most steps a sequence may have.
pub const STEPS_MAX: usize = 16;

/// Sixteen floats on one cache line: the unit of every payload.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable, ZeroCopySend)]
#[repr(C)]
#[repr(align(64))]
pub struct Block {
    /// The floats.
    pub lanes: [f32; Block::LANES],
}

impl Block {
    /// Floats in a block.
    pub const LANES: usize = 16;
    /// All zero.
    pub const ZERO: Self = Self {
        lanes: [0.0; Self::LANES],
    };
}

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
    /// Which model made it: [`ModelId`].
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

/// The rungs of the ladder, and what is not on it.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, serde::Deserialize,
)]
#[serde(rename_all = "lowercase")]
#[repr(u32)]
pub enum ModelId {
    /// Nearest return.
    Nearest = 0,
    /// Classical completion.
    Fill = 1,
    /// The smallest ERU-Net.
    Xs = 2,
    /// The small ERU-Net.
    S = 3,
    /// The paper's ERU-Net.
    Full = 4,
}

impl ModelId {
    /// All models, cheapest first.
    pub const ALL: [Self; 5] = [Self::Nearest, Self::Fill, Self::Xs, Self::S, Self::Full];

    /// The model a header names.
    #[must_use]
    pub fn from_u32(id: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|m| *m as u32 == id)
    }

    /// Name as written in configuration and reports.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Nearest => "nearest",
            Self::Fill => "fill",
            Self::Xs => "xs",
            Self::S => "s",
            Self::Full => "full",
        }
    }
}

impl fmt::Display for ModelId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl std::str::FromStr for ModelId {
    type Err = FrameError;

    fn from_str(text: &str) -> Result<Self, FrameError> {
        Self::ALL
            .into_iter()
            .find(|m| m.name() == text)
            .ok_or_else(|| FrameError::UnknownModel(text.to_owned()))
    }
}

/// Why a frame cannot be read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FrameError {
    /// Written by something else, or by another version.
    #[error(
        "header has magic {magic:#010x} and version {version}, this program reads version {FRAME_VERSION}"
    )]
    Version {
        /// As read.
        magic: u32,
        /// As read.
        version: u32,
    },
    /// Dimensions no layout allows.
    #[error("{what} is {value}, allowed is {allowed}")]
    Dimension {
        /// Which one.
        what: &'static str,
        /// As asked.
        value: u32,
        /// In words.
        allowed: &'static str,
    },
    /// A payload of the wrong size.
    #[error("payload has {actual} blocks, the layout needs {needed}")]
    Length {
        /// Blocks the layout needs.
        needed: usize,
        /// Blocks there are.
        actual: usize,
    },
    /// Not the name of a model.
    #[error("unknown model '{0}': one of nearest, fill, xs, s, full")]
    UnknownModel(String),
}

fn check(
    what: &'static str,
    value: u32,
    ok: bool,
    allowed: &'static str,
) -> Result<usize, FrameError> {
    let refused = FrameError::Dimension {
        what,
        value,
        allowed,
    };
    if ok {
        usize::try_from(value).map_err(|_| refused)
    } else {
        Err(refused)
    }
}

/// Where the planes of a bundle lie: voxels `[T, B, H, W]`, sparse depth `[T, H, W]`, image
/// `[3, H, W]`, all `f32`, each starting on a cache line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BundleLayout {
    /// Steps T.
    pub steps: usize,
    /// Voxel bins per step B.
    pub bins: usize,
    /// Rows H.
    pub height: usize,
    /// Columns W.
    pub width: usize,
}

impl BundleLayout {
    /// A layout of these dimensions.
    ///
    /// # Errors
    /// When a dimension is out of range; H and W must be multiples of 16.
    pub fn new(steps: u32, bins: u32, height: u32, width: u32) -> Result<Self, FrameError> {
        let plane = |v: u32| v.is_multiple_of(16) && (16..=4096).contains(&v);
        Ok(Self {
            steps: check("steps", steps, (1..=16).contains(&steps), "1 to 16")?,
            bins: check("bins", bins, (2..=16).contains(&bins), "2 to 16")?,
            height: check(
                "height",
                height,
                plane(height),
                "a multiple of 16 up to 4096",
            )?,
            width: check("width", width, plane(width), "a multiple of 16 up to 4096")?,
        })
    }

    /// Floats in one plane H x W.
    #[must_use]
    pub fn plane(&self) -> usize {
        self.height * self.width
    }

    /// Floats of the voxel grids.
    #[must_use]
    pub fn voxels_len(&self) -> usize {
        self.steps * self.bins * self.plane()
    }

    /// Floats of the sparse depth maps.
    #[must_use]
    pub fn sparse_len(&self) -> usize {
        self.steps * self.plane()
    }

    /// Floats of the image planes.
    #[must_use]
    pub fn image_len(&self) -> usize {
        3 * self.plane()
    }

    /// Blocks of the whole payload.
    #[must_use]
    pub fn blocks(&self) -> usize {
        (self.voxels_len() + self.sparse_len() + self.image_len()) / Block::LANES
    }

    /// Bytes of the whole payload.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.blocks() * size_of::<Block>()
    }

    /// The planes of a payload.
    ///
    /// # Errors
    /// When the payload has another size.
    pub fn planes<'a>(&self, payload: &'a [Block]) -> Result<BundlePlanes<'a>, FrameError> {
        self.expect(payload.len())?;
        let floats: &[f32] = bytemuck::cast_slice(payload);
        let (voxels, rest) = floats.split_at(self.voxels_len());
        let (sparse, image) = rest.split_at(self.sparse_len());
        Ok(BundlePlanes {
            voxels,
            sparse,
            image,
        })
    }

    /// The planes of a payload, to be written.
    ///
    /// # Errors
    /// When the payload has another size.
    pub fn planes_mut<'a>(
        &self,
        payload: &'a mut [Block],
    ) -> Result<BundlePlanesMut<'a>, FrameError> {
        self.expect(payload.len())?;
        let floats: &mut [f32] = bytemuck::cast_slice_mut(payload);
        let (voxels, rest) = floats.split_at_mut(self.voxels_len());
        let (sparse, image) = rest.split_at_mut(self.sparse_len());
        Ok(BundlePlanesMut {
            voxels,
            sparse,
            image,
        })
    }

    fn expect(&self, actual: usize) -> Result<(), FrameError> {
        let needed = self.blocks();
        if actual == needed {
            Ok(())
        } else {
            Err(FrameError::Length { needed, actual })
        }
    }
}

/// A bundle's planes.
#[derive(Debug, Clone, Copy)]
pub struct BundlePlanes<'a> {
    /// `[T, B, H, W]`, in `[-1, 1]`.
    pub voxels: &'a [f32],
    /// `[T, H, W]`, metres, 0 where there is no return.
    pub sparse: &'a [f32],
    /// `[3, H, W]`, encoded, in `[0, 1]`.
    pub image: &'a [f32],
}

/// A bundle's planes, to be written.
#[derive(Debug)]
pub struct BundlePlanesMut<'a> {
    /// `[T, B, H, W]`, in `[-1, 1]`.
    pub voxels: &'a mut [f32],
    /// `[T, H, W]`, metres, 0 where there is no return.
    pub sparse: &'a mut [f32],
    /// `[3, H, W]`, encoded, in `[0, 1]`.
    pub image: &'a mut [f32],
}

/// Where the planes of a depth frame lie: depth `[H, W]` in metres, then confidence `[H, W]`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DepthLayout {
    /// Rows H.
    pub height: usize,
    /// Columns W.
    pub width: usize,
}

impl DepthLayout {
    /// A layout of these dimensions.
    ///
    /// # Errors
    /// When a dimension is not a multiple of 16 or out of range.
    pub fn new(height: u32, width: u32) -> Result<Self, FrameError> {
        let BundleLayout { height, width, .. } = BundleLayout::new(1, 2, height, width)?;
        Ok(Self { height, width })
    }

    /// Floats in one plane H x W.
    #[must_use]
    pub fn plane(&self) -> usize {
        self.height * self.width
    }

    /// Blocks of the whole payload.
    #[must_use]
    pub fn blocks(&self) -> usize {
        2 * self.plane() / Block::LANES
    }

    /// Depth and confidence of a payload.
    ///
    /// # Errors
    /// When the payload has another size.
    pub fn planes<'a>(&self, payload: &'a [Block]) -> Result<(&'a [f32], &'a [f32]), FrameError> {
        self.expect(payload.len())?;
        let floats: &[f32] = bytemuck::cast_slice(payload);
        Ok(floats.split_at(self.plane()))
    }

    /// Depth and confidence of a payload, to be written.
    ///
    /// # Errors
    /// When the payload has another size.
    pub fn planes_mut<'a>(
        &self,
        payload: &'a mut [Block],
    ) -> Result<(&'a mut [f32], &'a mut [f32]), FrameError> {
        self.expect(payload.len())?;
        let floats: &mut [f32] = bytemuck::cast_slice_mut(payload);
        Ok(floats.split_at_mut(self.plane()))
    }

    fn expect(&self, actual: usize) -> Result<(), FrameError> {
        let needed = self.blocks();
        if actual == needed {
            Ok(())
        } else {
            Err(FrameError::Length { needed, actual })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planes_tile_the_payload_and_start_on_cache_lines() {
        let layout = BundleLayout::new(8, 5, 48, 32).unwrap();
        let mut payload = vec![Block::ZERO; layout.blocks()];
        let planes = layout.planes_mut(&mut payload).unwrap();
        assert_eq!(planes.voxels.len(), 8 * 5 * 48 * 32);
        assert_eq!(planes.sparse.len(), 8 * 48 * 32);
        assert_eq!(planes.image.len(), 3 * 48 * 32);
        for start in [
            planes.voxels.as_ptr(),
            planes.sparse.as_ptr(),
            planes.image.as_ptr(),
        ] {
            assert_eq!(start as usize % 64, 0);
        }
        planes.image[0] = 0.5;
        assert_eq!(layout.planes(&payload).unwrap().image[0], 0.5);
    }

    #[test]
    fn dimensions_are_refused_by_name() {
        let error = BundleLayout::new(8, 5, 250, 256).unwrap_err();
        assert_eq!(
            error.to_string(),
            "height is 250, allowed is a multiple of 16 up to 4096"
        );
        assert!(BundleLayout::new(17, 5, 256, 256).is_err());
        assert!(BundleLayout::new(8, 1, 256, 256).is_err());
        assert_eq!(
            DepthLayout::new(16, 16)
                .unwrap()
                .planes(&[Block::ZERO; 3])
                .unwrap_err(),
            FrameError::Length {
                needed: 32,
                actual: 3
            }
        );
    }

    #[test]
    fn a_header_of_another_version_is_refused() {
        let mut header = BundleHeader {
            steps: 8,
            bins: 5,
            height: 16,
            width: 16,
            ..Default::default()
        };
        assert!(header.layout().is_ok());
        header.version += 1;
        assert!(matches!(
            header.layout(),
            Err(FrameError::Version { version: 2, .. })
        ));
    }

    #[test]
    fn models_are_read_by_the_name_they_print() {
        for model in ModelId::ALL {
            assert_eq!(model.name().parse(), Ok(model));
            assert_eq!(ModelId::from_u32(model as u32), Some(model));
        }
        assert!("erunet".parse::<ModelId>().is_err());
    }
}

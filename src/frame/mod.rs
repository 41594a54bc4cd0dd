//! What crosses shared memory: bundles into the network, depth frames out of it.
//!
//! Everything here is plain old data with a fixed layout: any process built from the same version
//! reads it in place. Payloads are slices of 64-byte [`Block`]s, so every plane starts on a cache
//! line; headers travel beside them. [`FRAME_VERSION`] changes whenever a layout does.

mod error;
mod header;
mod layout;
mod model;

use bytemuck::{Pod, Zeroable};
use iceoryx2::prelude::ZeroCopySend;

pub use error::FrameError;
pub use header::{BundleHeader, DepthHeader, HostStages, InferStages, Lost, flag};
pub use layout::{BundleLayout, BundlePlanes, BundlePlanesMut, DepthLayout};
pub use model::ModelId;

/// Version of every layout in this module.
pub const FRAME_VERSION: u32 = 2;
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
            Err(FrameError::Version { version: 3, .. })
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

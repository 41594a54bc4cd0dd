//! What the network sees: events -> voxel grids, LiDAR returns -> sparse depth, image -> planes.
//!
//! Pure: nothing here opens a file, reads a clock or starts a thread. Everything is written into
//! the caller's memory, and memory is allocated by constructors only. The vehicle and training call
//! the same functions, so the two cannot see different things.
//!
//! | output | shape | unit | made by |
//! |---|---|---|---|
//! | voxels | `f32 [T, 5, H, W]` | signed event weight / 10, -1..=1 | [`VoxelRaster`] |
//! | sparse depth of a step | `f32 [H, W]` | metres along the camera's axis, 0: none | [`SparseRaster`] |
//! | image | `f32 [3, H, W]` | encoded value, 0..=1 | [`ImagePlanes`] |
//!
//! ```
//! use noctule_raster::{Exposure, Grid, PackedEvent, PixelMap, Rescale, VoxelRaster};
//!
//! # fn main() -> Result<(), noctule_raster::RasterError> {
//! let map = PixelMap::rescaled(&Rescale::identity(Grid::new(4, 4))?);
//! let raster = VoxelRaster::new(8, map)?;
//! let mut voxels = vec![0.0; raster.shape().len()];
//! let exposure = Exposure::from_micros(1000, 1800)?; // 100 us per step, 25 us from bin to bin
//! let event = PackedEvent::new(1105, 2, 1, true)?;
//! let tally = raster.raster(exposure, &[event], &mut voxels)?;
//! assert_eq!(tally.rastered, 1);
//! // Step 1, a fifth of the way from bin 0 to bin 1, cell (2, 1): 0.8 / 10, to a 256th.
//! assert!((voxels[(5 * 4 + 1) * 4 + 2] - 0.08).abs() < 0.1 / 512.0);
//! # Ok(())
//! # }
//! ```
#![forbid(unsafe_code)]
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "numeric code: every narrowing is bounded by a check or a comment beside it"
)]

mod error;
mod geometry;
mod image;
mod sparse;
mod voxels;

pub use error::RasterError;
pub use geometry::{Crop, Distortion, Grid, OUTSIDE, Pinhole, PixelMap, Rescale};
pub use image::{Encoding, EncodingTable, ImagePlanes, ImageView, Samples, UnknownEncoding};
pub use sparse::{
    AzimuthWindow, Channel, EgoMotion, EgoPolicy, Pass, PassCounts, PassPoint, PassTracker,
    PlanarMove, SparseConfig, SparseRaster, SparseReport,
};
pub use voxels::{
    BINS, EXPOSURE_US_MAX, EventHistory, Exposure, FinishReport, PackedEvent, Retimed, STEPS_MAX,
    Tally, VoxelRaster, VoxelShape,
};

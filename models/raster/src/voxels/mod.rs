//! Events -> voxel grids: signed, bilinear in time, integer until the last step.
//!
//! A grid holds `steps` slices of the exposure with [`BINS`] bins each, `f32 [T, B, H, W]`. An
//! event of polarity p at u = (t - start) / (end - start) * 4 of its step adds p * (1 - frac u) to
//! bin floor(u) and p * frac u to the next; the finished sum is clamped to -10..=10 and divided by
//! 10. Steps are half-open, so is the exposure.
//!
//! Weights are whole 256ths (u rounded to the nearest 1/256, so off by 1/512 of a bin at most, and
//! not to one side). That is the coarsest step the definition allows, on purpose: when the exposure
//! turns out a few microseconds longer than predicted, only events whose 256th changes have to be
//! moved. Sums are 32-bit integers kept in the output's own memory; integers add up to the same
//! whatever their order, so events may be rastered while the exposure is open, in any chunks, and
//! equal the two-pass raster bit for bit.

mod history;
mod raster;
mod retime;
mod sums;
mod tally;
mod timing;

pub use history::{EventHistory, PackedEvent};
pub use raster::{FinishReport, Retimed, VoxelRaster, VoxelShape};
pub use tally::Tally;
pub use timing::{BINS, EXPOSURE_US_MAX, Exposure, STEPS_MAX};

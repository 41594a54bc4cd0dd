//! LiDAR returns -> one sparse depth map per step, `f32 [H, W]`, metres along the camera's axis.
//!
//! The map of a step is the newest complete pass over the camera's field of view that ended before
//! the step's centre; every return is moved by the vehicle's own motion from its firing time to
//! that centre, projected, and the nearest one wins each pixel. 0 means no return. Things that
//! move on their own are not compensated.
//!
//! All times are TAI: the caller maps its clocks, nothing here does.

mod depth;
mod motion;
mod passes;
mod window;

pub use depth::{EgoPolicy, SparseConfig, SparseRaster, SparseReport};
pub use motion::{EgoMotion, PlanarMove};
pub use passes::{Pass, PassCounts, PassPoint, PassTracker};
pub use window::{AzimuthWindow, Channel};

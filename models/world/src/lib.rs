//! The synthetic night.
#![forbid(unsafe_code)]
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "pixel and sample arithmetic"
)]

mod approx;
mod camera;
mod chance;
mod events;
mod flare;
mod lidar;
mod object;
mod optics;
mod render;
mod rig;
mod ring_table;
mod road;
mod sample;
mod scene;
mod shutter;
mod snapshot;
mod street;
mod truth;

pub use camera::ELECTRONS_PER_SECOND;
pub use events::{EventSimulator, PixelModel};
pub use lidar::{Column, Echo, Scanner};
pub use object::CAMERA_HEIGHT_M;
pub use optics::{FIELD_OF_VIEW_DEG, Optics};
pub use render::{Frame, LUMA, render};
pub use rig::Mounting;
pub use road::{Pose, Progress, Road};
pub use sample::Sample;
pub use scene::Scene;
pub use shutter::{Opening, STEPS, Shutter, Tier, UnknownTier};
pub use snapshot::{GROUND, Horizon, SKY, Snapshot};
pub use truth::flow;

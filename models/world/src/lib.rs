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
mod drive;
mod error;
mod events;
mod faults;
mod flare;
mod lidar;
mod object;
mod optics;
mod render;
mod rig;
mod road;
mod sample;
mod scene;
mod shutter;
mod snapshot;
mod sparse;
mod street;
mod timeline;
mod truth;

pub use camera::ELECTRONS_PER_SECOND;
pub use drive::{DriveOptions, DriveProgress, DriveSummary, record_drive};
pub use error::WorldError;
pub use events::{EventSimulator, PixelModel};
pub use faults::Faults;
pub use lidar::{Column, Echo, Scanner};
pub use object::CAMERA_HEIGHT_M;
pub use optics::{FIELD_OF_VIEW_DEG, Optics};
pub use render::{Frame, LUMA, render};
pub use rig::{DRIVE_START_TAI, Jitter, Rig, RigClocks, TAI_OFFSET_S};
pub use road::{Pose, Progress, Road};
pub use sample::Sample;
pub use scene::Scene;
pub use shutter::{Opening, STEPS, Shutter, Tier, UnknownTier};
pub use snapshot::{GROUND, Horizon, SKY, Snapshot};
pub use timeline::{TimedExposure, TimedImage, TimedMotion, TimedPacket, TimedTransfer, Timeline};
pub use truth::flow;

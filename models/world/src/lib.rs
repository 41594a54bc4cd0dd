//! The synthetic night: seeded drives down a street, as real sensors would put them on the wire,
//! with exact truth.
//!
//! ```
//! use noctule_world::{Sample, Tier};
//!
//! let sample = Sample::render(101, Tier::A, 64);
//! assert_eq!(sample.blur.len(), 3 * 64 * 64);
//! assert_eq!(sample.depth.len(), 8 * 64 * 64);
//! ```
//!
//! Three ways in:
//!
//! - [`Sample::render`]: one exposure for training or evaluation, straight on the network's grid.
//! - [`record_drive`]: a whole drive as a recording directory: EVT 3.0, PandarQT64 datagrams,
//!   blurred pictures, CAN frames, arrivals, clocks, and the truth.
//! - [`Timeline::simulate`]: only the instants of such a drive, with every delay and fault.
//!
//! Everything is a pure function of a seed and time, the same bits with any number of threads.
//! [`Scene`] and [`Snapshot`] are the world, [`render()`] draws it in tiles, [`EventSimulator`],
//! [`Scanner`] and the camera look at it. There are no shadows, no light from surface to surface,
//! no lens distortion and no weather.
#![forbid(unsafe_code)]
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "pixel, channel and sample indices of bounded images and drives"
)]
#![allow(
    clippy::needless_range_loop,
    reason = "loops over lanes of several arrays read and vectorise best by index"
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

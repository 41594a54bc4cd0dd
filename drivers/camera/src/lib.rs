//! The long-exposure camera: what a frame's stamps mean, pixel formats, lost frames, settings.
//!
//! Pure: bytes and instants are passed in, pixels go into the caller's memory. Streaming from a
//! device is not done here.
#![forbid(unsafe_code)]

mod bayer;
mod config;
mod encoding;
mod pixel;
mod sequence;
mod stamp;

pub use config::{CameraConfig, ConfigError};
pub use encoding::Encoding;
pub use pixel::{ImageLayout, PixelError, PixelFormat};
pub use sequence::{SequenceCounts, SequenceMonitor};
pub use stamp::{FrameStamp, StampedAt};

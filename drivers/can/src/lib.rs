//! Vehicle motion from CAN frames by configurable signals.
//!
//! Frames, signals and the candump text format, each in both directions; bytes and instants are
//! passed in. Opening a CAN socket is not done here.
#![forbid(unsafe_code)]

mod candump;
mod config;
mod frame;
mod motion;
mod signal;

pub use candump::{Direction, Interface, LineError, Record};
pub use config::{ByteOrder, MotionConfig, SignalConfig};
pub use frame::{Frame, FrameError, FrameKind, Id};
pub use motion::{MotionCounts, MotionDecoder, MotionEncoder, MotionError};
pub use signal::{Signal, SignalError, ValueError, check_overlap};

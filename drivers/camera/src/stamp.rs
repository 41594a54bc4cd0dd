//! What is known about a frame besides its pixels.

use noctule_sensor::{Monotonic, Realtime, Stamp};
use serde::{Deserialize, Serialize};

/// Which instant of the exposure the driver's stamp marks (V4L2: `V4L2_BUF_FLAG_TSTAMP_SRC_SOE`
/// and `_EOF`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StampedAt {
    /// The shutter opened.
    StartOfExposure,
    /// The shutter closed (the first line was read out).
    EndOfExposure,
}

/// Stamps and settings of one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameStamp {
    /// The driver's frame counter; wraps at 2^32.
    pub sequence: u32,
    /// The driver's stamp.
    pub driver: Stamp<Monotonic>,
    /// Which instant `driver` marks.
    pub at: StampedAt,
    /// When the host had the whole frame.
    pub arrival: Stamp<Realtime>,
    /// Exposure the camera was set to, nanoseconds; the true one is between the strobe's edges.
    pub exposure_set_ns: u64,
    /// Sensor gain, decibels.
    pub gain_db: f32,
}

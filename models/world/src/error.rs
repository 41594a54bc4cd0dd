//! Why a drive could not be recorded.

use std::time::Duration;

/// Why a drive could not be recorded.
#[derive(Debug, thiserror::Error)]
pub enum WorldError {
    /// A drive too short or too long.
    #[error("drive of {0:?}, must last 0.1 to 1200 s")]
    Duration(Duration),
    /// A fault's probability that is none.
    #[error("fault {name} has probability {value}, must be 0 to 1")]
    Probability {
        /// Field of the faults.
        name: &'static str,
        /// What it was set to.
        value: f64,
    },
    /// A rig that cannot record.
    #[error("rig: {name} is {value}, must be {needed}")]
    Rig {
        /// Field of the rig.
        name: &'static str,
        /// What it was set to.
        value: u64,
        /// What it may be.
        needed: &'static str,
    },
    /// The recording could not be written.
    #[error(transparent)]
    Write(#[from] noctule_recording::WriteError),
    /// Events that do not fit the wire format.
    #[error("event camera: {0}")]
    Events(#[from] noctule_evk4::EncodeError),
    /// A LiDAR packet that does not fit the wire format.
    #[error("lidar: {0}")]
    Lidar(#[from] noctule_hesai::EncodeError),
    /// Motion that does not fit the bus's signals.
    #[error("can: {0}")]
    Can(#[from] noctule_can::MotionError),
    /// Sparse depth that cannot be drawn.
    #[error("sparse depth: {0}")]
    Raster(#[from] noctule_raster::RasterError),
}

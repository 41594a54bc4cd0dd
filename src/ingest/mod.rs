//! One thread per sensor: what a device (or a recording of one) delivers, decoded into lane blocks.
//!
//! Each loop is the same: take a delivery, promise that nothing earlier follows, hold it until it
//! is due, decode it into a leased block, push. A recording is held back by its pace; a device by
//! itself.

mod camera;
mod events;
mod lidar;
mod motion;
mod pace;

pub use camera::run as run_camera;
pub use events::run as run_events;
pub use lidar::run as run_lidar;
pub use motion::run as run_motion;
pub use pace::{Pace, Pacer};

use std::sync::atomic::AtomicBool;

use noctule_recording::{Faults, RecordingError};

use crate::lane::WhenFull;
use crate::latency::StreamRow;

/// How deliveries are let through.
#[derive(Debug, Clone, Copy)]
pub struct Flow<'a> {
    /// When each is due.
    pub pacer: Pacer,
    /// What to do when the host holds every block.
    pub when_full: WhenFull,
    /// Hands byte streams on in pieces of at most this many bytes; results must not depend on it.
    pub piece_bytes: Option<usize>,
    /// Ends the thread early.
    pub stop: &'a AtomicBool,
}

/// What a stream did, from start to end.
#[derive(Debug, Clone)]
pub struct Ingested {
    /// The totals.
    pub row: StreamRow,
    /// Further counts by name, those of faults among them.
    pub details: Vec<(&'static str, u64)>,
}

/// What a recording's files lack, by name; only what is not zero.
fn file_faults(faults: Faults) -> impl Iterator<Item = (&'static str, u64)> {
    [
        ("truncated_rows", faults.truncated_rows),
        ("truncated_bytes", faults.truncated_bytes),
        ("unlisted_bytes", faults.unlisted_bytes),
        ("absent_rows", faults.absent_rows),
    ]
    .into_iter()
    .filter(|(_, count)| *count > 0)
}

/// Why a stream ended before its time.
#[derive(Debug, thiserror::Error)]
pub enum IngestError {
    /// The recording cannot be read on.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// Settings that no decoder accepts.
    #[error("lidar: {0}")]
    Lidar(#[from] noctule_hesai::OptionsError),
    /// Signals that no decoder accepts.
    #[error("can: {0}")]
    Can(#[from] noctule_can::MotionError),
}

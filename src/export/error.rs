//! Why nothing was exported.

use std::io;
use std::path::{Path, PathBuf};

use noctule_depth::{DepthPngError, PictureError, PngError};
use noctule_recording::RecordingError;

use super::{Stream, Target};
use crate::inspect::InspectError;

/// Why an export was not made; the target is as it was before.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The source cannot be read.
    #[error(transparent)]
    Source(#[from] InspectError),
    /// A part of the recording that is to be exported cannot be read.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// A target of no known format.
    #[error(
        "{}: no format of that extension: events go to .csv or .npy, lidar to .csv or .pcd, depth \
         to .png or a folder", path.display()
    )]
    Extension {
        /// The target.
        path: PathBuf,
    },
    /// A format that does not hold that kind of data.
    #[error(
        "{}: {stream} cannot go to {target}: events go to .csv or .npy, lidar to .csv or .pcd, \
         depth to .png or a folder", path.display()
    )]
    Unsuitable {
        /// The target.
        path: PathBuf,
        /// Its format.
        target: Target,
        /// What was to go there.
        stream: Stream,
    },
    /// A recording, of which several streams could be meant.
    #[error("{}: a recording: say which stream, events, lidar or depth", path.display())]
    Ambiguous {
        /// The recording.
        path: PathBuf,
    },
    /// A file of one stream, asked for another.
    #[error("{}: holds {held}, not {asked}", path.display())]
    NoStream {
        /// The source.
        path: PathBuf,
        /// What it holds.
        held: Stream,
        /// What was asked for.
        asked: Stream,
    },
    /// A capture without a LiDAR.
    #[error("{}: no packet of a known lidar", path.display())]
    NoSensor {
        /// The capture.
        path: PathBuf,
    },
    /// A sweep that is not there.
    #[error("{}: no return in sweep {sweep}: the {sweeps} sweeps begin at 0", path.display())]
    NoSweep {
        /// The source.
        path: PathBuf,
        /// What was asked for.
        sweep: u32,
        /// Sweeps there are.
        sweeps: u64,
    },
    /// Nothing to draw.
    #[error("{}: holds no depth maps", path.display())]
    NoMaps {
        /// The source.
        path: PathBuf,
    },
    /// Several maps and one file.
    #[error("{}: {maps} depth maps need a folder to go to", path.display())]
    NeedsFolder {
        /// The target.
        path: PathBuf,
        /// Maps there are.
        maps: usize,
    },
    /// The target is the source.
    #[error("{}: would be written over itself", path.display())]
    Same {
        /// Both.
        path: PathBuf,
    },
    /// A depth map that cannot be read or written.
    #[error(transparent)]
    Depth(#[from] DepthPngError),
    /// A picture that cannot be written.
    #[error(transparent)]
    Png(#[from] PngError),
    /// A picture that cannot be made.
    #[error(transparent)]
    Picture(#[from] PictureError),
    /// The target cannot be written.
    #[error("{}: cannot write: {source}", path.display())]
    Output {
        /// The target.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
}

impl ExportError {
    pub(super) fn output(path: &Path) -> impl FnOnce(io::Error) -> Self {
        |source| Self::Output {
            path: path.to_owned(),
            source,
        }
    }
}

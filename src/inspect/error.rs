//! Why a file cannot be read, or not to its end.

use std::io;
use std::path::{Path, PathBuf};

use noctule_evk4::{OpenError, RawError};
use noctule_hesai::pcap::CaptureError;
use noctule_hesai::{OptionsError, TableError};
use noctule_recording::{Faults, RecordingError};

use super::recording::{EVENTS_FILE, LIDAR_FILE};

/// What is wrong with which file, and where in it.
///
/// Returned when nothing could be read, and listed as a fault when the part before could.
#[derive(Debug, thiserror::Error)]
pub enum InspectError {
    /// The file could not be opened or read on.
    #[error("{}: byte {offset}: cannot read: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// How far it was read.
        offset: u64,
        /// What the system said.
        source: io::Error,
    },
    /// A file of no bytes.
    #[error("{}: byte 0: the file is empty", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// A file that begins like nothing known.
    #[error(
        "{}: byte 0: begins with {}, which is neither a RAW header (\"%\"), pcap nor pcapng",
        path.display(), found.escape_ascii()
    )]
    Unknown {
        /// The file.
        path: PathBuf,
        /// Its first bytes, at most four.
        found: Vec<u8>,
    },
    /// A directory that is no recording.
    #[error("{}: has no meta.json, so it is no recording", path.display())]
    NoRecording {
        /// The directory.
        path: PathBuf,
    },
    /// A RAW header that cannot be understood.
    #[error("{}: byte 0: {source}", path.display())]
    RawHeader {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: RawError,
    },
    /// A RAW file that ends inside a word.
    #[error("{}: byte {offset}: file ends after {bytes} bytes of a word", path.display())]
    RawTrailing {
        /// The file.
        path: PathBuf,
        /// Where the word begins.
        offset: u64,
        /// Bytes of it that are there.
        bytes: u64,
    },
    /// A packet capture that cannot be read on.
    #[error("{}: {source}", path.display())]
    Capture {
        /// The file.
        path: PathBuf,
        /// What is wrong with it, and at which byte.
        source: CaptureError,
    },
    /// An angle or fire-time table that cannot be used.
    #[error("{}: {source}", path.display())]
    Table {
        /// The table.
        path: PathBuf,
        /// What is wrong with it, and in which line.
        source: TableError,
    },
    /// Tables that do not fit the sensor.
    #[error("{}: {source}", path.display())]
    Options {
        /// The capture.
        path: PathBuf,
        /// What does not fit.
        source: OptionsError,
    },
    /// A recording, or a part of it, that cannot be read.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// A stream of a recording that lacks something.
    #[error(
        "{}: cut off or incomplete: {} rows and {} bytes cut off, {} bytes in no row, {} rows \
         counted and absent",
        path.display(), faults.truncated_rows, faults.truncated_bytes, faults.unlisted_bytes,
        faults.absent_rows
    )]
    Stream {
        /// The stream's file.
        path: PathBuf,
        /// What it lacks.
        faults: Faults,
    },
}

impl InspectError {
    /// Reading failed after `offset` bytes.
    pub(crate) fn io(path: &Path, offset: u64) -> impl FnOnce(io::Error) -> Self {
        move |source| Self::Io {
            path: path.to_owned(),
            offset,
            source,
        }
    }

    /// What a stream of the recording in `dir` lacks, if anything.
    pub(super) fn stream(dir: &Path, file: &str, faults: Faults) -> Option<Self> {
        let path = dir.join(file);
        (!faults.is_clean()).then_some(Self::Stream { path, faults })
    }

    /// What the event stream of the recording in `dir` lacks, if anything.
    pub(crate) fn of_events(dir: &Path, faults: Faults) -> Option<Self> {
        Self::stream(dir, EVENTS_FILE, faults)
    }

    /// What the LiDAR capture of the recording in `dir` lacks, if anything.
    pub(crate) fn of_lidar(dir: &Path, faults: Faults) -> Option<Self> {
        Self::stream(dir, LIDAR_FILE, faults)
    }

    /// The capture ends early or cannot be understood.
    pub(crate) fn capture(path: &Path) -> impl FnOnce(CaptureError) -> Self {
        |source| Self::Capture {
            path: path.to_owned(),
            source,
        }
    }

    /// A RAW file could not be opened.
    pub(crate) fn open_raw(path: &Path) -> impl FnOnce(OpenError) -> Self {
        |error| match error {
            OpenError::Io(source) => Self::io(path, 0)(source),
            OpenError::Header(source) => Self::RawHeader {
                path: path.to_owned(),
                source,
            },
        }
    }
}

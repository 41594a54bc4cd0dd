//! Why a file of a data set could not be read; every error names the file.

use std::io;
use std::path::{Path, PathBuf};

use noctule_depth::{DepthPngError, PngError};
use thiserror::Error;

/// What is wrong with a data set.
#[derive(Debug, Error)]
pub enum ReadError {
    /// A file or folder could not be read.
    #[error("{}: {source}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A folder or file lacks what its layout demands.
    #[error("{}: has no {wanted}", path.display())]
    Missing {
        /// Where it was looked for.
        path: PathBuf,
        /// What was looked for.
        wanted: String,
    },
    /// A file is longer than such files are.
    #[error("{}: {len} bytes, at most {max} are read", path.display())]
    Long {
        /// Which.
        path: PathBuf,
        /// Its length.
        len: u64,
        /// The longest that is read.
        max: u64,
    },
    /// A file does not hold what its name says.
    #[error("{}: {fault}", path.display())]
    Content {
        /// Which.
        path: PathBuf,
        /// What is wrong with it, values included.
        fault: String,
    },
    /// A picture is damaged or of another kind; the error names it.
    #[error(transparent)]
    Picture(#[from] PngError),
    /// A depth map is damaged or of another kind; the error names it.
    #[error(transparent)]
    Depth(#[from] DepthPngError),
}

impl ReadError {
    pub(super) fn content(path: &Path, fault: impl Into<String>) -> Self {
        Self::Content {
            path: path.into(),
            fault: fault.into(),
        }
    }

    pub(super) fn missing(path: &Path, wanted: impl Into<String>) -> Self {
        Self::Missing {
            path: path.into(),
            wanted: wanted.into(),
        }
    }

    pub(super) fn in_file(path: &Path) -> impl FnOnce(io::Error) -> Self {
        |source| Self::File {
            path: path.into(),
            source,
        }
    }
}

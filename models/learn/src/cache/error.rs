//! What can be wrong with cached examples.

use std::io;
use std::path::PathBuf;

use noctule_raster::RasterError;
use thiserror::Error;

use crate::read::ReadError;

/// Why examples could not be made, kept or read.
#[derive(Debug, Error)]
pub enum CacheError {
    /// A file or folder could not be read or written.
    #[error("{}: {source}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A file is no shard of this cache.
    #[error("{}: {fault}", path.display())]
    Shard {
        /// Which.
        path: PathBuf,
        /// What is wrong with it.
        fault: String,
    },
    /// Real drives could not be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// Real drives are not what they are asked for.
    #[error("{drive}: {fault}")]
    Drive {
        /// Which, or where it was looked for.
        drive: String,
        /// What is wrong, values included.
        fault: String,
    },
    /// A sample's events do not fit the raster.
    #[error("seed {seed} of tier {tier}: {source}")]
    Raster {
        /// The drive's seed.
        seed: u64,
        /// Its tier's letter.
        tier: char,
        /// What the raster said.
        source: RasterError,
    },
    /// The grid is too large for packed events, or no multiple of 16.
    #[error("sample size is {0} pixels, wanted a multiple of 16 from 16 to 256")]
    Size(usize),
    /// The work was interrupted; what is finished stays.
    #[error("interrupted")]
    Interrupted,
}

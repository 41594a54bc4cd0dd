//! Why a frame cannot be read.

use super::FRAME_VERSION;

/// Why a frame cannot be read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FrameError {
    /// Written by something else, or by another version.
    #[error(
        "header has magic {magic:#010x} and version {version}, this program reads version {FRAME_VERSION}"
    )]
    Version {
        /// As read.
        magic: u32,
        /// As read.
        version: u32,
    },
    /// Dimensions no layout allows.
    #[error("{what} is {value}, allowed is {allowed}")]
    Dimension {
        /// Which one.
        what: &'static str,
        /// As asked.
        value: u32,
        /// In words.
        allowed: &'static str,
    },
    /// A payload of the wrong size.
    #[error("payload has {actual} blocks, the layout needs {needed}")]
    Length {
        /// Blocks the layout needs.
        needed: usize,
        /// Blocks there are.
        actual: usize,
    },
    /// Not the name of a model.
    #[error("unknown model '{0}': one of nearest, fill, xs, s, full")]
    UnknownModel(String),
}

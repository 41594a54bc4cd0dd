//! What the readers of HDF5 say in a build without them.

use std::path::Path;

use noctule_depth::{Canvas, DepthImage};

use super::error::ReadError;

/// Always an error, which says what to do.
///
/// # Errors
/// [`ReadError`], naming the file.
pub fn nyu_test_frames(splits: &Path) -> Result<Vec<u32>, ReadError> {
    Err(not_read(splits))
}

/// Always an error, which says what to do.
///
/// # Errors
/// [`ReadError`], naming the file.
pub fn read_nyu_labelled(path: &Path, _: u32) -> Result<(Canvas, DepthImage), ReadError> {
    Err(not_read(path))
}

/// Always an error, which says what to do.
///
/// # Errors
/// [`ReadError`], naming the file.
pub fn read_nyu_still(path: &Path) -> Result<(Canvas, DepthImage), ReadError> {
    Err(not_read(path))
}

fn not_read(path: &Path) -> ReadError {
    let fault = "is read by builds with the feature hdf5 alone: build with it, or convert to \
        SCENE/r-TIME-COUNT.ppm (P6) and SCENE/d-TIME-COUNT.pgm (P5 of 16 bits, raw disparity, low \
        byte first)";
    ReadError::content(path, fault)
}

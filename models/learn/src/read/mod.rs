//! Readers of public data sets in the layouts they are published in.
//!
//! Bytes of files are not trusted: what does not fit is an error that names the file and what is
//! wrong with it. Nothing here writes, downloads or converts.

mod benchmark;
mod calibration;
mod drive;
mod error;
mod files;
mod netpbm;
mod nyu;
#[cfg(feature = "hdf5")]
mod nyu_labelled;
mod nyu_register;
#[cfg(feature = "hdf5")]
mod nyu_still;
mod rgbd;
mod rings;
mod selection;
mod velodyne;
mod window;
#[cfg(not(feature = "hdf5"))]
mod without_hdf5;

pub use benchmark::{BenchmarkDrive, Split, benchmark_drives};
pub use calibration::{Calibration, ColourCamera, Projected};
pub use drive::{Drive, is_validation_drive, raw_drives};
pub use error::ReadError;
pub use nyu::{NyuLayout, NyuPair, nyu_pairs};
#[cfg(feature = "hdf5")]
pub use nyu_labelled::{nyu_test_frames, read_nyu_labelled};
pub(crate) use nyu_register::registered;
#[cfg(feature = "hdf5")]
pub use nyu_still::read_nyu_still;
pub use rgbd::{RgbdFrame, rgbd_frames, rgbd_sequences};
pub use rings::{RINGS, rings_by_elevation, rings_by_order};
pub use selection::{SelectedFrame, Selection};
pub use velodyne::{ScanPoint, read_scan, sparse_depth};
pub use window::{BENCHMARK_HEIGHT, BENCHMARK_WIDTH, Window};
#[cfg(not(feature = "hdf5"))]
pub use without_hdf5::{nyu_test_frames, read_nyu_labelled, read_nyu_still};

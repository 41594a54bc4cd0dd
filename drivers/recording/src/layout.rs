//! Where each file of a recording is, and the columns of its tables. `FORMAT.md` explains them.

use std::path::{Path, PathBuf};

pub(crate) const META: &str = "meta.json";
pub(crate) const CALIBRATION: &str = "calib.toml";
pub(crate) const RAW: &str = "raw";
pub(crate) const EVENTS: &str = "raw/events.raw";
pub(crate) const EVENT_TRANSFERS: &str = "raw/events.csv";
pub(crate) const LIDAR: &str = "raw/lidar.pcap";
pub(crate) const IMAGES: &str = "raw/rgb";
pub(crate) const IMAGE_ROWS: &str = "raw/rgb.csv";
pub(crate) const CAN: &str = "raw/can.log";
pub(crate) const CLOCKS: &str = "raw/clocks.csv";
pub(crate) const TRUTH: &str = "truth";
pub(crate) const TRUTH_EXPOSURES: &str = "truth/exposures.csv";
pub(crate) const TRUTH_CLOCKS: &str = "truth/clocks.toml";
pub(crate) const DERIVED: &str = "derived";

pub(crate) const EVENT_TRANSFER_COLUMNS: &[&str] =
    &["byte_offset", "length", "arrival_realtime_ns"];
pub(crate) const IMAGE_COLUMNS: &[&str] = &[
    "index",
    "sequence",
    "driver_stamp_ns",
    "driver_clock",
    "stamped_at",
    "arrival_realtime_ns",
    "exposure_set_ns",
    "gain_db",
];
pub(crate) const CLOCK_COLUMNS: &[&str] =
    &["realtime_ns", "monotonic_ns", "tai_offset_s", "phc_ns"];
pub(crate) const EXPOSURE_COLUMNS: &[&str] = &[
    "index",
    "open_tai_ns",
    "close_tai_ns",
    "open_evk4_ns",
    "close_evk4_ns",
    "image_sequence",
    "image_dropped",
    "open_edge",
    "close_edge",
];

/// Most bytes of one transfer; a corrupt length never asks for more memory than this.
pub(crate) const TRANSFER_LEN_MAX: usize = 64 << 20;

/// Image `index` of the recording in `dir`.
pub(crate) fn image(dir: &Path, index: u32) -> PathBuf {
    dir.join(IMAGES).join(format!("{index:06}.png"))
}

/// The folder of derived sample `index`.
pub(crate) fn sample(dir: &Path, index: u32) -> PathBuf {
    dir.join(DERIVED).join(format!("{index:06}"))
}

//! Exposures: from strobe edges, with their images; or made up where there is no strobe.

mod exposure;
mod rhythm;
mod strobe;
mod tracker;
mod virtual_exposure;

pub use exposure::{
    DiscardReason, Exposure, ExposureCounts, ExposureEvent, ExposureFlags, ImageStamp,
    LeftOutReason, StampedAt, StrobePair,
};
pub use strobe::StrobeConfig;
pub use tracker::{ExposureTracker, ImageMap, TrackerConfig};
pub use virtual_exposure::{PeriodicExposures, VirtualExposures};

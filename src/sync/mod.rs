//! Joins what the sensors deliver in time: clock maps, exposures, bundles.
//!
//! Pure: instants in, decisions out. Nothing here reads a clock, does I/O, starts a thread or
//! allocates after construction; the same inputs in the same order give the same decisions.

mod bundle;
mod clocks;
mod exposures;

pub use bundle::{
    BundleCloser, BundleConfig, BundleCounts, BundleDecision, ClosedBy, Stream, Streams,
};
pub use clocks::{
    ClockReading, EnvelopeConfig, EnvelopeFit, EpochCause, FitCounts, HostClocks, MapSource,
    Observation, PairedConfig, PairedFit, RateEstimate, SensorClock, Timeline, TimelineConfig,
    TimelineCounts,
};
pub use exposures::{
    DiscardReason, Exposure, ExposureCounts, ExposureEvent, ExposureFlags, ExposureTracker,
    ImageMap, ImageStamp, LeftOutReason, PeriodicExposures, StampedAt, StrobeConfig, StrobePair,
    TrackerConfig, VirtualExposures,
};

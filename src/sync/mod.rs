//! Joins what the sensors deliver in time: clock maps, exposures, bundles.
//!
//! Pure: instants in, decisions out. Nothing here reads a clock, does I/O, starts a thread or
//! allocates after construction; the same inputs in the same order give the same decisions.
//!
//! A host takes its inputs in order of (arrival, stream) and hands each to three machines:
//!
//! - [`Timeline`] learns from every arrival and every strobe pair how the clocks relate, and says
//!   when one of them is no longer the clock it was ([`Observation::NewEpoch`]).
//! - [`ExposureTracker`] turns strobe edges and image stamps into [`ExposureEvent`]s. On a new
//!   epoch of the event camera it must be told ([`ExposureTracker::clock_changed`]); the pairs in
//!   its `Imaged` events go back to [`Timeline::strobe_pair`]. Without a strobe,
//!   [`VirtualExposures`] or [`PeriodicExposures`] speak in its place.
//! - [`BundleCloser`] hears those events, the watermarks of all streams and their losses, and
//!   closes one [`BundleDecision`] per exposure, complete or at its deadline.
//!
//! Stamps of a stream whose last observation was `Suspect` or `Late` are not used as watermarks.

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

//! What a host did, from start to end.

use serde::Serialize;

use crate::latency::{StageRow, StreamRow};

/// Bundles by how they went out.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct BundleReport {
    /// Exposures announced.
    pub exposures: u64,
    /// Exposures that came to nothing.
    pub discarded: u64,
    /// Bundles sent.
    pub sent: u64,
    /// Of those, complete.
    pub complete: u64,
    /// Of those, partial.
    pub partial: u64,
    /// Closed by their deadline.
    pub by_deadline: u64,
    /// Exposures for which no memory could be lent.
    pub without_memory: u64,
    /// Images attached to an exposure.
    pub images_matched: u64,
    /// Images that belong to no exposure or whose exposure is in doubt.
    pub images_left_out: u64,
    /// Strobe edges put back.
    pub edges_repaired: u64,
}

/// How exposures were rastered.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct RasterReport {
    /// The predicted width was right.
    pub exact: u64,
    /// It was a little off: events were moved.
    pub delta: u64,
    /// It was far off, or the exposure was not open when its events came: rastered again.
    pub full: u64,
    /// Events rastered.
    pub events: u64,
    /// Events of exposures that had left the history too early.
    pub events_forgotten: u64,
    /// Steps without any LiDAR pass.
    pub steps_without_pass: u64,
    /// Steps whose returns could not be moved for want of motion.
    pub steps_without_motion: u64,
}

/// Everything a host reports.
#[derive(Debug, Clone, Default, Serialize)]
pub struct HostReport {
    /// Per sensor: offered, received, lost.
    pub streams: Vec<StreamRow>,
    /// Per sensor: further counts by name.
    pub details: std::collections::BTreeMap<String, std::collections::BTreeMap<String, u64>>,
    /// Bundles.
    pub bundles: BundleReport,
    /// Rasters.
    pub raster: RasterReport,
    /// Latencies inside the host.
    pub stages: Vec<StageRow>,
    /// Clock epochs opened per clock: host, evk4, lidar, strobe pairs.
    pub epochs: [u32; 4],
    /// Claimed 99 % bound on event times at the end, nanoseconds, if a map exists.
    pub evk4_uncertainty_ns: Option<u64>,
    /// Claimed 99 % bound on LiDAR times at the end, nanoseconds, if a map exists.
    pub lidar_uncertainty_ns: Option<u64>,
}

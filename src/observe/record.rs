//! What an observer keeps of a run.

use std::collections::BTreeMap;

use crate::digest::RunDigest;
use crate::frame::{BundleHeader, BundleLayout, BundlePlanes, DepthHeader};
use crate::latency::Latency;

/// One exposure with everything that a picture or a score needs.
#[derive(Debug, Clone)]
pub struct Kept {
    /// The bundle's header.
    pub header: BundleHeader,
    /// Image planes `[3, H, W]`.
    pub image: Vec<f32>,
    /// Event sums over all bins, per step: `[T, H, W]`.
    pub events: Vec<f32>,
    /// Sparse depth `[T, H, W]`, metres.
    pub sparse: Vec<f32>,
    /// Depth maps by step, metres, with the header each came with.
    pub depth: BTreeMap<u32, (DepthHeader, Vec<f32>)>,
}

impl Kept {
    pub(super) fn new(
        header: BundleHeader,
        layout: &BundleLayout,
        planes: &BundlePlanes<'_>,
    ) -> Self {
        let plane = layout.plane();
        let mut events = vec![0.0; layout.steps * plane];
        for (sum, bins) in events
            .chunks_exact_mut(plane)
            .zip(planes.voxels.chunks_exact(layout.bins * plane))
        {
            for bin in bins.chunks_exact(plane) {
                sum.iter_mut()
                    .zip(bin)
                    .for_each(|(sum, value)| *sum += value);
            }
        }
        Self {
            header,
            image: planes.image.to_vec(),
            events,
            sparse: planes.sparse.to_vec(),
            depth: BTreeMap::new(),
        }
    }
}

/// Everything seen.
#[derive(Debug, Default)]
pub struct Observed {
    /// Bundles seen.
    pub bundles: u64,
    /// Bundles sent and not seen.
    pub bundles_lost: u64,
    /// Depth frames seen.
    pub frames: u64,
    /// Depth frames sent and not seen.
    pub frames_lost: u64,
    /// Frames sent after their deadline.
    pub frames_late: u64,
    /// Sequences of which every step was seen.
    pub sequences_complete: u64,
    /// Sequences of which at least one step was seen.
    pub sequences_begun: u64,
    /// Bundle sent to bundle taken by inference.
    pub bundle_hop: Latency,
    /// Sequence begun to first depth done.
    pub first_step: Latency,
    /// Closing edge received to first depth sent.
    pub close_to_first: Latency,
    /// Closing edge received to last depth sent.
    pub close_to_last: Latency,
    /// Depth sent to depth seen here.
    pub depth_hop: Latency,
    /// Digest of all frames.
    pub digest: RunDigest,
    /// Exposures kept for pictures and scores, by sequence.
    pub kept: BTreeMap<u64, Kept>,
    /// Exposures seen and not kept, for want of room.
    pub not_kept: u64,
}

//! The report a run ends with, as JSON and as text.

use std::fmt::Write as _;

use serde::Serialize;

use super::host::Prepared;
use crate::digest::FrameDigest;
use crate::host::HostReport;
use crate::infer::InferReport;
use crate::ingest::Pace;
use crate::latency::{StageRow, table_of_stages, table_of_streams};
use crate::observe::{Observed, Scores};

/// Everything a run has to say.
#[derive(Debug, Clone, Serialize)]
pub struct RunReport {
    /// The recording.
    pub recording: String,
    /// What it lacks.
    pub missing: Vec<String>,
    /// How fast it was let through: recorded seconds per second, absent for as fast as possible.
    pub pace: Option<f64>,
    /// The host.
    pub host: HostReport,
    /// The inference process, over all its lives.
    pub infer: InferReport,
    /// How often it was started again.
    pub infer_restarts: u32,
    /// All stages, from the closing edge to the last depth map.
    pub stages: Vec<StageRow>,
    /// Bundles whose last depth map was late or never came.
    pub deadline_misses: u64,
    /// Depth against truth, where there is truth.
    pub scores: Option<Scores>,
    /// Digest of every bundle and depth map.
    pub digest: String,
    /// Every frame's own digest.
    pub frames: Vec<FrameDigest>,
    /// Files left in shared memory and temporary folders.
    pub residue: usize,
}

impl RunReport {
    /// Puts the parts together.
    #[must_use]
    pub fn new(
        prepared: &Prepared,
        pace: Pace,
        host: HostReport,
        infer: InferReport,
        infer_restarts: u32,
        observed: &Observed,
        residue: usize,
    ) -> Self {
        let sent = host.bundles.sent;
        let mut stages = host.stages.clone();
        let taken = infer.bundles_received.min(sent);
        stages.push(StageRow::new(
            "bundle sent -> taken",
            sent,
            taken,
            &observed.bundle_hop,
        ));
        stages.push(StageRow::new(
            "taken -> first depth",
            sent,
            observed.sequences_begun,
            &observed.first_step,
        ));
        stages.push(StageRow::new(
            "close -> first depth",
            sent,
            observed.sequences_begun,
            &observed.close_to_first,
        ));
        stages.push(StageRow::new(
            "close -> last depth",
            sent,
            observed.sequences_complete,
            &observed.close_to_last,
        ));
        stages.push(StageRow::new(
            "depth sent -> received",
            infer.frames_sent.max(observed.frames),
            observed.frames,
            &observed.depth_hop,
        ));
        Self {
            recording: prepared.recording().path().display().to_string(),
            missing: prepared.missing(),
            pace: match pace {
                Pace::Max => None,
                Pace::Speed(speed) => Some(speed),
            },
            deadline_misses: sent.saturating_sub(observed.sequences_complete)
                + observed.frames_late.min(observed.sequences_complete),
            stages,
            scores: None,
            digest: observed.digest.finish(),
            frames: observed.digest.frames(),
            host,
            infer,
            infer_restarts,
            residue,
        }
    }

    /// The report for reading.
    #[must_use]
    pub fn text(&self) -> String {
        let mut text = String::new();
        let host = &self.host;
        let _ = writeln!(text, "recording {}", self.recording);
        if !self.missing.is_empty() {
            let _ = writeln!(text, "without: {}", self.missing.join("; "));
        }
        let _ = writeln!(text, "\n{}", table_of_streams(&host.streams));
        if self.pace.is_none() {
            let _ = writeln!(
                text,
                "as fast as possible: latencies include the wait in full lanes"
            );
        }
        let _ = writeln!(text, "{}", table_of_stages(&self.stages));
        let b = &host.bundles;
        let _ = writeln!(
            text,
            "bundles: {} exposures, {} discarded, {} sent ({} complete, {} partial, {} by \
             deadline), {} without memory; images: {} matched, {} left out; edges put back: {}",
            b.exposures,
            b.discarded,
            b.sent,
            b.complete,
            b.partial,
            b.by_deadline,
            b.without_memory,
            b.images_matched,
            b.images_left_out,
            b.edges_repaired,
        );
        let r = &host.raster;
        let _ = writeln!(
            text,
            "rasters: {} exact, {} moved a little, {} again; {} events, {} forgotten; steps without \
             LiDAR pass: {}, without motion: {}",
            r.exact,
            r.delta,
            r.full,
            r.events,
            r.events_forgotten,
            r.steps_without_pass,
            r.steps_without_motion,
        );
        let i = &self.infer;
        let models: Vec<String> = i
            .models
            .iter()
            .map(|m| format!("{} x {}", m.frames, m.model))
            .collect();
        let _ = writeln!(
            text,
            "inference: {} bundles taken, {} stale, {} lost; {} depth maps ({}), {} late; {} \
             sequences stepped down, {} ended early; started again {} times",
            i.bundles_received,
            i.bundles_stale,
            i.bundles_lost,
            i.frames_sent,
            models.join(", "),
            i.frames_late,
            i.sequences_stepped_down,
            i.sequences_ended_early,
            self.infer_restarts,
        );
        if let Some(rows_down) = i.road_rows_down() {
            let _ = writeln!(
                text,
                "road: seen in {} sequences, {:.1} rows {} than calibrated in the mean",
                i.roads_seen,
                rows_down.abs(),
                if rows_down < 0.0 { "higher" } else { "lower" },
            );
        }
        let bound = |ns: Option<u64>| {
            #[expect(clippy::cast_precision_loss, reason = "shown with one decimal")]
            ns.map_or_else(
                || "unknown".to_owned(),
                |ns| format!("{:.1} us", ns as f64 / 1e3),
            )
        };
        let _ = writeln!(
            text,
            "clocks: event times within {}, LiDAR times within {}; epochs opened {:?}",
            bound(host.evk4_uncertainty_ns),
            bound(host.lidar_uncertainty_ns),
            host.epochs,
        );
        let _ = writeln!(text, "deadline misses: {}", self.deadline_misses);
        if let Some(scores) = &self.scores {
            text.push_str(&table_of_scores(scores));
        }
        let _ = writeln!(text, "digest {}", self.digest);
        text
    }
}

fn table_of_scores(scores: &Scores) -> String {
    let mut text = format!(
        "\ndepth against truth, {} exposures ({} kept without truth)\n{:<22} {:>6} {:>9} {:>9} \
         {:>9} {:>8} {:>7} {:>9}\n",
        scores.exposures,
        scores.without_truth,
        "method",
        "maps",
        "RMSE mm",
        "MAE mm",
        "iRMSE/km",
        "REL",
        "d1 %",
        "edge MAE",
    );
    for row in &scores.methods {
        let _ = writeln!(
            text,
            "{:<22} {:>6} {:>9.0} {:>9.0} {:>9.2} {:>8.4} {:>7.2} {:>9.0}",
            row.method,
            row.maps,
            row.rmse_mm,
            row.mae_mm,
            row.irmse_per_km,
            row.rel,
            row.delta1_pct,
            row.edge_mae_mm,
        );
    }
    text
}

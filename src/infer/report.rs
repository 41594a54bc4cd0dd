//! What an inference process did, handed to whoever started it.

use noctule_depth::HORIZON_ROWS_STEP;
use serde::{Deserialize, Serialize};

/// How often a model ran.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ModelCount {
    /// Its name.
    pub model: String,
    /// Sequences it began.
    pub sequences: u64,
    /// Depth frames it made.
    pub frames: u64,
}

/// Counts of one inference process, from start to end.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct InferReport {
    /// Bundles taken off the bus.
    pub bundles_received: u64,
    /// Bundles overwritten on the bus before they were taken.
    pub bundles_lost: u64,
    /// Bundles passed over because a newer one was there or the deadline could not be met.
    pub bundles_stale: u64,
    /// Bundles refused because another version wrote them.
    pub bundles_refused: u64,
    /// Sequences that went on with a cheaper model.
    pub sequences_stepped_down: u64,
    /// Sequences that ended before their last step.
    pub sequences_ended_early: u64,
    /// Depth frames sent.
    pub frames_sent: u64,
    /// Depth frames sent after their deadline.
    pub frames_late: u64,
    /// Sequences in whose first map returns said where the road lies.
    pub roads_seen: u64,
    /// By how many half rows it lay lower than the calibration says, added up over them.
    pub road_half_rows_down: i64,
    /// By model.
    pub models: Vec<ModelCount>,
}

impl InferReport {
    /// The counter of `model`.
    pub(super) fn model(&mut self, model: &str) -> &mut ModelCount {
        let index = match self.models.iter().position(|m| m.model == model) {
            Some(index) => index,
            None => {
                self.models.push(ModelCount {
                    model: model.to_owned(),
                    sequences: 0,
                    frames: 0,
                });
                self.models.len() - 1
            }
        };
        &mut self.models[index]
    }

    /// Takes note of a road that lies so many rows lower than the calibration says.
    pub(super) fn road(&mut self, rows_down: f32) {
        self.roads_seen += 1;
        #[expect(
            clippy::cast_possible_truncation,
            reason = "found to half a row, within ten"
        )]
        let half_rows = (rows_down / HORIZON_ROWS_STEP).round() as i64;
        self.road_half_rows_down += half_rows;
    }

    /// By how many rows the road lay lower than the calibration says, in the mean; `None` where it was
    /// never seen. Far from 0 over a drive, the camera's pitch is not what the calibration says.
    #[expect(clippy::cast_precision_loss, reason = "shown with one decimal")]
    pub fn road_rows_down(&self) -> Option<f64> {
        let rows = self.road_half_rows_down as f64 * f64::from(HORIZON_ROWS_STEP);
        (self.roads_seen > 0).then(|| rows / self.roads_seen as f64)
    }

    /// Adds what a process started in another's place did.
    pub fn add(&mut self, other: &Self) {
        self.bundles_received += other.bundles_received;
        self.bundles_lost += other.bundles_lost;
        self.bundles_stale += other.bundles_stale;
        self.bundles_refused += other.bundles_refused;
        self.sequences_stepped_down += other.sequences_stepped_down;
        self.sequences_ended_early += other.sequences_ended_early;
        self.frames_sent += other.frames_sent;
        self.frames_late += other.frames_late;
        self.roads_seen += other.roads_seen;
        self.road_half_rows_down += other.road_half_rows_down;
        for theirs in &other.models {
            let ours = self.model(&theirs.model);
            ours.sequences += theirs.sequences;
            ours.frames += theirs.frames;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn roads_are_averaged_over_all_lives_of_the_process() {
        let mut report = InferReport::default();
        assert_eq!(report.road_rows_down(), None);
        for rows in [2.5, -0.5, 1.0] {
            report.road(rows);
        }
        assert_eq!(report.road_rows_down(), Some(1.0));
        let mut next = InferReport::default();
        next.road(-3.0);
        report.add(&next);
        assert_eq!((report.roads_seen, report.road_rows_down()), (4, Some(0.0)));
    }
}

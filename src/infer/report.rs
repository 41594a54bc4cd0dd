//! What an inference process did, handed to whoever started it.

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
        for theirs in &other.models {
            let ours = self.model(&theirs.model);
            ours.sequences += theirs.sequences;
            ours.frames += theirs.frames;
        }
    }
}

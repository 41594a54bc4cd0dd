//! How much shared memory the channels may take.

use crate::frame::Block;

/// Bounds of one channel. Memory is `receivers * (queue + held) + loans` samples per sender.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ChannelLimits {
    /// Blocks in a sample.
    pub blocks: usize,
    /// Receivers at once.
    pub receivers: usize,
    /// Samples queued per receiver; when full, the oldest is overwritten.
    pub queue: usize,
    /// Samples a receiver may hold at once.
    pub held: usize,
    /// Samples a sender may have on loan at once.
    pub loans: usize,
}

impl ChannelLimits {
    /// Samples that one sender allocates.
    #[must_use]
    pub fn samples(&self) -> usize {
        self.receivers * (self.queue + self.held) + self.loans
    }

    pub(super) fn bytes(&self) -> u64 {
        (self.samples() * self.blocks * size_of::<Block>()) as u64
    }
}

/// Bounds of both channels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Host to inference.
    pub bundle: ChannelLimits,
    /// Inference to everyone.
    pub depth: ChannelLimits,
}

impl Limits {
    /// Bounds for payloads of these sizes: inference and one observer beside it.
    #[must_use]
    pub fn new(bundle_blocks: usize, depth_blocks: usize) -> Self {
        Self {
            bundle: ChannelLimits {
                blocks: bundle_blocks,
                receivers: 2,
                queue: 2,
                held: 2,
                loans: 4,
            },
            // Two whole sequences of eight and the start of a third.
            depth: ChannelLimits {
                blocks: depth_blocks,
                receivers: 3,
                queue: 20,
                held: 2,
                loans: 2,
            },
        }
    }
}

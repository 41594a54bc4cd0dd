//! What a decoder has seen so far.

use super::PacketError;

/// Rejected datagrams by kind.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Rejected {
    kinds: [u64; PacketError::KINDS.len()],
}

impl Rejected {
    /// Counts one.
    pub fn add(&mut self, error: &PacketError) {
        self.kinds[error.kind()] += 1;
    }

    /// Adds what `other` counted.
    pub fn merge(&mut self, other: &Self) {
        for (mine, theirs) in self.kinds.iter_mut().zip(other.kinds) {
            *mine += theirs;
        }
    }

    /// All kinds together.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.kinds.iter().sum()
    }

    /// The kinds that occurred, by the key reports use, and how often.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, u64)> + '_ {
        let all = PacketError::KINDS.into_iter().zip(self.kinds);
        all.filter(|&(_, count)| count > 0)
    }
}

/// Totals since the decoder was made; every datagram is in `packets` or in `rejected`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counts {
    /// Valid packets, duplicates among them.
    pub packets: u64,
    /// Non-zero returns of all blocks; those of duplicates are not counted again.
    pub returns: u64,
    /// Non-zero returns with equal ones of the same firing counted once.
    pub points: u64,
    /// Sweeps of which at least one block arrived.
    pub sweeps: u64,
    /// Sweeps of which every block arrived, from seam to seam of every channel.
    pub sweeps_complete: u64,
    /// Packets missing, by sequence number, less those that came late.
    pub lost: u64,
    /// Packets that came after a later one.
    pub late: u64,
    /// Packets that came more than once.
    pub duplicate: u64,
    /// Times the sensor's numbering began anew.
    pub restarts: u64,
    /// Jumps of the sensor's clock, restarts among them.
    pub clock_steps: u64,
    /// Datagrams that are no packets of the model.
    pub rejected: Rejected,
}

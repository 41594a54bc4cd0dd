//! Counts of what became of events.

/// What became of events: every one examined is in exactly one of the three counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Tally {
    /// Inside the exposure and the grid.
    pub rastered: u64,
    /// Inside the exposure, outside the grid.
    pub outside_grid: u64,
    /// Before the exposure opened, or after it closed.
    pub outside_exposure: u64,
}

impl Tally {
    /// Events examined.
    #[must_use]
    pub const fn examined(&self) -> u64 {
        self.rastered + self.outside_grid + self.outside_exposure
    }

    pub(super) fn add(&mut self, other: Self) {
        self.rastered += other.rastered;
        self.outside_grid += other.outside_grid;
        self.outside_exposure += other.outside_exposure;
    }
}

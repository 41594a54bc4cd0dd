//! What goes wrong between the sensors and the host.

use crate::error::WorldError;

/// Probabilities of faults, each per item; all zero by default.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Faults {
    /// A LiDAR datagram never arrives.
    pub packet_lost: f64,
    /// A LiDAR datagram arrives twice.
    pub packet_duplicated: f64,
    /// A LiDAR datagram is overtaken by its successor.
    pub packet_reordered: f64,
    /// A USB transfer, with its events and edges, never arrives.
    pub transfer_lost: f64,
    /// A strobe edge is not reported.
    pub edge_missed: f64,
    /// A strobe edge is reported twice, a few microseconds apart.
    pub edge_doubled: f64,
    /// An image never reaches the host; its sequence number is skipped.
    pub image_dropped: f64,
}

impl Faults {
    /// A rough ride: 1 % of packets lost, 2 % of edges missed, and a little of everything else
    /// but lost transfers.
    #[must_use]
    pub const fn rough() -> Self {
        Self {
            packet_lost: 0.01,
            packet_duplicated: 0.002,
            packet_reordered: 0.002,
            transfer_lost: 0.0,
            edge_missed: 0.02,
            edge_doubled: 0.01,
            image_dropped: 0.01,
        }
    }

    /// Checks that all are probabilities.
    ///
    /// # Errors
    /// Names the first that is not.
    pub fn validate(&self) -> Result<(), WorldError> {
        for (name, value) in [
            ("packet_lost", self.packet_lost),
            ("packet_duplicated", self.packet_duplicated),
            ("packet_reordered", self.packet_reordered),
            ("transfer_lost", self.transfer_lost),
            ("edge_missed", self.edge_missed),
            ("edge_doubled", self.edge_doubled),
            ("image_dropped", self.image_dropped),
        ] {
            if !(0.0..=1.0).contains(&value) {
                return Err(WorldError::Probability { name, value });
            }
        }
        Ok(())
    }
}

//! What sensors deliver, one value per sample.

use crate::{Evk4, Lidar, Realtime, Stamp};

/// One pixel's brightness change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Event {
    /// When, on the camera's counter (whole microseconds).
    pub t: Stamp<Evk4>,
    /// Column, 0 at the left.
    pub x: u16,
    /// Row, 0 at the top.
    pub y: u16,
    /// `true` when the pixel got brighter.
    pub on: bool,
}

/// An edge on the event camera's trigger input.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TriggerEdge {
    /// When, on the camera's counter (whole microseconds).
    pub t: Stamp<Evk4>,
    /// Trigger input, as the sensor numbers it (EVK4: 0).
    pub channel: u8,
    /// `true` for a rising edge.
    pub rising: bool,
}

/// One echo measured by the LiDAR, in the LiDAR's frame of reference.
///
/// x points right, y to raw azimuth zero, z up; azimuth increases clockwise seen from above.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(C)]
pub struct Return {
    /// When the laser fired, on the LiDAR's clock.
    pub t: Stamp<Lidar>,
    /// Metres.
    pub x_m: f32,
    /// Metres.
    pub y_m: f32,
    /// Metres.
    pub z_m: f32,
    /// Corrected azimuth of this channel, hundredths of a degree, `0..36_000`.
    pub azimuth_cdeg: u16,
    /// Laser, 0 first in the correction table.
    pub channel: u8,
    /// Reflectivity as the sensor reports it, `0..=255`.
    pub intensity: u8,
    /// Index of the block in its packet.
    pub block: u8,
}

/// The vehicle's own motion, from its bus.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Motion {
    /// When the frame was received.
    pub t: Stamp<Realtime>,
    /// Forward speed, metres per second; negative in reverse.
    pub speed_mps: f32,
    /// Turn rate about the vertical, radians per second; positive to the left.
    pub yaw_rate_rps: f32,
}

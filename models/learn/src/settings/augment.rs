//! How examples are varied.

use serde::{Deserialize, Serialize};

/// Random changes to training examples; each is drawn anew for every example.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Augment {
    /// Probability of exchanging left and right.
    pub flip: f64,
    /// Probability that the crop is laid over an outline of something that moves on its own, where
    /// there is one.
    pub over_movers: f64,
    /// Largest share of events lost.
    pub event_drop_max: f64,
    /// Largest number of made-up events per pixel and exposure.
    pub event_noise_max: f64,
    /// Largest share of LiDAR returns lost.
    pub return_drop_max: f64,
    /// Smallest and largest factor on the picture's light.
    pub gain: [f64; 2],
    /// Probability that a smaller square is taken and enlarged to the crop: another lens.
    pub zoom: f64,
    /// Largest factor of that, 1 to 8; depth stays what it is, returns lie thinner.
    pub zoom_max: f64,
    /// Largest factor on the event threshold, 1 to 16; events that so coarse a pixel would not
    /// have fired are lost.
    pub event_threshold_max: f64,
    /// Largest time constant of an event pixel's low-pass at white, microseconds; longer in the
    /// dark, up to twenty times. Comes on top of what the events were simulated with.
    pub event_lag_us_max: f64,
    /// Longest time that an event pixel is silent after an event, microseconds.
    pub event_dead_us_max: f64,
    /// Largest share of the LiDAR's rings lost: bands of six rows of the example, at all steps.
    pub ring_drop_max: f64,
    /// At most one ring in so many is kept, evenly: a LiDAR of fewer rings. 1 keeps all.
    pub ring_stride_max: usize,
    /// Largest standard deviation added to ranges, metres.
    pub range_noise_m_max: f64,
    /// Largest standard deviation of noise on the picture's light, white 1.
    pub read_noise_max: f64,
    /// Fewest bits of the picture's codes, 1 to 8.
    pub picture_bits_min: u32,
    /// Farthest that the horizon is told too high or too low, rows of the example: a car that
    /// pitches, or a road that rises.
    pub ground_shift_rows_max: f64,
    /// Probability that the network is not told where the ground lies.
    pub ground_unknown: f64,
}

impl Default for Augment {
    /// Changes nothing.
    fn default() -> Self {
        Self {
            flip: 0.0,
            over_movers: 0.0,
            event_drop_max: 0.0,
            event_noise_max: 0.0,
            return_drop_max: 0.0,
            gain: [1.0, 1.0],
            zoom: 0.0,
            zoom_max: 1.0,
            event_threshold_max: 1.0,
            event_lag_us_max: 0.0,
            event_dead_us_max: 0.0,
            ring_drop_max: 0.0,
            ring_stride_max: 1,
            range_noise_m_max: 0.0,
            read_noise_max: 0.0,
            picture_bits_min: 8,
            ground_shift_rows_max: 0.0,
            ground_unknown: 0.0,
        }
    }
}

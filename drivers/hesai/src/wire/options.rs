//! Settings of a decoder.

use thiserror::Error;

use super::{Correction, FireTimes, Model};

/// Which of a firing's echoes are handed out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Returns {
    /// Every non-zero return.
    All,
    /// Equal returns (distance and intensity) of one firing once: the last block's.
    Unique,
}

/// Settings of a decoder.
#[derive(Debug, Clone)]
pub struct Options {
    /// The sensor.
    pub model: Model,
    /// Directions of its lasers.
    pub correction: Correction,
    /// Times of its lasers.
    pub fire_times: FireTimes,
    /// Which echoes to hand out.
    pub returns: Returns,
    /// Corrected azimuth at which a channel's sweep begins, hundredths of a degree, below 36,000.
    pub cut_azimuth_cdeg: u16,
    /// Turns each laser on by what the head moves between the block's time and its own, at the
    /// packet's speed. The vendor does so when a fire-time file is loaded.
    pub turn_while_firing: bool,
    /// Where the beams start, in metres from the frame's origin; distances are measured from the
    /// origin. The vendor's default is not to correct for it. See [`Options::QT64_CENTRE_M`].
    pub optical_centre_m: Option<[f32; 3]>,
}

impl Options {
    /// The PandarQT64's optical centre, metres.
    pub const QT64_CENTRE_M: [f32; 3] = [-0.0072, 0.0298, 0.0];

    /// The model's nominal tables, unique returns, sweeps from azimuth 0, no refinements.
    #[must_use]
    pub fn new(model: Model) -> Self {
        Self {
            model,
            correction: Correction::nominal(model),
            fire_times: FireTimes::nominal(model),
            returns: Returns::Unique,
            cut_azimuth_cdeg: 0,
            turn_while_firing: false,
            optical_centre_m: None,
        }
    }
}

/// Settings that contradict one another.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum OptionsError {
    /// The correction table is another model's.
    #[error("correction table is for {}, decoder for {}", table.name(), model.name())]
    Correction {
        /// Whose it is.
        table: Model,
        /// The decoder's.
        model: Model,
    },
    /// The fire-time table is another model's.
    #[error("fire-time table is for {}, decoder for {}", table.name(), model.name())]
    FireTimes {
        /// Whose it is.
        table: Model,
        /// The decoder's.
        model: Model,
    },
    /// The cut is not on the circle.
    #[error("cut azimuth is {0}, needs less than 36000 hundredths of a degree")]
    Cut(u16),
}

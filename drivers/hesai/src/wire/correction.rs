//! Where each laser points: elevation and azimuth offset per channel.

use super::Model;
use super::nominal;
use super::table::{self, Column, TableError};

/// Direction of one laser, degrees.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LaserAngles {
    /// Above the horizon.
    pub elevation_deg: f64,
    /// Added to the azimuth of the block; clockwise seen from above.
    pub azimuth_deg: f64,
}

/// Directions of all lasers of one unit, channel 0 first.
#[derive(Debug, Clone, PartialEq)]
pub struct Correction {
    model: Model,
    lasers: Vec<LaserAngles>,
}

impl Correction {
    /// Reads a unit's own table: rows of channel (from 1), elevation, azimuth offset, in degrees.
    ///
    /// Header and unit lines, comments and a final hash line are skipped.
    ///
    /// # Errors
    /// The first thing wrong, with its line.
    pub fn from_csv(model: Model, text: &str) -> Result<Self, TableError> {
        const COLUMNS: [Column; 2] = [
            Column {
                what: "elevation in degrees",
                min: -90.0,
                max: 90.0,
            },
            Column {
                what: "azimuth offset in degrees",
                min: -180.0,
                max: 180.0,
            },
        ];
        let lasers = table::parse(text, model.channels(), &COLUMNS)?
            .into_iter()
            .map(|[elevation_deg, azimuth_deg]| LaserAngles {
                elevation_deg,
                azimuth_deg,
            })
            .collect();
        Ok(Self { model, lasers })
    }

    /// The vendor's table for the model, or its nominal beam pattern: a unit's own differs by up
    /// to some tenths of a degree.
    #[must_use]
    pub fn nominal(model: Model) -> Self {
        let lasers = match model {
            Model::Qt64 => degrees(&nominal::QT64),
            Model::Qt128 => degrees(&nominal::QT128),
            Model::Xt32 => degrees(&nominal::XT32),
            Model::Xt16 => even(16, 15.0, -2.0),
            Model::Xt32m => even(32, 19.5, -1.3),
            Model::Pandar64 => degrees(&nominal::PANDAR64),
            Model::Pandar40p => degrees(&nominal::PANDAR40P),
        };
        Self { model, lasers }
    }

    /// The model whose lasers these are.
    #[must_use]
    pub fn model(&self) -> Model {
        self.model
    }

    /// The lasers, channel 0 first.
    #[must_use]
    pub fn lasers(&self) -> &[LaserAngles] {
        &self.lasers
    }
}

/// The table as laser angles.
fn degrees(table: &[(f64, f64)]) -> Vec<LaserAngles> {
    let angles = |&(elevation_deg, azimuth_deg)| LaserAngles {
        elevation_deg,
        azimuth_deg,
    };
    table.iter().map(angles).collect()
}

/// `channels` beams `step` degrees apart, straight ahead of their block.
fn even(channels: u8, first: f64, step: f64) -> Vec<LaserAngles> {
    let angles = |channel: u8| LaserAngles {
        elevation_deg: first + step * f64::from(channel),
        azimuth_deg: 0.0,
    };
    (0..channels).map(angles).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_model_has_a_nominal_table_of_its_own_size() {
        for model in Model::ALL {
            let lasers = Correction::nominal(model).lasers;
            assert_eq!(lasers.len(), model.channels(), "{model:?}");
            let up = |pair: &[LaserAngles]| pair[1].elevation_deg > pair[0].elevation_deg;
            let rising = lasers.windows(2).filter(|pair| up(pair)).count();
            // Beams go up in the QT64, down elsewhere; the QT128 interleaves two halves.
            match model {
                Model::Qt64 => assert_eq!(rising, 63),
                Model::Qt128 => assert!(rising > 120, "{rising}"),
                _ => assert_eq!(rising, 0, "{model:?}"),
            }
        }
    }

    #[test]
    fn a_table_written_out_reads_back() {
        let qt64 = Correction::nominal(Model::Qt64);
        let mut text = String::from("Laser id,Elevation,Azimuth\n");
        for (index, laser) in qt64.lasers.iter().enumerate().rev() {
            let LaserAngles {
                elevation_deg,
                azimuth_deg,
            } = laser;
            text += &format!("{},{elevation_deg},{azimuth_deg}\r\n", index + 1);
        }
        assert_eq!(Correction::from_csv(Model::Qt64, &text), Ok(qt64));
        let error = Correction::from_csv(Model::Xt32, &text).unwrap_err();
        assert!(
            matches!(error, TableError::Channel { line: 2, .. }),
            "{error}"
        );
    }
}

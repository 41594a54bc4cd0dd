//! How a pixel's value stands for light.

use serde::{Deserialize, Serialize};

/// Transfer function between linear light and stored values, both in `0..=1`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Encoding {
    /// Values are proportional to light.
    Linear,
    /// IEC 61966-2-1.
    Srgb,
    /// A pure power: value = light^(1/2.2).
    Gamma22,
}

impl Encoding {
    /// Light of a stored value.
    #[must_use]
    pub fn to_linear(self, value: f32) -> f32 {
        match self {
            Self::Linear => value,
            Self::Srgb if value <= 0.040_45 => value / 12.92,
            Self::Srgb => ((value + 0.055) / 1.055).powf(2.4),
            Self::Gamma22 => value.max(0.0).powf(2.2),
        }
    }

    /// Stored value of light.
    #[must_use]
    pub fn from_linear(self, light: f32) -> f32 {
        match self {
            Self::Linear => light,
            Self::Srgb if light <= 0.003_130_8 => light * 12.92,
            Self::Srgb => 1.055 * light.powf(1.0 / 2.4) - 0.055,
            Self::Gamma22 => light.max(0.0).powf(1.0 / 2.2),
        }
    }

    /// Light of every 8-bit value.
    #[must_use]
    pub fn linear_table(self) -> [f32; 256] {
        std::array::from_fn(|value| self.to_linear(value as f32 / 255.0))
    }

    /// The 8-bit value nearest to `light`, clipped to `0..=1`.
    #[must_use]
    pub fn to_u8(self, light: f32) -> u8 {
        let value = self.from_linear(light.clamp(0.0, 1.0)) * 255.0;
        #[allow(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "clamped"
        )]
        let byte = value.round() as u8;
        byte
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_byte_survives_linear_light_and_back() {
        for encoding in [Encoding::Linear, Encoding::Srgb, Encoding::Gamma22] {
            let table = encoding.linear_table();
            for value in 0..=255u8 {
                assert_eq!(encoding.to_u8(table[usize::from(value)]), value);
            }
            assert!(table.is_sorted());
        }
    }

    /// Mid grey, from the standard's formula by hand: ((0.5 + 0.055) / 1.055)^2.4.
    #[test]
    fn mid_grey_is_where_the_standards_say() {
        assert!((Encoding::Srgb.to_linear(0.5) - 0.214_041).abs() < 1e-5);
        assert!((Encoding::Gamma22.to_linear(0.5) - 0.217_638).abs() < 1e-5);
        assert_eq!(Encoding::Linear.to_u8(2.0), 255);
        assert_eq!(Encoding::Gamma22.to_u8(-1.0), 0);
        assert_eq!(Encoding::Srgb.to_u8(f32::NAN), 0);
    }
}

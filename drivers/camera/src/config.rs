//! Settings of the camera, as written in a configuration file.

use serde::{Deserialize, Serialize};

use crate::{Encoding, ImageLayout, PixelError, PixelFormat, StampedAt};

/// Settings of the camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraConfig {
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// What the camera delivers.
    pub pixel_format: PixelFormat,
    /// Significant bits of a sample.
    #[serde(default = "eight")]
    pub bit_depth: u8,
    /// Transfer function of the delivered values.
    pub encoding: Encoding,
    /// Time between exposures, microseconds.
    pub period_us: u32,
    /// Exposure, microseconds; shorter than the period.
    pub exposure_us: u32,
    /// Gain, decibels, `0..=60`.
    #[serde(default)]
    pub gain_db: f32,
    /// Which instant the driver stamps.
    pub stamped_at: StampedAt,
}

const fn eight() -> u8 {
    8
}

impl CameraConfig {
    /// Checks the settings against one another.
    ///
    /// # Errors
    /// Names the setting that is out of range, with its value.
    pub fn validate(&self) -> Result<(), ConfigError> {
        ImageLayout::packed(self.pixel_format, self.width, self.height, self.bit_depth)?;
        if self.exposure_us == 0 || self.exposure_us >= self.period_us {
            return Err(ConfigError::Exposure {
                exposure_us: self.exposure_us,
                period_us: self.period_us,
            });
        }
        if !(0.0..=60.0).contains(&self.gain_db) {
            return Err(ConfigError::Gain(self.gain_db));
        }
        Ok(())
    }
}

/// What is wrong with the settings.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum ConfigError {
    /// Size, format and depth do not fit one another.
    #[error(transparent)]
    Layout(#[from] PixelError),
    /// Zero, or no shorter than the period.
    #[error("exposure_us {exposure_us} is not between 0 and period_us {period_us}")]
    Exposure {
        /// As configured.
        exposure_us: u32,
        /// As configured.
        period_us: u32,
    },
    /// Out of range.
    #[error("gain_db {0} is not in 0..=60")]
    Gain(f32),
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = r#"
        width = 512
        height = 512
        pixel_format = "bayer_rggb8"
        encoding = "gamma22"
        period_us = 200000
        exposure_us = 150000
        stamped_at = "end_of_exposure"
    "#;

    #[test]
    fn settings_read_from_toml_and_unknown_keys_are_refused() {
        let config: CameraConfig = toml::from_str(TEXT).unwrap();
        assert_eq!(config.validate(), Ok(()));
        assert_eq!(config.bit_depth, 8);
        assert!(toml::from_str::<CameraConfig>(&format!("{TEXT}\ngian_db = 1.0")).is_err());
    }

    #[test]
    fn each_setting_out_of_range_is_named() {
        let refuse = |edit: fn(&mut CameraConfig)| {
            let mut config: CameraConfig = toml::from_str(TEXT).unwrap();
            edit(&mut config);
            config.validate().unwrap_err().to_string()
        };
        assert_eq!(
            refuse(|c| c.exposure_us = 200_000),
            "exposure_us 200000 is not between 0 and period_us 200000"
        );
        assert_eq!(refuse(|c| c.gain_db = 61.0), "gain_db 61 is not in 0..=60");
        assert_eq!(
            refuse(|c| c.gain_db = f32::NAN),
            "gain_db NaN is not in 0..=60"
        );
        assert!(refuse(|c| c.width = 511).starts_with("image of 511x512"));
    }
}

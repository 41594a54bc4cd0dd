//! The widths and depths that make one member of the ERU-Net family, in the JSON form the oracle uses.
//!
//! A [`Config`] says everything about a network but its numbers: the same struct names the tensors
//! of a weights file, sizes them, and counts their cost. It reads no files.

mod form;
mod member;

use serde::{Deserialize, Serialize};
use thiserror::Error;

pub use form::Form;

/// Widest layer a configuration may ask for, in channels.
pub const WIDTH_MAX: usize = 4096;
/// Most residual blocks, steps, bins, frequencies or filters a configuration may ask for.
pub const COUNT_MAX: usize = 64;
/// Farthest depth a network may be asked to express, in metres.
pub const DEPTH_MAX_M: f64 = 10_000.0;
/// Image sides are whole multiples of this: the pyramids halve four times.
pub const SIDE_MULTIPLE: usize = 16;

/// Which of the paper's networks to build (paper, table 3).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Variant {
    /// Restoration and completion with hierarchical guidance.
    #[default]
    Full,
    /// No restoration: an already deblurred picture enters through one convolution.
    NoEfr,
    /// Completion guided by the restored feature alone, without the event pyramid.
    NoHgcm,
}

/// One member of the family. Levels count halvings: level 0 is full size, level 4 a sixteenth.
///
/// Field names are the paper's, and in JSON exactly the oracle's (`M`, `T` upper case).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Name printed in reports.
    pub name: String,
    /// Widths of the restoration network at levels 0, 1, 2.
    pub c: [usize; 3],
    /// Residual blocks of the spatial encoder at levels 0, 1, 2.
    pub n_sp: [usize; 3],
    /// Residual blocks at level 1 (`enc1`, `dec2`).
    pub n1: usize,
    /// Residual blocks at level 2 (`enc2`, `dec1`).
    pub n2: usize,
    /// Widths of the event stem at levels 1 and 2.
    pub k: [usize; 2],
    /// Residual blocks of the temporal encoder.
    pub n_t: usize,
    /// Width of the motion feature `F_dyn`.
    pub cd: usize,
    /// Widths of the guidance pyramid, levels 0 to 4.
    pub g: [usize; 5],
    /// Widths of the event pyramid, levels 0 to 4.
    pub e: [usize; 5],
    /// Widths of the depth encoder and decoder, levels 0 to 4.
    pub d: [usize; 5],
    /// Residual blocks of the guidance pyramid per level.
    pub n_g: [usize; 5],
    /// Residual blocks of the event pyramid per level.
    pub n_e: [usize; 5],
    /// Residual blocks of the depth encoder per level.
    pub n_d: [usize; 5],
    /// Residual blocks of the bottleneck.
    pub n_b: usize,
    /// Residual blocks of the decoder at levels 0 to 3.
    pub n_u: [usize; 4],
    /// Dynamic filters per pixel in GARF.
    #[serde(rename = "M", default = "default_filters")]
    pub filters: usize,
    /// Time bins of one voxel grid.
    #[serde(default = "default_bins")]
    pub bins: usize,
    /// Frequencies of the coordinate encoding.
    #[serde(default = "default_freqs")]
    pub freqs: usize,
    /// Depth maps per exposure.
    #[serde(rename = "T", default = "default_steps")]
    pub steps: usize,
    /// Depth the output saturates at, in metres.
    #[serde(default = "default_depth_max")]
    pub d_max: f64,
    /// Which of the paper's networks.
    #[serde(default)]
    pub variant: Variant,
    /// How depth enters and leaves; not written where it is the paper's.
    #[serde(default, skip_serializing_if = "Form::is_direct")]
    pub form: Form,
}

const fn default_filters() -> usize {
    6
}
const fn default_bins() -> usize {
    5
}
const fn default_freqs() -> usize {
    4
}
const fn default_steps() -> usize {
    8
}
const fn default_depth_max() -> f64 {
    80.0
}

/// Why a configuration describes no network.
#[derive(Debug, Error, PartialEq)]
pub enum ConfigError {
    /// A number of channels is zero or beyond [`WIDTH_MAX`].
    #[error("{field} is {value} channels, allowed 1 to {WIDTH_MAX}")]
    Width {
        /// The field and, for a list, its index.
        field: String,
        /// The number given.
        value: usize,
    },
    /// A number of blocks, steps, bins or filters is out of range.
    #[error("{field} is {value}, allowed {min} to {COUNT_MAX}")]
    Count {
        /// The field and, for a list, its index.
        field: String,
        /// The number given.
        value: usize,
        /// The smallest number allowed.
        min: usize,
    },
    /// The depth range is not a positive number of metres.
    #[error("d_max is {0} m, allowed above 0 to {DEPTH_MAX_M}")]
    DepthMax(f64),
    /// The JSON text is not a configuration.
    #[error("configuration is not readable: {0}")]
    Json(String),
    /// No member of the family has this name.
    #[error("no network is called \"{0}\", known are full, s, xs, tiny")]
    UnknownMember(String),
}

impl Config {
    /// The same widths for `steps` depth maps per exposure.
    #[must_use]
    pub fn with_steps(self, steps: usize) -> Self {
        Self { steps, ..self }
    }

    /// The same widths as another of the paper's networks.
    #[must_use]
    pub fn with_variant(self, variant: Variant) -> Self {
        Self { variant, ..self }
    }

    /// The same widths with depth entering and leaving in another form.
    #[must_use]
    pub fn with_form(self, form: Form) -> Self {
        Self { form, ..self }
    }

    /// Reads and validates the JSON form; a missing `name` becomes `custom`.
    pub fn from_json(text: &str) -> Result<Self, ConfigError> {
        let unreadable = |e: serde_json::Error| ConfigError::Json(e.to_string());
        let mut value: serde_json::Value = serde_json::from_str(text).map_err(unreadable)?;
        if let Some(fields) = value.as_object_mut() {
            fields.entry("name").or_insert_with(|| "custom".into());
        }
        let config: Self = serde_json::from_value(value).map_err(unreadable)?;
        config.validate()?;
        Ok(config)
    }

    /// The JSON form, on one line.
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).expect("a struct of numbers and strings always serialises")
    }

    /// Checks every number against its limit; names the first that is out of range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let width_lists: [(&str, &[usize]); 5] = [
            ("c", &self.c),
            ("k", &self.k),
            ("g", &self.g),
            ("e", &self.e),
            ("d", &self.d),
        ];
        for (field, list) in width_lists {
            for (index, &value) in list.iter().enumerate() {
                width(format!("{field}[{index}]"), value)?;
            }
        }
        width("cd".into(), self.cd)?;
        let block_lists: [(&str, &[usize]); 5] = [
            ("n_sp", &self.n_sp),
            ("n_g", &self.n_g),
            ("n_e", &self.n_e),
            ("n_d", &self.n_d),
            ("n_u", &self.n_u),
        ];
        for (field, list) in block_lists {
            for (index, &value) in list.iter().enumerate() {
                count(format!("{field}[{index}]"), value, 0)?;
            }
        }
        for (field, value) in [
            ("n1", self.n1),
            ("n2", self.n2),
            ("n_t", self.n_t),
            ("n_b", self.n_b),
        ] {
            count(field.into(), value, 0)?;
        }
        // One bin cannot place an event in time: the bin rule divides the slice into bins - 1.
        for (field, value, min) in [
            ("M", self.filters, 1),
            ("bins", self.bins, 2),
            ("freqs", self.freqs, 1),
            ("T", self.steps, 1),
        ] {
            count(field.into(), value, min)?;
        }
        if !(self.d_max > 0.0 && self.d_max <= DEPTH_MAX_M) {
            return Err(ConfigError::DepthMax(self.d_max));
        }
        Ok(())
    }

    /// Width of the guidance at `level`: restored feature and, where there is one, event pyramid.
    pub(crate) fn guidance_width(&self, level: usize) -> usize {
        self.g[level]
            + if self.has_event_pyramid() {
                self.e[level]
            } else {
                0
            }
    }

    /// Whether the network restores the picture itself.
    pub fn has_efr(&self) -> bool {
        self.variant != Variant::NoEfr
    }

    /// Whether completion is guided by an event pyramid.
    pub fn has_event_pyramid(&self) -> bool {
        self.variant != Variant::NoHgcm
    }
}

fn width(field: String, value: usize) -> Result<(), ConfigError> {
    if (1..=WIDTH_MAX).contains(&value) {
        Ok(())
    } else {
        Err(ConfigError::Width { field, value })
    }
}

fn count(field: String, value: usize, min: usize) -> Result<(), ConfigError> {
    if (min..=COUNT_MAX).contains(&value) {
        Ok(())
    } else {
        Err(ConfigError::Count { field, value, min })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_member_survives_the_json_form() {
        for name in ["full", "s", "xs", "tiny"] {
            let config = Config::member(name).unwrap();
            assert_eq!(config.name, name);
            assert_eq!(Config::from_json(&config.to_json()), Ok(config));
        }
        let json = Config::full().with_variant(Variant::NoHgcm).to_json();
        assert!(
            json.contains("\"M\":6,\"bins\":5,\"freqs\":4,\"T\":8,\"d_max\":80.0"),
            "{json}"
        );
        assert!(json.contains("\"variant\":\"no_hgcm\""), "{json}");
    }

    #[test]
    fn the_defaults_of_the_oracle_fill_what_is_left_out() {
        let mut value: serde_json::Value = serde_json::from_str(&Config::s().to_json()).unwrap();
        let fields = value.as_object_mut().unwrap();
        for field in ["name", "M", "bins", "freqs", "T", "d_max", "variant"] {
            fields.remove(field);
        }
        let read = Config::from_json(&value.to_string()).unwrap();
        assert_eq!(
            read,
            Config {
                name: "custom".into(),
                filters: 6,
                ..Config::s()
            }
        );
    }

    #[test]
    fn each_number_out_of_range_is_named() {
        let rejects = |change: fn(&mut Config), text: &str| {
            let mut config = Config::tiny();
            change(&mut config);
            assert_eq!(config.validate().unwrap_err().to_string(), text);
            assert!(Config::from_json(&config.to_json()).is_err());
        };
        rejects(|c| c.d[3] = 0, "d[3] is 0 channels, allowed 1 to 4096");
        rejects(|c| c.cd = 5000, "cd is 5000 channels, allowed 1 to 4096");
        rejects(|c| c.n_u[2] = 65, "n_u[2] is 65, allowed 0 to 64");
        rejects(|c| c.steps = 0, "T is 0, allowed 1 to 64");
        rejects(|c| c.bins = 1, "bins is 1, allowed 2 to 64");
        rejects(
            |c| c.d_max = -1.0,
            "d_max is -1 m, allowed above 0 to 10000",
        );
    }

    #[test]
    fn a_list_of_the_wrong_length_or_an_unknown_field_is_refused() {
        let json = Config::tiny().to_json();
        let short = json.replace("\"g\":[4,6,8,10,12]", "\"g\":[4,6,8,10]");
        assert!(matches!(
            Config::from_json(&short),
            Err(ConfigError::Json(_))
        ));
        let extra = json.replace("\"cd\":8", "\"cd\":8,\"dilation\":2");
        let error = Config::from_json(&extra).unwrap_err().to_string();
        assert!(error.contains("dilation"), "{error}");
        assert!(matches!(
            Config::from_json("[1]"),
            Err(ConfigError::Json(_))
        ));
        assert_eq!(
            Config::member("xl"),
            Err(ConfigError::UnknownMember("xl".into()))
        );
    }
}

//! The models a depth frame can come from, by number and by name.

use std::fmt;

use super::FrameError;

/// The rungs of the ladder, and what is not on it.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, serde::Deserialize,
)]
#[serde(rename_all = "lowercase")]
#[repr(u32)]
pub enum ModelId {
    /// Nearest return.
    Nearest = 0,
    /// Classical completion.
    Fill = 1,
    /// The smallest ERU-Net.
    Xs = 2,
    /// The small ERU-Net.
    S = 3,
    /// The paper's ERU-Net.
    Full = 4,
}

impl ModelId {
    /// All models, cheapest first.
    pub const ALL: [Self; 5] = [Self::Nearest, Self::Fill, Self::Xs, Self::S, Self::Full];

    /// The model a header names.
    #[must_use]
    pub fn from_u32(id: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|m| *m as u32 == id)
    }

    /// Name as written in configuration and reports.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Nearest => "nearest",
            Self::Fill => "fill",
            Self::Xs => "xs",
            Self::S => "s",
            Self::Full => "full",
        }
    }
}

impl fmt::Display for ModelId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl std::str::FromStr for ModelId {
    type Err = FrameError;

    fn from_str(text: &str) -> Result<Self, FrameError> {
        Self::ALL
            .into_iter()
            .find(|m| m.name() == text)
            .ok_or_else(|| FrameError::UnknownModel(text.to_owned()))
    }
}

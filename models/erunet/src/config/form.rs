//! How sparse depth enters a network and how dense depth leaves it.

use serde::{Deserialize, Serialize};

/// How sparse depth enters a network and how dense depth leaves it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Form {
    /// Sparse depth and its mask in, a share of the depth range out (the paper's network).
    #[default]
    Direct,
    /// Depth completed by the nearest return, mask and confidence in; a factor on the nearest
    /// return's depth out.
    Residual,
    /// As [`Residual`](Self::Residual), and the network also sees how much nearer and how much
    /// farther the returns around a pixel reach, and, where the ground is known, how far it lies
    /// and how high above it the pixel would be at the nearest return's depth; it moves from the
    /// nearest return's depth towards either reach before the factor applies.
    Choice,
}

impl Form {
    /// Channels that enter the depth encoder.
    pub fn depth_channels(self) -> usize {
        match self {
            Self::Direct => 2,
            Self::Residual => 3,
            Self::Choice => 7,
        }
    }

    /// Channels of the last convolution.
    pub fn head_channels(self) -> usize {
        match self {
            Self::Direct | Self::Residual => 1,
            Self::Choice => 2,
        }
    }

    pub(super) fn is_direct(&self) -> bool {
        *self == Self::Direct
    }
}

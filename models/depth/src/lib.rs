//! Depth maps without a network: completion, metrics, pictures.
#![forbid(unsafe_code)]
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "numeric crate: sizes are bounded by SIDE_MAX, floats are rounded into known ranges"
)]

mod completer;
mod fill;
mod metrics;
mod nearest;
mod size;

pub use completer::{CONFIDENCE_RANGE_PX, Completer, confidence};
pub use metrics::{Metrics, MetricsError, metrics};
pub use size::{SIDE_MAX, Size, SizeError};

//! Depth maps without a network: completion, metrics, pictures.
#![forbid(unsafe_code)]
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "numeric crate: sizes are bounded by SIDE_MAX, floats are rounded into known ranges"
)]

mod band;
mod completer;
mod fill;
mod metrics;
mod nearest;
mod picture;
mod score;
mod size;
mod temporal;

pub use band::{EDGE_BAND_PX, EDGE_RATIO, EDGE_STEP_M, MaskedMae, edge_band, masked_mae};
pub use completer::{CONFIDENCE_RANGE_PX, Completer, confidence};
pub use metrics::{Metrics, MetricsError, metrics};
pub use picture::{
    CANVAS_SIDE_MAX, Canvas, ContactSheet, DepthImage, DepthPngError, INVALID_RGB, LINE_HEIGHT,
    Legend, PictureError, PngError, Ramp, Scale, depth_to_rgb, error_to_rgb, events_to_rgb,
    load_depth_png16, read_depth_png16, save_depth_png16, sparse_to_rgb, text_width,
    write_depth_png16,
};
pub use score::{Score, ScoreTable, ScoredTwice};
pub use size::{SIDE_MAX, Size, SizeError};
pub use temporal::{Flow, Step, TemporalChange, temporal_change};

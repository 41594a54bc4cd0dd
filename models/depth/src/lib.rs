//! Depth maps without a network: completion, metrics, pictures.
//!
//! - [`Completer`] turns a sparse map into a dense one, either by the exact nearest return or by
//!   planes in inverse depth fitted to the returns of touching nearest-return cells, with an
//!   edge-keeping blur over their seams. It allocates once, when it is made.
//! - [`Surround`] finds the least and the largest value around every pixel.
//! - [`Ground`] says where level ground lies behind every pixel, [`Levelling`] by how much the returns on
//!   the road contradict it.
//! - [`metrics()`], [`edge_band`], [`masked_mae`] and [`temporal_change`] say how far a map is from
//!   the truth; [`ScoreTable`] averages over images, the same however the images were shared out.
//! - [`ContactSheet`] and its neighbours draw; [`read_depth_png16`] and [`write_depth_png16`] keep
//!   the 16-bit format of the KITTI depth benchmark.
//!
//! Maps are slices of metres, row by row, top left first, 0 where there is nothing. The crate
//! knows neither sensors nor networks, reads no clock and starts no thread.
#![forbid(unsafe_code)]
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "numeric crate: sizes are bounded by SIDE_MAX, floats are rounded into known ranges"
)]

mod band;
mod completer;
mod fill;
mod ground;
mod levelling;
mod metrics;
mod nearest;
mod picture;
mod score;
mod size;
mod surround;
mod temporal;

pub use band::{EDGE_BAND_PX, EDGE_RATIO, EDGE_STEP_M, MaskedMae, edge_band, masked_mae};
pub use completer::{CONFIDENCE_RANGE_PX, Completer, confidence};
pub use ground::Ground;
pub use levelling::{HORIZON_ROWS_MAX, HORIZON_ROWS_STEP, Levelling};
pub use metrics::{Metrics, MetricsError, metrics};
pub use picture::{
    CANVAS_SIDE_MAX, Canvas, ContactSheet, DepthImage, DepthPngError, INVALID_RGB, LINE_HEIGHT,
    Legend, PictureError, PngError, Ramp, Scale, depth_to_rgb, error_to_rgb, events_to_rgb,
    load_depth_png16, read_depth_png16, save_depth_png16, sparse_to_rgb, text_width,
    write_depth_png16,
};
pub use score::{Score, ScoreTable, ScoredTwice};
pub use size::{SIDE_MAX, Size, SizeError};
pub use surround::Surround;
pub use temporal::{Flow, Step, TemporalChange, temporal_change};

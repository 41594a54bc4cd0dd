//! The inference process: newest bundle, budget, ladder, each depth map sent as it exists.
//!
//! Rasters are read in place in shared memory. A bundle too old to be of use is dropped and
//! counted; when the predicted time misses the deadline a cheaper model stands in, and the frame
//! says so.

mod engine;
mod ladder;
#[cfg(feature = "model")]
mod network;
mod process;
mod report;

pub use engine::{Engines, InferError, Run};
pub use ladder::{Choice, Ladder, Rung};
#[cfg(feature = "model")]
pub use network::shipped_weights;
pub use process::{Options, run};
pub use report::{InferReport, ModelCount};

//! What training minimises (paper, equations 8 to 15).
//!
//! Every absolute value is a mean over pixels, channels and batch, masked ones over the valid
//! pixels of a step; sums over steps stay sums.

mod depth;
mod picture;

pub use depth::{DepthLoss, depth_loss};
pub use picture::{PictureLoss, picture_loss};
pub(crate) use picture::{average, temporal_spread};

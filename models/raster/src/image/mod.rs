//! Camera images -> planes, `f32 [3, H, W]`, encoded values in 0..=1.
//!
//! The network sees values as the camera encoded them; [`Encoding`] says how, and gets light back.

mod encoding;
mod planes;

pub use encoding::{Encoding, EncodingTable, UnknownEncoding};
pub use planes::{ImagePlanes, ImageView, Samples};

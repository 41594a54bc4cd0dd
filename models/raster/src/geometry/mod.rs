//! Where a sensor's pixels lie in the network's grid, and where the world lies in a sensor's pixels.
//!
//! Pixel coordinates put the centre of the first pixel at (0, 0), x to the right and y down, as the
//! calibration tools of this field do; a pixel covers half a unit to each side of its centre.

mod camera;
mod grid;
mod pixels;

pub use camera::{Distortion, Pinhole};
pub use grid::{Crop, Grid, Rescale};
pub(crate) use pixels::{Lookup, axes_cell, grid_cell, table_cell};
pub use pixels::{OUTSIDE, PixelMap};

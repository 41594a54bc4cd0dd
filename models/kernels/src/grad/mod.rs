//! What training needs on plain planes, batch by channel by row by column: layers forward and
//! backward, and the optimiser's step.

mod adam;
mod adaptive;
mod conv;
mod geometry;
mod rows;
mod sums;
mod work;

pub use adam::{AdamRates, adam_update};
pub use adaptive::PlaneFilter;
pub use conv::{ConvGrads, PlaneConv, Wanted};
pub use geometry::Geometry;

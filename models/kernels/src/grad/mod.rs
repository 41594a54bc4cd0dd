//! What training needs on plain planes, batch by channel by row by column: layers forward and
//! backward, and the optimiser's step.

mod adam;

pub use adam::{AdamRates, adam_update};

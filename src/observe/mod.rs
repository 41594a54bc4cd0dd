//! Watches a run from outside, as any other consumer would: hashes, latencies, errors, pictures.

mod record;
mod score;
mod sheet;
mod watch;

pub use record::{Kept, Observed};
pub use score::{MethodScore, Scores, score, truth_at, truth_of};
pub use sheet::{SheetError, draw_sheet, write_depth};
pub use watch::{Gate, Watch, watch};

//! A recording in place of sensors: the same lanes, synchroniser, rasters and bus.

mod gate;
mod host;
mod report;
mod session;

pub use gate::GatedOutlet;
pub use host::{HostOptions, Prepared, ReplayError, is_capture, run_host};
pub use report::RunReport;
pub use session::{Session, SessionOptions};

//! The host: sensors' blocks in, bundles out.
//!
//! One thread merges the lanes in the order of arrival, keeps the clocks, decides what belongs to
//! which exposure and rasters it straight into the memory that inference will read. What it does
//! depends on the blocks and their arrival stamps alone, so a recording gives the same bundles
//! however threads are scheduled.

mod assembler;
mod bay;
mod blocks;
mod merge;
mod outlet;
mod report;
mod rig;

pub use assembler::Assembler;
pub use blocks::{EdgeMark, EventBlock, ImageBlock, MotionBlock, ReturnBlock};
pub use merge::{Lanes, Promises, run};
pub use outlet::{BusOutlet, Outlet, Slot};
pub use report::{BundleReport, HostReport, RasterReport};
pub use rig::{ExposureSource, Rig, RigError};

//! Whole processes under faults: what the tests in `tests/` start, look at and end.
//!
//! Nothing here links the program under test: it is started as its users start it.
#![forbid(unsafe_code)]
#![allow(clippy::unwrap_used, reason = "a test may stop where it stands")]

mod process;
mod program;
mod stage;

pub use process::{Ended, Started, wait_until_gone};
pub use program::program;
pub use stage::{Stage, residue};

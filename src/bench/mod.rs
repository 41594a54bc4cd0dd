//! Benchmarks of whole paths: load that is made here, the real host, ratios to a plain copy.

mod load;
mod report;
mod run;

pub use load::{EventLoad, LoadError, write_load};
pub use report::{HostBench, HostRow};
pub use run::{BenchError, bench_host};

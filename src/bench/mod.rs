//! Benchmarks of whole paths: load that is made here, the real host, ratios to a plain copy.

#[cfg(feature = "model")]
mod infer;
mod load;
mod report;
mod run;

#[cfg(feature = "model")]
pub use infer::{InferBench, InferBenchError, InferPlan, InferRow, LayerRow, bench_infer};
pub use load::{EventLoad, LoadError, write_load};
pub use report::{HostBench, HostRow};
pub use run::{BenchError, bench_host};

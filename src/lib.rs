//! Noctule.
pub mod bench;
pub mod bus;
pub mod config;
pub mod digest;
pub mod export;
pub mod frame;
pub mod host;
pub mod infer;
pub mod ingest;
pub mod inspect;
pub mod lane;
pub mod latency;
pub mod observe;
pub mod replay;
pub mod supervise;
pub mod sync;

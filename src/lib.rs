//! Noctule: depth in the dark, from events, one blurred image and sparse LiDAR.
//!
//! The map of the house; `ARCHITECTURE.md` draws it with its floors.
//!
//! - What crosses between processes: [`frame`], carried by [`bus`].
//! - The host: [`ingest`] decodes what sensors deliver into [`lane`]s, [`host`] merges them by
//!   arrival and rasters what [`sync`] decides belongs together.
//! - The inference process: [`infer`].
//! - Around them: [`config`], [`latency`], [`digest`], [`supervise`].
//! - Whole runs: [`replay`] puts a recording in the sensors' place, [`observe`] watches it,
//!   [`mod@bench`] loads it.
//! - `dataset` hands a recording to evaluation.
//! - Files: [`inspect`] says what is in them, [`export`] hands it to other programs.

pub mod bench;
pub mod bus;
pub mod config;
#[cfg(feature = "model")]
pub mod dataset;
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

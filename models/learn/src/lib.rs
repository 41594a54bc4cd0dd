//! Trains and scores ERU-Net on the synthetic night.
//!
//! - [`Cache`] renders seeded nights once and keeps them; [`Loader`] makes batches of them, the
//!   same in every run, from any batch on.
//! - [`Settings`] are what a run is told. Seeds of validation and test cannot be trained on.
//!
//! The crate prints nothing and parses no arguments.
#![forbid(unsafe_code)]
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "indices and codes of bounded pictures and batches"
)]

mod cache;
mod chance;
mod settings;

pub use cache::{Cache, CacheError, Example, Examples, Nights, Prepared, SHARD_LEN, generator};
pub use settings::{
    Augment, Data, Domain, Drives, Kind, Loss, Settings, SettingsError, Stage, TEST_SEEDS,
    VALIDATION_SEEDS,
};

//! Trains and scores ERU-Net on the synthetic night.
//!
//! - [`Cache`] renders seeded nights once and keeps them; [`Loader`] makes batches of them, the
//!   same in every run, from any batch on.
//! - [`Run`] trains in the paper's stages and can be stopped and taken up again at any step.
//! - [`evaluate`] scores networks and what needs no learning on the same exposures.
//! - [`Settings`] are what a run is told. Seeds of validation and test cannot be trained on.
//!
//! The crate prints nothing and parses no arguments.
#![forbid(unsafe_code)]
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "indices and codes of bounded pictures and batches"
)]

mod batch;
mod cache;
mod chance;
mod eval;
mod loss;
mod score;
mod settings;
mod train;

pub use batch::{Batch, BatchError, Inputs, Loader, Pictures, Recipe};
pub use cache::{Cache, CacheError, Example, Examples, Nights, Prepared, SHARD_LEN, generator};
pub use eval::{
    DataSet, EvalError, Method, MethodScores, Row, Scene, Scenes, Scores, Share, Withheld,
    WorldScenes, csv, evaluate, markdown,
};
pub use loss::{DepthLoss, PictureLoss, depth_loss, picture_loss};
pub use score::{DEPTH_CAP_M, DEPTH_MIN_M, Truth, score_sequence};
pub use settings::{
    Augment, Data, Domain, Drives, Kind, Loss, Settings, SettingsError, Stage, TEST_SEEDS,
    VALIDATION_SEEDS,
};
pub use train::{
    BatchLoss, Beside, DepthValidation, PictureValidation, Report, Run, Start, StepReport,
    TrainError, Validation, batch_loss,
};

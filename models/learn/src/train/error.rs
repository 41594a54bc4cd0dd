//! What can stop a training run.

use std::path::PathBuf;

use noctule_depth::{MetricsError, PictureError, PngError, SizeError};
use noctule_erunet::{AdamError, ConfigError, NetworkError, PlanError, WeightsError};
use thiserror::Error;

use crate::batch::BatchError;
use crate::cache::CacheError;
use crate::eval::EvalError;
use crate::settings::SettingsError;

/// Why training stopped.
#[derive(Debug, Error)]
pub enum TrainError {
    /// A signal asked for it; a checkpoint was left.
    #[error("interrupted; a checkpoint was left in {}", .0.display())]
    Interrupted(PathBuf),
    /// The run's folder already holds one.
    #[error("{} holds a run already: resume it, or choose another folder", .0.display())]
    Exists(PathBuf),
    /// There is nothing to resume.
    #[error("{} holds no checkpoint to resume from", .0.display())]
    NothingToResume(PathBuf),
    /// The settings are not those of the run to be resumed.
    #[error("the settings differ from those the run was started with, in {key}")]
    OtherSettings {
        /// The first key that differs.
        key: String,
    },
    /// No stage of the settings is of this kind.
    #[error("the settings have no stage {0}")]
    NoStage(String),
    /// A loss or gradient became infinite or not a number.
    #[error("stage {stage}, step {step}: {what} is {value}; the batch is in {}", batch.display())]
    NotFinite {
        /// The stage's kind.
        stage: &'static str,
        /// Changes of the weights before it, in this stage.
        step: u64,
        /// Loss or gradient norm.
        what: &'static str,
        /// Its value.
        value: f64,
        /// Where the batch was saved.
        batch: PathBuf,
    },
    /// Stage 1 learnt to return its input.
    #[error(
        "stage 1 collapsed: its loss is {share:.3} of that of the blurred picture itself, \
         allowed {margin}; temporal spread {spread:.5}"
    )]
    Collapsed {
        /// Loss on the validation set over that of `I_recon = I_blur`.
        share: f64,
        /// The settings' margin.
        margin: f64,
        /// Mean absolute difference of the restored pictures from their mean.
        spread: f64,
    },
    /// A file could not be read or written.
    #[error("{}: {source}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A checkpoint is damaged or of another run.
    #[error("{}: {fault}", path.display())]
    Checkpoint {
        /// Which.
        path: PathBuf,
        /// What is wrong with it.
        fault: String,
    },
    /// The settings describe no run.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// The network is not one.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// Weights could not be read, written or used.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The network could not run.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// The optimiser refused.
    #[error(transparent)]
    Adam(#[from] AdamError),
    /// A batch could not be made.
    #[error(transparent)]
    Batch(#[from] BatchError),
    /// An example could not be read.
    #[error(transparent)]
    Cache(#[from] CacheError),
    /// An exposure could not be prepared for validation.
    #[error(transparent)]
    Eval(#[from] EvalError),
    /// The network could not be compiled or run for validation.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// A depth map could not be scored.
    #[error(transparent)]
    Metrics(#[from] MetricsError),
    /// A map has the wrong size.
    #[error(transparent)]
    Size(#[from] SizeError),
    /// A picture could not be drawn.
    #[error(transparent)]
    Picture(#[from] PictureError),
    /// A picture could not be saved.
    #[error(transparent)]
    Png(#[from] PngError),
    /// The tensor library failed.
    #[error("tensor operation failed: {0}")]
    Tensor(#[from] candle_core::Error),
}

//! What can go wrong with an evaluation.

use std::path::PathBuf;

use noctule_depth::{MetricsError, PictureError, PngError, SizeError};
use noctule_erunet::{ConfigError, PlanError, WeightsError};
use thiserror::Error;

use crate::read::ReadError;

/// Why an evaluation could not be done.
#[derive(Debug, Error)]
pub enum EvalError {
    /// Words on the command line mean nothing.
    #[error("{text:?} is not understood, wanted {wanted}")]
    Data {
        /// What was written.
        text: String,
        /// What would have been right.
        wanted: &'static str,
    },
    /// An exposure cannot be had.
    #[error("{scene}: {fault}")]
    Scene {
        /// Which.
        scene: String,
        /// What is wrong with it.
        fault: String,
    },
    /// A weights file does not say what network it is of.
    #[error("the weights {0} do not say what network they are of")]
    NoConfig(String),
    /// A table of single images is damaged.
    #[error("{}, line {line}: {fault}", path.display())]
    Table {
        /// Which.
        path: PathBuf,
        /// Its line, from 1.
        line: usize,
        /// What is wrong.
        fault: String,
    },
    /// Two tables hold the same image of the same method.
    #[error("{method}: {source}")]
    Twice {
        /// Which method.
        method: String,
        /// Which image.
        source: noctule_depth::ScoredTwice,
    },
    /// A file could not be read or written.
    #[error("{}: {source}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A file of a data set could not be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// The evaluation was interrupted.
    #[error("interrupted")]
    Interrupted,
    /// The network is not one.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// Weights could not be read or used.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The network could not run.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// A map could not be scored.
    #[error(transparent)]
    Metrics(#[from] MetricsError),
    /// A map has a size that cannot be.
    #[error(transparent)]
    Size(#[from] SizeError),
    /// A picture could not be drawn.
    #[error(transparent)]
    Picture(#[from] PictureError),
    /// A picture could not be saved.
    #[error(transparent)]
    Png(#[from] PngError),
}

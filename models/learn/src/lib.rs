//! Trains and scores ERU-Net on the synthetic night.
//!
//! - [`Cache`] renders seeded nights once and keeps them; [`Loader`] makes batches of them, the
//!   same in every run, from any batch on.
//! - [`Run`] trains in the paper's stages and can be stopped and taken up again at any step.
//! - [`evaluate`] scores networks and what needs no learning on the same exposures.
//! - [`NyuScenes`] and [`RgbdScenes`] score in rooms, [`KittiScenes`] on KITTI, read in its published
//!   layouts, [`KittiClips`] trains on it; [`expose`] makes the blur and the events of its sharp
//!   frames, moved along [`OpticalFlow`].
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
mod clip;
mod eval;
mod loss;
mod read;
mod score;
mod settings;
mod synth;
mod train;

pub use batch::{Batch, BatchError, Inputs, Loader, Pictures, Recipe};
pub use cache::{
    Cache, CacheError, Example, Examples, KittiClips, Nights, Origin, Part, Prepared, SHARD_LEN,
    generator, night_ground,
};
pub use clip::held_out;
pub use eval::{
    DataSet, EvalError, Gallery, KittiScenes, Method, MethodScores, NyuScenes, Observed,
    RgbdScenes, Row, Scene, Scenes, Scores, Share, Withheld, WorldScenes, csv, evaluate, markdown,
};
pub use loss::{DepthLoss, PictureLoss, depth_loss, picture_loss};
pub use read::{
    BENCHMARK_HEIGHT, BENCHMARK_WIDTH, BenchmarkDrive, Calibration, ColourCamera, Drive, NyuLayout,
    NyuPair, Projected, RINGS, ReadError, RgbdFrame, ScanPoint, SelectedFrame, Selection, Split,
    Window, benchmark_drives, is_validation_drive, nyu_pairs, nyu_test_frames, raw_drives,
    read_nyu_labelled, read_nyu_still, read_scan, rgbd_frames, rgbd_sequences, rings_by_elevation,
    rings_by_order, sparse_depth,
};
pub use score::{DEPTH_CAP_M, DEPTH_MIN_M, Truth, score_sequence};
pub use settings::{
    Augment, Data, Domain, Drives, Kind, KittiDrives, Loss, Settings, SettingsError, Stage,
    TEST_SEEDS, VALIDATION_SEEDS,
};
pub use synth::{
    BETWEEN_MAX, Exposed, Film, Footage, InBetween, OpticalFlow, SynthError, Synthesis, expose,
};
pub use train::{
    BatchLoss, Beside, DepthValidation, PictureValidation, Report, Run, Start, StepReport,
    TrainError, Validation, batch_loss,
};

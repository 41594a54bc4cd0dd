//! A training run: stages in order, checkpoints, validation, curves.
//!
//! A run lives in a folder: `settings.toml`, `checkpoint.safetensors` (to go on from),
//! `last.safetensors`, `best.safetensors` and `stage-KIND.safetensors` (averaged weights),
//! `curves.csv`, `validation.csv`, `curves.png`, and `grid.png`.

mod checkpoint;
mod curves;
mod error;
mod model;
mod schedule;
mod stage;
mod step;
mod validate;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use candle_core::Device;
use noctule_erunet::{Weights, WeightsError};

use crate::cache::{Cache, Examples, KittiClips, Part, write_whole};
use crate::settings::{Kind, Settings};
use checkpoint::{Checkpoint, Place};
use curves::Curves;
pub use error::TrainError;
use model::{Average, Model};
pub use step::{BatchLoss, Beside, batch_loss};
use validate::Validator;
pub use validate::{DepthValidation, PictureValidation, Validation};

/// What a run tells while it works.
#[derive(Debug)]
pub enum Report<'a> {
    /// The weights have changed once more.
    Step(StepReport<'a>),
    /// Averaged weights were validated.
    Validation(&'a Validation),
    /// Something worth a line.
    Note(String),
}

/// One change of the weights.
#[derive(Debug, Clone, Copy)]
pub struct StepReport<'a> {
    /// The stage's kind.
    pub kind: Kind,
    /// Changes in this stage, and how many it will have.
    pub step: u64,
    /// Of the stage.
    pub steps: u64,
    /// Changes over all stages, and how many there will be.
    pub total: u64,
    /// Of the run.
    pub totals: u64,
    /// What was minimised.
    pub loss: f64,
    /// Its terms, unweighted.
    pub terms: &'a [(&'static str, f64)],
    /// Stage 1 alone: beside what the loss must be seen.
    pub beside: Option<Beside>,
    /// Wall-clock seconds it took, waiting for the batch included.
    pub seconds: f64,
}

/// How a run is started.
#[derive(Debug, Clone)]
pub struct Start {
    /// The run's folder.
    pub folder: PathBuf,
    /// Go on from the folder's checkpoint.
    pub resume: bool,
    /// Run the stages of this kind alone.
    pub only: Option<Kind>,
}

/// A run at work.
pub struct Run {
    settings: Settings,
    start: Start,
    model: Model,
    average: Average,
    adam: Option<noctule_erunet::AdamState>,
    place: Place,
    examples: Arc<Examples>,
    validator: Validator,
    curves: Curves,
}

const CHECKPOINT: &str = "checkpoint.safetensors";
const SETTINGS: &str = "settings.toml";

impl Run {
    /// Starts a run or takes one up again. All examples must be in the cache.
    ///
    /// # Errors
    /// [`TrainError::Exists`], [`TrainError::NothingToResume`], [`TrainError::OtherSettings`], or
    /// whatever is wrong with examples, weights or folder.
    pub fn new(settings: Settings, start: Start, cache: &Cache) -> Result<Self, TrainError> {
        let config = settings.network()?;
        if let Some(kind) = start.only
            && settings.stages.iter().all(|stage| stage.kind != kind)
        {
            return Err(TrainError::NoStage(kind.name().into()));
        }
        let device = match settings.gpu()? {
            None => Device::Cpu,
            Some(index) => Device::new_cuda(index)?,
        };
        let checkpoint = open_folder(&settings, &start, &device)?;
        let (model, average, adam, place) = match checkpoint {
            Some(found) => {
                let weights = Weights::from_tensors(&config, found.weights, &device)?;
                Weights::from_tensors(&config, found.average.clone(), &device)?;
                let average = Average::from_tensors(found.average, settings.average);
                (
                    Model::new(&config, &weights)?,
                    average,
                    found.adam,
                    found.place,
                )
            }
            None => {
                let model = Model::new(&config, &first_weights(&settings, &device)?)?;
                let average = Average::new(&model, settings.average)?;
                (model, average, None, Place::default())
            }
        };
        let total = total_before(&settings, place.stage) + place.step;
        let (mut examples, mut real) = (cache.open(&settings.train()?)?, Examples::default());
        if let Some(kitti) = &settings.data.kitti {
            let open = |part| cache.open_clips(&KittiClips::open(kitti, part)?);
            examples = examples.mixed_with(open(Part::Train)?, kitti.share);
            real = open(Part::Validation)?;
        }
        let depth_max_m = config.d_max as f32;
        Ok(Self {
            curves: Curves::open(&start.folder, total)?,
            examples: Arc::new(examples),
            validator: Validator::new(
                cache.open(&settings.validation()?)?,
                real,
                settings.data.size,
                depth_max_m,
                settings.threads,
            )?,
            settings,
            start,
            model,
            average,
            adam,
            place,
        })
    }

    /// Trains until the last stage is done.
    ///
    /// # Errors
    /// [`TrainError::Interrupted`] soon after `stop` is set, a checkpoint left;
    /// [`TrainError::Collapsed`] after a stage 1 that learnt nothing; [`TrainError::NotFinite`].
    pub fn train(
        &mut self,
        stop: &AtomicBool,
        report: &mut dyn FnMut(&Report<'_>),
    ) -> Result<(), TrainError> {
        while let Some(stage) = self.settings.stages.get(self.place.stage) {
            if self.start.only.is_none_or(|only| only == stage.kind) {
                self.run_stage(stop, report)?;
            }
            self.place = Place {
                stage: self.place.stage + 1,
                step: 0,
                adam_steps: 0,
                is_validated: true,
                best: self.place.best,
            };
            self.adam = None;
            self.save()?;
        }
        Ok(())
    }

    fn file(&self, name: &str) -> PathBuf {
        self.start.folder.join(name)
    }

    /// Changes of the weights so far, over all stages.
    fn total(&self) -> u64 {
        total_before(&self.settings, self.place.stage) + self.place.step
    }

    /// Leaves a checkpoint and the averaged weights as they are now.
    fn save(&self) -> Result<(), TrainError> {
        let checkpoint = Checkpoint {
            place: self.place.clone(),
            weights: self.model.tensors()?,
            average: self.average.tensors().clone(),
            adam: self.adam.clone(),
        };
        checkpoint.write(&self.file(CHECKPOINT))?;
        Ok(self
            .average
            .weights(&self.model)?
            .write(&self.file("last.safetensors"))?)
    }
}

/// Steps of all stages before number `stage`.
fn total_before(settings: &Settings, stage: usize) -> u64 {
    settings.stages.iter().take(stage).map(|s| s.steps).sum()
}

fn first_weights(settings: &Settings, device: &Device) -> Result<Weights, TrainError> {
    let config = settings.network()?;
    match &settings.init {
        None => Ok(Weights::initial(&config, settings.seed, device)?),
        Some(path) => {
            let weights = Weights::read(path, device)?;
            let fitted = if settings.grow {
                weights.grown(&config, settings.seed)
            } else {
                weights.check(&config).map(|()| weights)
            };
            fitted.map_err(|error: WeightsError| TrainError::Checkpoint {
                path: path.clone(),
                fault: error.to_string(),
            })
        }
    }
}

/// Makes the folder, or reads the checkpoint in it.
fn open_folder(
    settings: &Settings,
    start: &Start,
    device: &Device,
) -> Result<Option<Checkpoint>, TrainError> {
    let folder = &start.folder;
    let path = folder.join(CHECKPOINT);
    if start.resume {
        if !path.exists() {
            return Err(TrainError::NothingToResume(folder.clone()));
        }
        let before = Settings::read(&folder.join(SETTINGS))?;
        if let Some(key) = first_difference(&before, settings) {
            return Err(TrainError::OtherSettings { key });
        }
        return Checkpoint::read(&path, device).map(Some);
    }
    if path.exists() {
        return Err(TrainError::Exists(folder.clone()));
    }
    let in_folder = |source| TrainError::File {
        path: folder.clone(),
        source,
    };
    std::fs::create_dir_all(folder).map_err(in_folder)?;
    for table in ["curves.csv", "validation.csv"] {
        remove_if_there(&folder.join(table)).map_err(in_folder)?;
    }
    write_whole(&folder.join(SETTINGS), settings.to_toml().as_bytes()).map_err(in_folder)?;
    Ok(None)
}

fn remove_if_there(path: &Path) -> std::io::Result<()> {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

/// The first setting that decides what is computed and is not the same in both. Where examples
/// lie, how many threads work and what happens after a collapse may change between sittings.
fn first_difference(before: &Settings, now: &Settings) -> Option<String> {
    let neutral = |settings: &Settings| {
        let mut settings = settings.clone();
        (settings.threads, settings.device) = (1, String::new());
        settings.data.loaders = 1;
        settings.data.cache = PathBuf::new();
        if let Some(kitti) = &mut settings.data.kitti {
            kitti.root = PathBuf::new();
        }
        for stage in &mut settings.stages {
            (stage.collapse_margin, stage.go_on_collapsed) = (1.0, false);
            (stage.validate_every, stage.checkpoint_every) = (1, 1);
        }
        settings
    };
    let (before, now) = (neutral(before), neutral(now));
    let differs = [
        ("member", before.member != now.member),
        ("variant", before.variant != now.variant),
        ("form", before.form != now.form),
        ("seed", before.seed != now.seed),
        ("init", before.init != now.init),
        ("grow", before.grow != now.grow),
        ("average", before.average != now.average),
        ("data", before.data != now.data),
        ("augment", before.augment != now.augment),
        ("loss", before.loss != now.loss),
        ("stages", before.stages != now.stages),
    ];
    let found = differs.iter().find(|(_, differs)| *differs);
    found.map(|(key, _)| (*key).to_owned())
}

//! What a training run is told: a TOML file, checked as a whole before anything starts.

mod augment;
mod check;

use std::path::{Path, PathBuf};

use noctule_erunet::{Config, Form, Variant};
use noctule_world::{STEPS, Tier};
use serde::{Deserialize, Serialize};

use crate::cache::Nights;
pub use augment::Augment;
pub use check::SettingsError;
use check::number;

/// First seed that training must never see: validation starts here.
pub const VALIDATION_SEEDS: u64 = 100_000;
/// The paper's guard of eq. 8.
pub(crate) const CHARBONNIER_GUARD: f64 = 1e-3;
/// First seed that nothing is tuned on: tests start here.
pub const TEST_SEEDS: u64 = 200_000;

/// A training run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// Member of the family: `xs`, `s`, `full` or `tiny`.
    pub member: String,
    /// Which of the paper's networks (its table 3).
    #[serde(default)]
    pub variant: Variant,
    /// How depth enters and leaves, where it is not as the member has it: `choice` lets the paper's
    /// `full` grow out of `s`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub form: Option<Form>,
    /// Starts the weights, the order of the examples and their augmentation.
    pub seed: u32,
    /// Processor threads of the tensor library.
    #[serde(default = "one")]
    pub threads: usize,
    /// Where the network trains: `cpu`, or `cuda:0` and so on in a build for GPUs.
    #[serde(default = "default_device")]
    pub device: String,
    /// Weights file to start from instead of random numbers.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub init: Option<PathBuf>,
    /// Whether `init` may be of a smaller network, which then grows into this one: it starts by
    /// computing the same, with what is new random and unheard.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub grow: bool,
    /// Share of the old average kept at each step by the averaged weights; 0 turns averaging off.
    #[serde(default = "default_average")]
    pub average: f64,
    /// What is trained on.
    pub data: Data,
    /// How examples are varied.
    #[serde(default)]
    pub augment: Augment,
    /// What is minimised, where a stage does not say otherwise.
    #[serde(default)]
    pub loss: Loss,
    /// What is done, in order.
    pub stages: Vec<Stage>,
}

/// Where examples come from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Data {
    /// Folder for rendered examples; relative to the working directory.
    pub cache: PathBuf,
    /// Width and height of a rendered example, pixels.
    #[serde(default = "default_size")]
    pub size: usize,
    /// Threads that prepare batches ahead of the trainer.
    #[serde(default = "one")]
    pub loaders: usize,
    /// Drives to train on, seeds below [`VALIDATION_SEEDS`]; none where `kitti` gives all examples.
    #[serde(default)]
    pub train: Vec<Drives>,
    /// Drives to validate on, seeds from [`VALIDATION_SEEDS`] to below [`TEST_SEEDS`]; none where
    /// `kitti` has frames to validate on.
    #[serde(default)]
    pub validation: Vec<Drives>,
    /// Real drives, beside the nights or in place of them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kitti: Option<KittiDrives>,
}

/// Raw drives of KITTI that are trained and validated on.
///
/// A drive of 32 scanned frames or more makes exposures of eight frames. A shorter one is a clip:
/// four frames make eight steps, and its frames from number 8 on, which it is scored on, are
/// refused. Drives that the depth benchmark holds back from training are refused too.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KittiDrives {
    /// Folder of the raw drives in KITTI's layout; relative to the working directory.
    pub root: PathBuf,
    /// Their names (`2011_09_26_drive_0001_sync`); empty for all that are not held back.
    #[serde(default)]
    pub drives: Vec<String>,
    /// First and last frame of every drive to train on, both included. Nothing outside is seen.
    pub frames: [u32; 2],
    /// First and last frame to validate on, both included, none of `frames`. Scored are these
    /// frames; the exposures that end with them may begin in frames that are trained on.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub validation: Option<[u32; 2]>,
    /// Squares of `data.size` pixels cut from the bottom of each exposure at columns drawn by
    /// chance; each serves four times, every ring of four being given once.
    #[serde(default = "default_cuts")]
    pub cuts: usize,
    /// Share of training examples taken from here; the rest are nights.
    pub share: f64,
}

/// Some drives of one tier.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Drives {
    /// `A`, `B`, `C` or `S`.
    pub tier: String,
    /// First seed, and one past the last.
    pub seeds: [u64; 2],
}

/// Which numbers of a picture are averaged when it is blurred again (paper, eq. 9).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Domain {
    /// Light: decode gamma 2.2, average, encode.
    #[default]
    Linear,
    /// The encoded values themselves.
    Encoded,
}

/// Weights of the losses (paper, eq. 8 to 12) and the constants in them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Loss {
    /// Charbonnier (eq. 8).
    pub charbonnier: f64,
    /// Errors below this count by their square, larger ones by themselves (eq. 8); the paper's is
    /// 1e-3. A larger one pulls towards the mean of what fits instead of its median, which, where
    /// most pixels stand still, is the blurred picture. Validation always takes the paper's.
    pub charbonnier_guard: f64,
    /// 1 - SSIM (eq. 8).
    pub ssim: f64,
    /// Laplacian edges (eq. 8).
    pub edge: f64,
    /// Blurring the restored pictures again (eq. 9, 11).
    pub reblur: f64,
    /// Gradients against those that events imply (eq. 10, 11).
    pub gradient: f64,
    /// Depth at and around the returns (eq. 12).
    pub sparse: f64,
    /// What is averaged in eq. 9.
    pub reblur_domain: Domain,
    /// Contrast threshold of the event camera, natural logarithm (eq. 10).
    pub contrast: f64,
    /// Extra weight of `|ln D - ln D_gt|`, per unit; not in the paper, 0 there.
    pub log_depth: f64,
    /// Extra weight of eq. 13 in the 5 px band around depth edges; not in the paper, 0 there.
    pub depth_edges: f64,
    /// How many pixels more a pixel on something that moves counts for in eq. 13; not in the
    /// paper, 0 there.
    pub depth_movers: f64,
    /// Extra weight of eq. 13 on what moves, a mean of its own in every exposure and step, so that
    /// something small counts for as much as something large; not in the paper, 0 there.
    pub mover_mean: f64,
    /// Weight of the mean square of restored features, over steps, pixels and channels; not in the
    /// paper, 0 there. Normalisation behind them hides how large they are, and without a price on
    /// it the recursion learns to grow with every step until single precision runs out.
    pub restored_power: f64,
}

impl Default for Loss {
    /// The paper's.
    fn default() -> Self {
        Self {
            charbonnier: 1.0,
            charbonnier_guard: CHARBONNIER_GUARD,
            ssim: 0.05,
            edge: 0.05,
            reblur: 0.2,
            gradient: 0.05,
            sparse: 0.5,
            reblur_domain: Domain::Linear,
            contrast: 0.25,
            log_depth: 0.0,
            depth_edges: 0.0,
            depth_movers: 0.0,
            mover_mean: 0.0,
            restored_power: 0.0,
        }
    }
}

/// Which part of the network a stage trains, and on what loss (paper, training).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Kind {
    /// Restoration on sharp pictures, eq. 11.
    #[serde(rename = "1")]
    Restore,
    /// Completion on depth, eq. 12, restoration frozen.
    #[serde(rename = "2")]
    Complete,
    /// Both on depth, running statistics fixed.
    #[serde(rename = "3")]
    Together,
    /// Both on depth from the start, batch statistics: what the paper advises against.
    #[serde(rename = "joint")]
    Joint,
}

impl Kind {
    /// Whether the tensor `name` of a weights file trains.
    pub fn trains(self, name: &str) -> bool {
        match self {
            Self::Restore => name.starts_with("efr."),
            Self::Complete => name.starts_with("rdu."),
            Self::Together | Self::Joint => !name.starts_with("efr.recon."),
        }
    }

    /// Whether batch normalisation uses the batch's own statistics.
    pub fn uses_batch_statistics(self) -> bool {
        matches!(self, Self::Complete | Self::Joint)
    }

    /// As in the settings file.
    pub fn name(self) -> &'static str {
        match self {
            Self::Restore => "1",
            Self::Complete => "2",
            Self::Together => "3",
            Self::Joint => "joint",
        }
    }
}

/// One stage of training.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stage {
    /// What trains.
    pub kind: Kind,
    /// Changes of the weights.
    pub steps: u64,
    /// Exposures per change.
    pub batch: usize,
    /// Width and height of the cut-out an exposure is trained on, pixels.
    pub crop: usize,
    /// Consecutive steps of the exposure that are trained on at once.
    pub window: usize,
    /// Rate of learning at the start and, after half a cosine, at the end.
    pub rate: [f64; 2],
    /// Steps over which the rate rises to its start.
    #[serde(default)]
    pub warm_up: u64,
    /// Norm that gradients are cut to.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clip_norm: Option<f64>,
    /// Steps between validations.
    pub validate_every: u64,
    /// Steps between checkpoints.
    pub checkpoint_every: u64,
    /// Stage 1 alone: passed when the loss is below this share of the loss of `I_recon = I_blur`.
    #[serde(default = "default_margin")]
    pub collapse_margin: f64,
    /// Stage 1 alone: go on to the next stage even where it was not passed.
    #[serde(default)]
    pub go_on_collapsed: bool,
    /// What this stage minimises, in place of the settings' `loss`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub loss: Option<Loss>,
}

const fn one() -> usize {
    1
}
fn default_device() -> String {
    "cpu".to_owned()
}
const fn default_size() -> usize {
    256
}
const fn default_cuts() -> usize {
    12
}
const fn default_average() -> f64 {
    0.999
}
const fn default_margin() -> f64 {
    0.95
}

impl Settings {
    /// What `stage` minimises.
    pub fn loss_of(&self, stage: &Stage) -> Loss {
        stage.loss.unwrap_or(self.loss)
    }

    /// Reads and checks a file.
    ///
    /// # Errors
    /// [`SettingsError`], for the first thing that is wrong with it.
    pub fn read(path: &Path) -> Result<Self, SettingsError> {
        let text = std::fs::read_to_string(path).map_err(|source| SettingsError::File {
            path: path.into(),
            source,
        })?;
        Self::from_toml(&text)
    }

    /// As [`read`](Self::read), from text.
    ///
    /// # Errors
    /// As there.
    pub fn from_toml(text: &str) -> Result<Self, SettingsError> {
        let settings: Self =
            toml::from_str(text).map_err(|e| SettingsError::Toml(e.to_string()))?;
        settings.check()?;
        Ok(settings)
    }

    /// The file's text, defaults spelt out.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("numbers and strings in tables always serialise")
    }

    /// The network the run trains, for `steps` depth maps per exposure of eight.
    ///
    /// # Errors
    /// [`SettingsError::Network`] for an unknown member.
    pub fn network(&self) -> Result<Config, SettingsError> {
        let config = Config::member(&self.member)?
            .with_steps(STEPS)
            .with_variant(self.variant);
        Ok(match self.form {
            Some(form) => config.with_form(form),
            None => config,
        })
    }

    /// Number of the GPU to train on; `None` for the processor.
    ///
    /// # Errors
    /// [`SettingsError::Number`] for any other word.
    pub fn gpu(&self) -> Result<Option<usize>, SettingsError> {
        match self.device.strip_prefix("cuda:").map(str::parse) {
            Some(Ok(index)) => Ok(Some(index)),
            None if self.device == "cpu" => Ok(None),
            _ => Err(number("device", &self.device, "cpu, cuda:0, cuda:1, ...")),
        }
    }

    /// The drives to train on.
    ///
    /// # Errors
    /// [`SettingsError::Tier`].
    pub fn train(&self) -> Result<Vec<Nights>, SettingsError> {
        nights(&self.data.train)
    }

    /// The drives to validate on.
    ///
    /// # Errors
    /// [`SettingsError::Tier`].
    pub fn validation(&self) -> Result<Vec<Nights>, SettingsError> {
        nights(&self.data.validation)
    }
}

fn nights(drives: &[Drives]) -> Result<Vec<Nights>, SettingsError> {
    drives
        .iter()
        .map(|drives| {
            Ok(Nights {
                tier: drives.tier.parse::<Tier>()?,
                seeds: drives.seeds[0]..drives.seeds[1],
            })
        })
        .collect()
}

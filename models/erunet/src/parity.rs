//! Comparison with the PyTorch reference: the same weights and inputs, every intermediate feature.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

use candle_core::{Device, Tensor};
use serde::Deserialize;
use thiserror::Error;

use crate::config::{Config, ConfigError};
use crate::network::{Network, NetworkError};
use crate::params::Norms;
use crate::pass::Pass;
use crate::weights::{Weights, WeightsError};

/// Largest error allowed on features and confidence, relative to `max(1, |x|)`.
pub const FEATURE_GATE: f32 = 1e-4;
/// Largest error allowed on depth, in metres.
pub const DEPTH_GATE_M: f32 = 2e-3;

/// Why a comparison could not be made.
#[derive(Debug, Error)]
pub enum ParityError {
    /// A file of the fixture could not be read.
    #[error("{}: {source}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The fixture's description is not readable.
    #[error("{}: {reason}", path.display())]
    Meta {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The fixture lacks a tensor.
    #[error("{file} has no tensor {name}")]
    Missing {
        /// The file.
        file: &'static str,
        /// The tensor.
        name: String,
    },
    /// The network yields a tensor of another shape.
    #[error("{name} is {actual:?} here and {wanted:?} in the fixture")]
    Shape {
        /// The tensor.
        name: String,
        /// Dimensions here.
        actual: Vec<usize>,
        /// Dimensions in the fixture.
        wanted: Vec<usize>,
    },
    /// The fixture's tensors are defective.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The network could not be built or run.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// The tensor library failed.
    #[error("tensor operation failed: {0}")]
    Tensor(#[from] candle_core::Error),
}

/// The worst value of one tensor.
#[derive(Debug, Clone, PartialEq)]
pub struct TensorParity {
    /// Name in the fixture.
    pub name: String,
    /// Largest absolute error.
    pub error_max: f32,
    /// Largest error as a share of what is allowed there; not a number if any value is not.
    pub gate_share_max: f32,
    /// Largest magnitude the reference holds.
    pub magnitude_max: f32,
}

impl TensorParity {
    /// Whether every value is within its gate.
    pub fn is_within(&self) -> bool {
        self.gate_share_max <= 1.0
    }
}

/// Every tensor of one fixture.
#[derive(Debug, Clone, PartialEq)]
pub struct ParityReport {
    /// The configuration compared.
    pub config: Config,
    /// One entry per tensor of the fixture, by name.
    pub tensors: Vec<TensorParity>,
}

impl ParityReport {
    /// Whether every tensor is within its gate.
    pub fn is_within(&self) -> bool {
        self.tensors.iter().all(TensorParity::is_within)
    }
}

impl fmt::Display for ParityReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{:<12} {:>10} {:>10} {:>8}",
            "tensor", "error", "magnitude", "of gate"
        )?;
        for t in &self.tensors {
            let verdict = if t.is_within() { "" } else { "  OUTSIDE" };
            let share = 100.0 * t.gate_share_max;
            writeln!(
                f,
                "{:<12} {:>10.2e} {:>10.3} {share:>7.2}%{verdict}",
                t.name, t.error_max, t.magnitude_max
            )?;
        }
        Ok(())
    }
}

#[derive(Deserialize)]
struct Meta {
    config: serde_json::Value,
}

/// Compares on the processor with norms folded, as inference runs.
pub fn parity(dir: &Path) -> Result<ParityReport, ParityError> {
    parity_on(dir, &Device::Cpu, Norms::Fold)
}

/// Runs the network of fixture folder `dir` (`meta.json`, `weights.safetensors`,
/// `inputs.safetensors`, `outputs.safetensors`) and compares every tensor the fixture holds.
pub fn parity_on(dir: &Path, device: &Device, norms: Norms) -> Result<ParityReport, ParityError> {
    let config = fixture_config(dir)?;
    let weights = Weights::read(&dir.join("weights.safetensors"), device)?;
    let inputs = Weights::read(&dir.join("inputs.safetensors"), device)?;
    let outputs = Weights::read(&dir.join("outputs.safetensors"), &Device::Cpu)?;
    let input = |name: &str| {
        let missing = || ParityError::Missing {
            file: "inputs.safetensors",
            name: name.into(),
        };
        inputs.tensors().get(name).ok_or_else(missing)
    };
    let network = Network::new(&config, &weights, norms).map_err(ParityError::Network)?;
    let ours = run(&network, input("blur")?, input("vox")?, input("sparse")?)?;
    let tensors = outputs
        .tensors()
        .iter()
        .map(|(name, wanted)| {
            let here = ours.get(name).ok_or_else(|| ParityError::Missing {
                file: "the network's output",
                name: name.clone(),
            })?;
            compare(name, here, wanted)
        })
        .collect::<Result<_, _>>()?;
    Ok(ParityReport { config, tensors })
}

/// The configuration a fixture folder was exported with.
pub fn fixture_config(dir: &Path) -> Result<Config, ParityError> {
    let path = dir.join("meta.json");
    let text = std::fs::read_to_string(&path).map_err(|source| ParityError::File {
        path: path.clone(),
        source,
    })?;
    let unreadable = |reason: String| ParityError::Meta {
        path: path.clone(),
        reason,
    };
    let meta: Meta = serde_json::from_str(&text).map_err(|e| unreadable(e.to_string()))?;
    Config::from_json(&meta.config.to_string()).map_err(|e: ConfigError| unreadable(e.to_string()))
}

fn run(
    network: &Network,
    blur: &Tensor,
    voxel: &Tensor,
    sparse: &Tensor,
) -> Result<BTreeMap<String, Tensor>, NetworkError> {
    let mut pass = Pass::tracing();
    let clear = network.restore(blur, voxel, &mut pass)?;
    let outputs = network.complete(&clear, voxel, sparse, &mut pass)?;
    let mut tensors: BTreeMap<String, Tensor> = pass
        .features()
        .map(|(name, tensor)| (name.to_owned(), tensor.clone()))
        .collect();
    tensors.insert("D_dense".into(), outputs.depth);
    if let Some(pictures) = network.reconstruct(&clear, blur)? {
        tensors.insert("I_recon".into(), pictures);
    }
    Ok(tensors)
}

fn compare(name: &str, here: &Tensor, wanted: &Tensor) -> Result<TensorParity, ParityError> {
    if here.dims() != wanted.dims() {
        return Err(ParityError::Shape {
            name: name.into(),
            actual: here.dims().to_vec(),
            wanted: wanted.dims().to_vec(),
        });
    }
    let here: Vec<f32> = here.to_device(&Device::Cpu)?.flatten_all()?.to_vec1()?;
    let wanted: Vec<f32> = wanted.flatten_all()?.to_vec1()?;
    let mut parity = TensorParity {
        name: name.into(),
        error_max: 0.0,
        gate_share_max: 0.0,
        magnitude_max: 0.0,
    };
    for (here, wanted) in here.iter().zip(&wanted) {
        let allowed = match name {
            "D_dense" => DEPTH_GATE_M,
            _ => FEATURE_GATE * wanted.abs().max(1.0),
        };
        let error = (here - wanted).abs();
        parity.error_max = larger(parity.error_max, error);
        parity.gate_share_max = larger(parity.gate_share_max, error / allowed);
        parity.magnitude_max = larger(parity.magnitude_max, wanted.abs());
    }
    Ok(parity)
}

/// The larger of two; not a number wins.
fn larger(a: f32, b: f32) -> f32 {
    if a.is_nan() || a > b { a } else { b }
}

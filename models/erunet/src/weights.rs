//! Weights files: safetensors in and out, checked against what a configuration wants.
//!
//! A file is untrusted bytes. Everything that is wrong with it is reported at once, by name.

use std::collections::{BTreeMap, HashMap};
use std::fmt;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use candle_core::{DType, Device, Tensor};
use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensorError, SafeTensors};
use thiserror::Error;

use crate::config::{Config, ConfigError};
use crate::init::initial_values;
use crate::params::{Role, Slot};
use crate::parts::slots;

/// Largest weights file that is read, in bytes; the full network needs 119 MB.
pub const FILE_BYTES_MAX: u64 = 2 << 30;
/// Key of the file's free-text table under which the configuration is kept as JSON.
const CONFIG_KEY: &str = "config";
/// Counter PyTorch keeps per batch normalisation; nothing reads it.
const IGNORED_SUFFIX: &str = "num_batches_tracked";

/// One thing wrong with one tensor.
#[derive(Debug, Clone, PartialEq)]
pub enum Fault {
    /// The network wants it and the file lacks it.
    Missing {
        /// The tensor.
        name: String,
        /// Dimensions wanted.
        wanted: Vec<usize>,
    },
    /// The file has it and the network has no place for it.
    Unexpected {
        /// The tensor.
        name: String,
        /// Its dimensions.
        actual: Vec<usize>,
    },
    /// It has other dimensions than the network wants.
    Shape {
        /// The tensor.
        name: String,
        /// Its dimensions.
        actual: Vec<usize>,
        /// Dimensions wanted.
        wanted: Vec<usize>,
    },
    /// It does not hold single-precision floats.
    NumberFormat {
        /// The tensor.
        name: String,
        /// What it holds.
        actual: String,
    },
    /// Some of its values are infinite or not a number.
    NotFinite {
        /// The tensor.
        name: String,
        /// How many.
        count: usize,
    },
    /// A running variance is negative.
    NegativeVariance {
        /// The tensor.
        name: String,
        /// The smallest value.
        least: f32,
    },
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Missing { name, wanted } => write!(f, "{name} {wanted:?} is missing"),
            Self::Unexpected { name, actual } => write!(f, "{name} {actual:?} is unexpected"),
            Self::Shape {
                name,
                actual,
                wanted,
            } => {
                write!(f, "{name} is {actual:?}, wanted {wanted:?}")
            }
            Self::NumberFormat { name, actual } => write!(f, "{name} holds {actual}, wanted F32"),
            Self::NotFinite { name, count } => write!(f, "{name} has {count} non-finite values"),
            Self::NegativeVariance { name, least } => {
                write!(f, "{name} has a negative variance, {least}")
            }
        }
    }
}

/// Why weights could not be read, written or used.
#[derive(Debug, Error)]
pub enum WeightsError {
    /// The file could not be read or written.
    #[error("{}: {source}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file is larger than any network.
    #[error("file has {actual} bytes, allowed {FILE_BYTES_MAX}")]
    TooLarge {
        /// Its size in bytes.
        actual: u64,
    },
    /// The file ends within a tensor.
    #[error("file ends within {name}: needs {needed} bytes, has {actual}")]
    Truncated {
        /// The first tensor cut short, in file order.
        name: String,
        /// Bytes of file that tensor needs.
        needed: u64,
        /// Bytes there are.
        actual: u64,
    },
    /// The bytes are not a safetensors file.
    #[error("not a safetensors file: {0}")]
    Format(String),
    /// The configuration is not one.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// Tensors do not fit; every fault found is listed.
    #[error("{} of the tensors do not fit: {}", .0.len(), list(.0))]
    Faults(Vec<Fault>),
    /// The weights cannot be put into the larger network asked for.
    #[error("cannot grow {0}")]
    Growth(String),
    /// Two networks' weights have no mean.
    #[error("cannot mix: {0}")]
    Mix(String),
    /// The tensors could not be placed on the device.
    #[error("tensor operation failed: {0}")]
    Tensor(#[from] candle_core::Error),
}

fn list(faults: &[Fault]) -> String {
    faults
        .iter()
        .map(Fault::to_string)
        .collect::<Vec<_>>()
        .join("; ")
}

/// Named tensors of one network, and the configuration they were written with, if known.
#[derive(Debug, Clone)]
pub struct Weights {
    config: Option<Config>,
    tensors: BTreeMap<String, Tensor>,
    device: Device,
}

impl Weights {
    /// Starting values for training: deterministic in `seed`, equal to the PyTorch reference's.
    pub fn initial(config: &Config, seed: u32, device: &Device) -> Result<Self, WeightsError> {
        let tensors = initial_values(slots(config)?, seed)
            .into_iter()
            .map(|(slot, values)| Ok((slot.name, Tensor::from_vec(values, slot.shape, device)?)))
            .collect::<candle_core::Result<_>>()?;
        Ok(Self {
            config: Some(config.clone()),
            tensors,
            device: device.clone(),
        })
    }

    /// Weights from tensors at hand, such as those of training variables.
    pub fn from_tensors(
        config: &Config,
        tensors: BTreeMap<String, Tensor>,
        device: &Device,
    ) -> Result<Self, WeightsError> {
        let weights = Self {
            config: Some(config.clone()),
            tensors,
            device: device.clone(),
        };
        weights.check(config)?;
        Ok(weights)
    }

    /// Reads a file; checks that it is whole and holds finite single-precision numbers.
    pub fn read(path: &Path, device: &Device) -> Result<Self, WeightsError> {
        let file = |source| WeightsError::File {
            path: path.into(),
            source,
        };
        let actual = fs::metadata(path).map_err(file)?.len();
        if actual > FILE_BYTES_MAX {
            return Err(WeightsError::TooLarge { actual });
        }
        Self::from_bytes(&fs::read(path).map_err(file)?, device)
    }

    /// As [`Weights::read`], from memory.
    pub fn from_bytes(bytes: &[u8], device: &Device) -> Result<Self, WeightsError> {
        let file = SafeTensors::deserialize(bytes).map_err(|e| explain(bytes, &e))?;
        let mut faults = Vec::new();
        let mut tensors = BTreeMap::new();
        let mut views = file.tensors();
        views.sort_by(|a, b| a.0.cmp(&b.0));
        for (name, view) in views {
            if name.ends_with(IGNORED_SUFFIX) {
                continue;
            }
            match values(&name, &view) {
                Ok(values) => {
                    tensors.insert(name, Tensor::from_vec(values, view.shape(), device)?);
                }
                Err(fault) => faults.push(fault),
            }
        }
        if !faults.is_empty() {
            return Err(WeightsError::Faults(faults));
        }
        let config = stored_config(bytes)?;
        Ok(Self {
            config,
            tensors,
            device: device.clone(),
        })
    }

    /// Writes the file under a temporary name beside `path`, then moves it there: no reader ever
    /// sees half a file.
    pub fn write(&self, path: &Path) -> Result<(), WeightsError> {
        let bytes = self.to_bytes()?;
        let file = |source| WeightsError::File {
            path: path.into(),
            source,
        };
        let mut partial = path.as_os_str().to_owned();
        partial.push(".partial");
        let mut out = fs::File::create(&partial).map_err(file)?;
        out.write_all(&bytes)
            .and_then(|()| out.sync_all())
            .map_err(file)?;
        fs::rename(&partial, path).map_err(file)
    }

    /// The file's bytes; the same tensors give the same bytes.
    pub fn to_bytes(&self) -> Result<Vec<u8>, WeightsError> {
        let mut data = Vec::with_capacity(self.tensors.len());
        for (name, tensor) in &self.tensors {
            let values: Vec<f32> = tensor.flatten_all()?.to_vec1()?;
            let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
            data.push((name, tensor.dims().to_vec(), bytes));
        }
        let format = |e: SafeTensorError| WeightsError::Format(e.to_string());
        let views = data
            .iter()
            .map(|(name, shape, bytes)| {
                Ok((
                    name.as_str(),
                    TensorView::new(Dtype::F32, shape.clone(), bytes)?,
                ))
            })
            .collect::<Result<Vec<_>, _>>()
            .map_err(format)?;
        let config = self.config.as_ref();
        let table = config.map(|config| HashMap::from([(CONFIG_KEY.into(), config.to_json())]));
        safetensors::serialize(views, table).map_err(format)
    }

    /// The configuration the file was written with; files of other tools carry none.
    pub fn config(&self) -> Option<&Config> {
        self.config.as_ref()
    }

    /// The tensors by name.
    pub fn tensors(&self) -> &BTreeMap<String, Tensor> {
        &self.tensors
    }

    /// The device the tensors lie on.
    pub fn device(&self) -> Device {
        self.device.clone()
    }

    /// Compares the tensors with what `config` wants and lists every fault.
    pub fn check(&self, config: &Config) -> Result<(), WeightsError> {
        let slots = slots(config)?;
        let mut faults = Vec::new();
        for slot in &slots {
            match self.tensors.get(&slot.name) {
                None => faults.push(Fault::Missing {
                    name: slot.name.clone(),
                    wanted: slot.shape.clone(),
                }),
                Some(tensor) => faults.extend(misfit(slot, tensor)?),
            }
        }
        let wanted: BTreeMap<&str, &Slot> = slots.iter().map(|s| (s.name.as_str(), s)).collect();
        faults.extend(
            self.tensors
                .iter()
                .filter(|(name, _)| !wanted.contains_key(name.as_str()))
                .map(|(name, tensor)| Fault::Unexpected {
                    name: name.clone(),
                    actual: tensor.dims().into(),
                }),
        );
        if faults.is_empty() {
            Ok(())
        } else {
            Err(WeightsError::Faults(faults))
        }
    }
}

fn misfit(slot: &Slot, tensor: &Tensor) -> candle_core::Result<Option<Fault>> {
    let name = slot.name.clone();
    if tensor.dims() != slot.shape {
        let actual = tensor.dims().to_vec();
        return Ok(Some(Fault::Shape {
            name,
            actual,
            wanted: slot.shape.clone(),
        }));
    }
    if tensor.dtype() != DType::F32 {
        return Ok(Some(Fault::NumberFormat {
            name,
            actual: format!("{:?}", tensor.dtype()),
        }));
    }
    if slot.role == Role::Statistic && name.ends_with("running_var") {
        let least = tensor.min(0)?.to_scalar::<f32>()?;
        if least < 0.0 {
            return Ok(Some(Fault::NegativeVariance { name, least }));
        }
    }
    Ok(None)
}

fn values(name: &str, view: &TensorView<'_>) -> Result<Vec<f32>, Fault> {
    if view.dtype() != Dtype::F32 {
        let actual = format!("{:?}", view.dtype());
        return Err(Fault::NumberFormat {
            name: name.into(),
            actual,
        });
    }
    let (words, _) = view.data().as_chunks::<4>();
    let values: Vec<f32> = words.iter().map(|word| f32::from_le_bytes(*word)).collect();
    match values.iter().filter(|value| !value.is_finite()).count() {
        0 => Ok(values),
        count => Err(Fault::NotFinite {
            name: name.into(),
            count,
        }),
    }
}

/// The header of a file, as far as its length and JSON allow; used where the strict reader fails.
fn header(bytes: &[u8]) -> Option<(u64, serde_json::Map<String, serde_json::Value>)> {
    let (length, rest) = bytes.split_first_chunk::<8>()?;
    let length = u64::from_le_bytes(*length);
    let text = rest.get(..usize::try_from(length).ok()?)?;
    Some((length + 8, serde_json::from_slice(text).ok()?))
}

/// Names the tensor a short file cuts off; any other defect keeps the reader's words.
fn explain(bytes: &[u8], error: &SafeTensorError) -> WeightsError {
    let actual = bytes.len() as u64;
    let cut = header(bytes).and_then(|(start, tensors)| {
        tensors
            .iter()
            .filter_map(|(name, entry)| {
                let end = entry.get("data_offsets")?.get(1)?.as_u64()?;
                Some((start.checked_add(end)?, name.clone()))
            })
            .filter(|(needed, _)| *needed > actual)
            .min()
    });
    match cut {
        Some((needed, name)) => WeightsError::Truncated {
            name,
            needed,
            actual,
        },
        None => WeightsError::Format(error.to_string()),
    }
}

fn stored_config(bytes: &[u8]) -> Result<Option<Config>, ConfigError> {
    let Some((_, header)) = header(bytes) else {
        return Ok(None);
    };
    let stored = header
        .get("__metadata__")
        .and_then(|table| table.get(CONFIG_KEY)?.as_str());
    stored.map(Config::from_json).transpose()
}

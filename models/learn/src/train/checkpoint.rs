//! Checkpoints: everything a run needs to go on as if it had not stopped.
//!
//! One safetensors file: `w/NAME` weights, `a/NAME` averaged weights, `m/NAME` and `v/NAME` the
//! optimiser's moments; the rest as JSON in the free-text table. Which batch comes next follows
//! from the step.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use candle_core::{Device, Tensor};
use noctule_erunet::AdamState;
use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};
use serde::{Deserialize, Serialize};

use super::error::TrainError;
use crate::cache::write_whole;

const STATE_KEY: &str = "state";

/// Where a run is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Place {
    /// Index of the stage in the settings.
    pub stage: usize,
    /// Changes of the weights done in it.
    pub step: u64,
    /// Steps the optimiser has taken in it.
    pub adam_steps: u64,
    /// Whether a validation that was due at this step has been done.
    pub is_validated: bool,
    /// Best validation score so far, in any stage on depth; lower is better.
    pub best: Option<f64>,
}

impl Default for Place {
    fn default() -> Self {
        Self {
            stage: 0,
            step: 0,
            adam_steps: 0,
            is_validated: true,
            best: None,
        }
    }
}

/// A checkpoint in memory.
pub(super) struct Checkpoint {
    pub place: Place,
    pub weights: BTreeMap<String, Tensor>,
    pub average: BTreeMap<String, Tensor>,
    /// `None` between stages.
    pub adam: Option<AdamState>,
}

impl Checkpoint {
    /// Writes the file whole or not at all.
    pub(super) fn write(&self, path: &Path) -> Result<(), TrainError> {
        let mut fields: Vec<(String, Vec<usize>, Vec<u8>)> = Vec::new();
        let mut add = |name: String, tensor: &Tensor| -> candle_core::Result<()> {
            let values: Vec<f32> = tensor.flatten_all()?.to_vec1()?;
            let bytes = values.iter().flat_map(|v| v.to_le_bytes()).collect();
            fields.push((name, tensor.dims().to_vec(), bytes));
            Ok(())
        };
        for (prefix, tensors) in [("w", &self.weights), ("a", &self.average)] {
            for (name, tensor) in tensors {
                add(format!("{prefix}/{name}"), tensor)?;
            }
        }
        for (name, tensor) in self.adam.iter().flat_map(|adam| &adam.moments) {
            add(name.clone(), tensor)?;
        }
        let fault = |fault: String| TrainError::Checkpoint {
            path: path.into(),
            fault,
        };
        let views = fields
            .iter()
            .map(|(name, shape, bytes)| {
                Ok((
                    name.as_str(),
                    TensorView::new(Dtype::F32, shape.clone(), bytes)?,
                ))
            })
            .collect::<Result<Vec<_>, safetensors::SafeTensorError>>()
            .map_err(|e| fault(e.to_string()))?;
        let place = serde_json::to_string(&self.place).map_err(|e| fault(e.to_string()))?;
        let table = HashMap::from([(STATE_KEY.to_owned(), place)]);
        let bytes = safetensors::serialize(views, Some(table)).map_err(|e| fault(e.to_string()))?;
        write_whole(path, &bytes).map_err(|source| TrainError::File {
            path: path.into(),
            source,
        })
    }

    /// Reads a file.
    pub(super) fn read(path: &Path, device: &Device) -> Result<Self, TrainError> {
        let fault = |fault: &str| TrainError::Checkpoint {
            path: path.into(),
            fault: fault.to_owned(),
        };
        let bytes = std::fs::read(path).map_err(|source| TrainError::File {
            path: path.into(),
            source,
        })?;
        let (_, metadata) =
            SafeTensors::read_metadata(&bytes).map_err(|e| fault(&e.to_string()))?;
        let place: Place = metadata
            .metadata()
            .as_ref()
            .and_then(|table| table.get(STATE_KEY))
            .and_then(|text| serde_json::from_str(text).ok())
            .ok_or_else(|| fault("is no checkpoint: it does not say where the run was"))?;
        let file = SafeTensors::deserialize(&bytes).map_err(|e| fault(&e.to_string()))?;
        let mut checkpoint = Self {
            weights: BTreeMap::new(),
            average: BTreeMap::new(),
            adam: None,
            place,
        };
        let mut moments = BTreeMap::new();
        for (name, view) in file.tensors() {
            let (words, rest) = view.data().as_chunks::<4>();
            if view.dtype() != Dtype::F32 || !rest.is_empty() {
                return Err(fault(&format!(
                    "{name} does not hold single-precision numbers"
                )));
            }
            let values: Vec<f32> = words.iter().map(|word| f32::from_le_bytes(*word)).collect();
            let tensor = Tensor::from_vec(values, view.shape(), device)?;
            match name.split_once('/') {
                Some(("w", name)) => checkpoint.weights.insert(name.to_owned(), tensor),
                Some(("a", name)) => checkpoint.average.insert(name.to_owned(), tensor),
                Some(("m" | "v", _)) => moments.insert(name, tensor),
                _ => return Err(fault(&format!("{name} is no part of a checkpoint"))),
            };
        }
        if !moments.is_empty() {
            checkpoint.adam = Some(AdamState {
                steps: checkpoint.place.adam_steps,
                moments,
            });
        }
        Ok(checkpoint)
    }
}

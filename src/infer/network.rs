//! ERU-Net behind the engines' interface: floats of shared memory in, floats out.

use std::collections::BTreeMap;

use candle_core::{Device, Tensor};
use noctule_erunet::{Network, Norms, Sequence, Weights};

use super::InferError;
use crate::config::Config;
use crate::frame::{BundleLayout, BundlePlanes, ModelId};

/// The networks that were loaded.
pub(super) struct Networks {
    by_model: BTreeMap<ModelId, Network>,
}

fn failed<E: std::error::Error + Send + Sync + 'static>(
    model: ModelId,
) -> impl Fn(E) -> InferError {
    move |cause| InferError::Network {
        model,
        cause: Box::new(cause),
    }
}

impl Networks {
    /// Loads every weight file that the configuration names.
    pub fn load(config: &Config) -> Result<Self, InferError> {
        let mut by_model = BTreeMap::new();
        for (&model, path) in &config.infer.weights {
            let weights = Weights::read(path, &Device::Cpu).map_err(|cause| InferError::File {
                model,
                path: path.clone(),
                cause: Box::new(cause),
            })?;
            let family = match model {
                ModelId::S => noctule_erunet::Config::s(),
                ModelId::Full => noctule_erunet::Config::full(),
                _ => noctule_erunet::Config::xs(),
            };
            let written_with = weights.config().cloned().unwrap_or(family);
            let (steps, bins) = (config.grid.steps as usize, config.grid.bins as usize);
            if (written_with.steps, written_with.bins) != (steps, bins) {
                let reason = "its steps or bins differ from the grid's";
                return Err(InferError::Missing { model, reason });
            }
            let network =
                Network::new(&written_with, &weights, Norms::Fold).map_err(failed(model))?;
            by_model.insert(model, network);
        }
        Ok(Self { by_model })
    }

    /// The models loaded, cheapest first.
    pub fn models(&self) -> impl Iterator<Item = ModelId> + '_ {
        self.by_model.keys().copied()
    }

    /// Starts a sequence.
    pub fn begin<'a>(
        &'a self,
        model: ModelId,
        layout: &BundleLayout,
        planes: &BundlePlanes<'_>,
    ) -> Result<NetworkRun<'a>, InferError> {
        let reason = "no weights are loaded (see [infer.weights])";
        let network = self
            .by_model
            .get(&model)
            .ok_or(InferError::Missing { model, reason })?;
        let (h, w) = (layout.height, layout.width);
        let blur =
            Tensor::from_slice(planes.image, (1, 3, h, w), &Device::Cpu).map_err(failed(model))?;
        let sequence = network.begin(&blur).map_err(failed(model))?;
        Ok(NetworkRun {
            model,
            layout: *layout,
            sequence,
        })
    }
}

/// A sequence of one network.
pub(super) struct NetworkRun<'a> {
    model: ModelId,
    layout: BundleLayout,
    sequence: Sequence<'a>,
}

impl NetworkRun<'_> {
    /// Computes the next step.
    pub fn step(
        &mut self,
        planes: &BundlePlanes<'_>,
        step: usize,
        depth: &mut [f32],
        trust: &mut [f32],
    ) -> Result<(), InferError> {
        let BundleLayout {
            bins,
            height,
            width,
            ..
        } = self.layout;
        let plane = self.layout.plane();
        let model = self.model;
        let voxel = &planes.voxels[step * bins * plane..][..bins * plane];
        let sparse = &planes.sparse[step * plane..][..plane];
        let tensor = |values: &[f32], channels| {
            Tensor::from_slice(values, (1, channels, height, width), &Device::Cpu)
                .map_err(failed(model))
        };
        let out = self
            .sequence
            .step(&tensor(voxel, bins)?, &tensor(sparse, 1)?)
            .map_err(failed(model))?;
        for (tensor, into) in [(&out.depth, depth), (&out.confidence, trust)] {
            let values = tensor
                .flatten_all()
                .and_then(|t| t.to_vec1::<f32>())
                .map_err(failed(model))?;
            into.copy_from_slice(&values);
        }
        Ok(())
    }
}

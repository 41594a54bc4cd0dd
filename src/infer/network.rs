//! ERU-Net behind the engines' interface: floats of shared memory in, floats out.
//!
//! On processors a network runs as a compiled plan; on a GPU as candle's network. Both come from
//! the same weights.

use std::collections::{BTreeMap, BTreeSet};

use candle_core::{Device, Tensor};
use noctule_depth::Ground;
use noctule_erunet::{Network, Norms, Plan, PlanOptions, Sequence, Weights};
use noctule_kernels::{Isa, Precision};

use super::InferError;
use crate::config::{self, Config};
use crate::frame::{BundleLayout, BundlePlanes, ModelId};

/// The weights of `xs` (`models/weights/xs.md` says where they come from).
const XS: &[u8] = include_bytes!("../../models/weights/xs.safetensors");
/// The weights of `s` (`models/weights/s.md`).
const S: &[u8] = include_bytes!("../../models/weights/s.safetensors");

/// The weights file of a network that is part of the program ([`config::SHIPPED`]).
#[must_use]
pub fn shipped_weights(model: ModelId) -> Option<&'static [u8]> {
    match model {
        ModelId::Xs => Some(XS),
        ModelId::S => Some(S),
        _ => None,
    }
}

/// The networks that were loaded.
pub(super) struct Networks {
    by_model: BTreeMap<ModelId, Loaded>,
}

/// One network, ready to run.
enum Loaded {
    Plan(Box<Plan>),
    Candle(Box<Network>),
}

fn failed<E: std::error::Error + Send + Sync + 'static>(
    model: ModelId,
) -> impl Fn(E) -> InferError {
    move |cause| InferError::Network {
        model,
        cause: Box::new(cause),
    }
}

/// What candle calls the configured device.
fn device(config: &Config) -> Result<Device, InferError> {
    match config.infer.device {
        config::Device::Cpu => Ok(Device::Cpu),
        config::Device::Cuda(index) => {
            Device::new_cuda(index).map_err(|cause| InferError::Device {
                index,
                // Candle appends a backtrace where one is asked for.
                reason: cause
                    .to_string()
                    .lines()
                    .next()
                    .unwrap_or_default()
                    .to_owned(),
            })
        }
    }
}

/// How plans are compiled under this configuration.
pub(super) fn plan_options(config: &Config) -> PlanOptions {
    let isa = Isa::detect();
    PlanOptions {
        threads: config.infer.thread_count(),
        precision: match config.infer.precision {
            config::Precision::Auto if isa == Isa::Avx512Bf16 => Precision::Brain,
            config::Precision::Auto | config::Precision::F32 => Precision::Single,
            config::Precision::Bf16 => Precision::Brain,
        },
        isa,
    }
}

impl Networks {
    /// Loads every weight file that the configuration names, and the program's own networks up to
    /// the model asked for.
    pub fn load(config: &Config) -> Result<Self, InferError> {
        let own = config::SHIPPED.iter().filter(|m| **m <= config.infer.model);
        let models: BTreeSet<ModelId> = config.infer.weights.keys().chain(own).copied().collect();
        let mut by_model = BTreeMap::new();
        if !models.is_empty() {
            let device = device(config)?;
            for model in models {
                by_model.insert(model, load(config, model, &device)?);
            }
        }
        Ok(Self { by_model })
    }

    /// The models loaded, cheapest first.
    pub fn models(&self) -> impl Iterator<Item = ModelId> + '_ {
        self.by_model.keys().copied()
    }

    /// Starts a sequence.
    pub fn begin<'a>(
        &'a mut self,
        model: ModelId,
        layout: &BundleLayout,
        planes: &BundlePlanes<'_>,
        ground: Option<&Ground>,
    ) -> Result<NetworkRun<'a>, InferError> {
        let reason = "no weights are loaded (see [infer.weights])";
        let loaded = self
            .by_model
            .get_mut(&model)
            .ok_or(InferError::Missing { model, reason })?;
        let state = match loaded {
            Loaded::Plan(plan) => {
                plan.begin(planes.image, ground).map_err(failed(model))?;
                State::Plan(plan)
            }
            Loaded::Candle(network) => {
                let shape = (1, 3, layout.height, layout.width);
                let blur = Tensor::from_slice(planes.image, shape, network.device());
                let blur = blur.map_err(failed(model))?;
                State::Candle(
                    network.begin(&blur, ground).map_err(failed(model))?,
                    network,
                )
            }
        };
        Ok(NetworkRun {
            model,
            layout: *layout,
            state,
        })
    }
}

fn load(config: &Config, model: ModelId, device: &Device) -> Result<Loaded, InferError> {
    let weights = match config.infer.weights.get(&model) {
        Some(path) => Weights::read(path, device).map_err(|cause| InferError::File {
            model,
            path: path.clone(),
            cause: Box::new(cause),
        })?,
        None => {
            let reason = "no weights are named and none ship";
            let own = shipped_weights(model).ok_or(InferError::Missing { model, reason })?;
            Weights::from_bytes(own, device).map_err(failed(model))?
        }
    };
    let family = match model {
        ModelId::S => noctule_erunet::Config::s(),
        ModelId::Full => noctule_erunet::Config::full(),
        _ => noctule_erunet::Config::xs(),
    };
    let written_with = weights.config().cloned().unwrap_or(family);
    if written_with.bins != config.grid.bins as usize {
        let reason = "its bins differ from the grid's";
        return Err(InferError::Missing { model, reason });
    }
    // Nothing in the weights depends on the number of steps.
    let written_with = written_with.with_steps(config.grid.steps as usize);
    if device.is_cpu() {
        let (height, width) = (config.grid.height as usize, config.grid.width as usize);
        let options = plan_options(config);
        let plan = Plan::new(&written_with, &weights, height, width, options);
        return Ok(Loaded::Plan(Box::new(plan.map_err(failed(model))?)));
    }
    let network = Network::new(&written_with, &weights, Norms::Fold).map_err(failed(model))?;
    Ok(Loaded::Candle(Box::new(network)))
}

/// A sequence of one network.
pub(super) struct NetworkRun<'a> {
    model: ModelId,
    layout: BundleLayout,
    state: State<'a>,
}

enum State<'a> {
    Plan(&'a mut Plan),
    Candle(Sequence<'a>, &'a Network),
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
        let BundleLayout { bins, .. } = self.layout;
        let plane = self.layout.plane();
        let voxel = &planes.voxels[step * bins * plane..][..bins * plane];
        let sparse = &planes.sparse[step * plane..][..plane];
        match &mut self.state {
            State::Plan(plan) => plan
                .step(voxel, sparse, depth, trust)
                .map_err(failed(self.model)),
            State::Candle(sequence, network) => {
                let (h, w) = (self.layout.height, self.layout.width);
                // Sparse depth stays here: completing it by the nearest return is the processor's.
                let given = (|| {
                    Ok::<_, candle_core::Error>((
                        Tensor::from_slice(voxel, (1, bins, h, w), network.device())?,
                        Tensor::from_slice(sparse, (1, 1, h, w), &Device::Cpu)?,
                    ))
                })();
                let (voxel, sparse) = given.map_err(failed(self.model))?;
                let out = sequence.step(&voxel, &sparse).map_err(failed(self.model))?;
                for (tensor, into) in [(&out.depth, depth), (&out.confidence, trust)] {
                    let values = tensor
                        .flatten_all()
                        .and_then(|t| t.to_vec1::<f32>())
                        .map_err(failed(self.model))?;
                    into.copy_from_slice(&values);
                }
                Ok(())
            }
        }
    }
}

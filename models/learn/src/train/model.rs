//! The numbers that training changes: one variable per tensor, and their running average.

use std::collections::BTreeMap;

use candle_core::{Device, Tensor, Var};
use noctule_erunet::{Config, Network, NetworkError, Norms, Pass, Role, Weights, WeightsError, slots};

use crate::settings::Kind;

/// Share of a batch's statistics in the running ones after it (PyTorch's momentum).
const STATISTICS_SHARE: f64 = 0.1;

/// A network's tensors as variables.
pub(super) struct Model {
    config: Config,
    device: Device,
    vars: BTreeMap<String, Var>,
    roles: BTreeMap<String, Role>,
}

impl Model {
    pub(super) fn new(config: &Config, weights: &Weights) -> Result<Self, WeightsError> {
        weights.check(config)?;
        let vars = weights
            .tensors()
            .iter()
            .map(|(name, tensor)| Ok((name.clone(), Var::from_tensor(&tensor.copy()?)?)))
            .collect::<candle_core::Result<_>>()?;
        let roles = slots(config)?.into_iter().map(|slot| (slot.name, slot.role));
        Ok(Self {
            config: config.clone(),
            device: weights.device(),
            vars,
            roles: roles.collect(),
        })
    }

    pub(super) fn config(&self) -> &Config {
        &self.config
    }

    pub(super) fn device(&self) -> &Device {
        &self.device
    }

    fn is_trained(&self, kind: Kind, name: &str) -> bool {
        self.roles.get(name) == Some(&Role::Trained) && kind.trains(name)
    }

    /// The variables that `kind` trains, by name.
    pub(super) fn trained(&self, kind: Kind) -> Vec<(String, Var)> {
        self.vars
            .iter()
            .filter(|(name, _)| self.is_trained(kind, name))
            .map(|(name, var)| (name.clone(), var.clone()))
            .collect()
    }

    /// A network that follows the variables; gradients reach those that `kind` trains, no others.
    pub(super) fn network(&self, kind: Kind) -> Result<Network, NetworkError> {
        let tensors = self
            .vars
            .iter()
            .map(|(name, var)| {
                let tensor = if self.is_trained(kind, name) {
                    var.as_tensor().clone()
                } else {
                    var.as_detached_tensor()
                };
                (name.clone(), tensor)
            })
            .collect();
        let weights = Weights::from_tensors(&self.config, tensors, &self.device)?;
        Network::new(&self.config, &weights, Norms::Keep)
    }

    /// Moves the running statistics towards those that a training pass collected.
    pub(super) fn follow(&self, pass: &Pass) -> candle_core::Result<()> {
        for (name, moments) in pass.moments() {
            for (statistic, seen) in [
                ("running_mean", &moments.mean),
                ("running_var", &moments.variance),
            ] {
                let Some(var) = self.vars.get(&format!("{name}.{statistic}")) else {
                    candle_core::bail!("batch statistics of {name}, which has none to keep");
                };
                let kept = (var.as_tensor() * (1.0 - STATISTICS_SHARE))?;
                var.set(&(kept + (seen * STATISTICS_SHARE)?)?.detach())?;
            }
        }
        Ok(())
    }

    /// Copies of all tensors as they are now.
    pub(super) fn tensors(&self) -> candle_core::Result<BTreeMap<String, Tensor>> {
        self.vars
            .iter()
            .map(|(name, var)| Ok((name.clone(), var.as_detached_tensor().copy()?)))
            .collect()
    }
}

/// Averaged weights: what is validated and shipped.
pub(super) struct Average {
    tensors: BTreeMap<String, Tensor>,
    keep: f64,
}

impl Average {
    /// Starts at the model's own weights; `keep` of the old average stays at each step.
    pub(super) fn new(model: &Model, keep: f64) -> candle_core::Result<Self> {
        Ok(Self {
            tensors: model.tensors()?,
            keep,
        })
    }

    /// Goes on from stored tensors.
    pub(super) fn from_tensors(tensors: BTreeMap<String, Tensor>, keep: f64) -> Self {
        Self { tensors, keep }
    }

    /// Takes in the weights after step number `step` (from 1); early steps count for more, so that
    /// the start is forgotten.
    pub(super) fn take(&mut self, model: &Model, step: u64) -> candle_core::Result<()> {
        let keep = self.keep.min((step as f64) / (step as f64 + 9.0));
        for (name, average) in &mut self.tensors {
            let now = model.vars[name].as_detached_tensor();
            *average = if model.roles.get(name) == Some(&Role::Fixed) {
                now.copy()?
            } else {
                ((&*average * keep)? + (now * (1.0 - keep))?)?
            };
        }
        Ok(())
    }

    pub(super) fn tensors(&self) -> &BTreeMap<String, Tensor> {
        &self.tensors
    }

    /// As a weights file would hold them.
    pub(super) fn weights(&self, model: &Model) -> Result<Weights, WeightsError> {
        Weights::from_tensors(&model.config, self.tensors.clone(), &model.device)
    }
}

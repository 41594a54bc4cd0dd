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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::batch::Batch;
    use crate::cache::Example;
    use crate::settings::{Domain, Loss};
    use crate::train::batch_loss;
    use noctule_erunet::Variant;
    use noctule_world::Tier;

    /// A small network away from its start, where the zero head of restoration passes nothing on.
    fn model(config: &Config) -> Model {
        let weights = Weights::initial(config, 4, &Device::Cpu).expect("a network");
        let mut tensors = weights.tensors().clone();
        for (name, tensor) in &mut tensors {
            if name.ends_with("recon.conv2.weight") {
                *tensor = (tensor.ones_like().expect("shape") * 0.05).expect("values");
            }
        }
        let weights = Weights::from_tensors(config, tensors, &Device::Cpu).expect("fits");
        Model::new(config, &weights).expect("fits")
    }

    /// Every trained tensor gets a finite gradient that is not zero, no other gets any.
    #[test]
    fn gradients_reach_what_a_stage_trains_and_nothing_else() {
        let example = Example::render(6, Tier::B, 32).expect("small");
        let pictures = Some((Domain::Linear, 0.25));
        let batch = Batch::whole(&example, pictures, 80.0).expect("small");
        let inputs = batch.to_device(&Device::Cpu).expect("small");
        for (member, variant) in [
            ("tiny", Variant::Full),
            ("xs", Variant::Full),
            ("xs", Variant::NoEfr),
            ("xs", Variant::NoHgcm),
        ] {
            let config = Config::member(member).expect("known").with_steps(8);
            let config = config.with_variant(variant);
            let model = model(&config);
            for kind in [Kind::Restore, Kind::Complete, Kind::Together, Kind::Joint] {
                if kind == Kind::Restore && !config.has_efr() {
                    continue;
                }
                let network = model.network(kind).expect("fits");
                let mut pass = match kind.uses_batch_statistics() {
                    true => Pass::training(),
                    false => Pass::plain(),
                };
                let loss = batch_loss(&network, kind, &inputs, &Loss::default(), &mut pass);
                let gradients = loss.expect("fits").total.backward().expect("fits");
                let trained: BTreeMap<String, Var> = model.trained(kind).into_iter().collect();
                assert!(!trained.is_empty());
                for (name, var) in &model.vars {
                    let about = format!("{member} {variant:?} stage {} {name}", kind.name());
                    let found = gradients.get(var);
                    if !trained.contains_key(name) {
                        assert!(found.is_none(), "{about} is frozen");
                        continue;
                    }
                    let found = found.unwrap_or_else(|| panic!("{about} gets none"));
                    let found: Vec<f32> = found
                        .flatten_all()
                        .and_then(|g| g.to_vec1())
                        .expect("values");
                    assert!(found.iter().all(|g| g.is_finite()), "{about}");
                    assert!(found.iter().any(|g| *g != 0.0), "{about} is zero");
                }
            }
        }
    }

    /// The running statistics move by a tenth towards the batch's; networks see it at once.
    #[test]
    fn statistics_follow_and_networks_follow_them() {
        let config = Config::tiny();
        let model = model(&config);
        let network = model.network(Kind::Complete).expect("fits");
        let zeros = |shape: &[usize]| {
            Tensor::ones(shape, candle_core::DType::F32, &Device::Cpu).expect("small")
        };
        let (blur, voxel) = (zeros(&[1, 3, 16, 16]), zeros(&[1, 3, 5, 16, 16]));
        let sparse = zeros(&[1, 3, 1, 16, 16]);
        let run = |pass: &mut Pass| -> Vec<f32> {
            let clear = network.restore(&blur, &voxel, pass).expect("fits");
            let outputs = network.complete(&clear, &voxel, &sparse, pass).expect("fits");
            outputs.depth.flatten_all().and_then(|d| d.to_vec1()).expect("values")
        };
        let mut pass = Pass::training();
        run(&mut pass);
        let before = run(&mut Pass::plain());
        let name = "rdu.bott.bn.running_mean";
        let old: Vec<f32> = model.vars[name].to_vec1().expect("values");
        model.follow(&pass).expect("known");
        let new: Vec<f32> = model.vars[name].to_vec1().expect("values");
        let (_, moments) = pass.moments().find(|(n, _)| *n == "rdu.bott.bn").expect("seen");
        let seen: Vec<f32> = moments.mean.to_vec1().expect("values");
        for ((old, new), seen) in old.iter().zip(&new).zip(&seen) {
            assert!((new - (0.9 * old + 0.1 * seen)).abs() < 1e-6);
        }
        assert_ne!(run(&mut Pass::plain()), before);
    }

    #[test]
    fn the_average_forgets_the_start_and_then_lags() {
        let model = model(&Config::tiny());
        let mut average = Average::new(&model, 0.5).expect("copies");
        let name = "rdu.head2.bias";
        let set = |value: f32| {
            let ones = model.vars[name].ones_like().expect("shape");
            model.vars[name].set(&(ones * f64::from(value)).expect("values")).expect("fits");
        };
        let held = |average: &Average| -> f32 {
            average.tensors()[name].to_vec1::<f32>().expect("values")[0]
        };
        set(1.0);
        average.take(&model, 1).expect("fits");
        assert!((held(&average) - 0.9).abs() < 1e-6, "a tenth of the start is left");
        set(3.0);
        average.take(&model, 1000).expect("fits");
        assert!((held(&average) - 1.95).abs() < 1e-5);
    }
}

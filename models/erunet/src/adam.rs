//! Adam with bias correction and clipping by the global norm (Kingma and Ba, 2015, algorithm 1).
//!
//! On the processor a variable is updated in one pass over its values, on other devices in tensor
//! operations; both do the same arithmetic.

use std::collections::BTreeMap;

use candle_core::backprop::GradStore;
use candle_core::{DType, Device, Tensor, Var};
use noctule_kernels::{AdamRates, adam_update};
use thiserror::Error;

use crate::slices::values;

/// Decay rates and the guard against division by zero.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdamOptions {
    /// Decay of the mean of gradients, 0 to 1.
    pub beta1: f64,
    /// Decay of the mean of squared gradients, 0 to 1.
    pub beta2: f64,
    /// Added to the root of the mean of squares.
    pub eps: f64,
}

impl Default for AdamOptions {
    fn default() -> Self {
        Self {
            beta1: 0.9,
            beta2: 0.999,
            eps: 1e-8,
        }
    }
}

/// Why an optimiser could not take a step or a state.
#[derive(Debug, Error)]
pub enum AdamError {
    /// A stored state lacks a moment.
    #[error("the optimiser's state lacks {name}")]
    Missing {
        /// The moment, such as `m/rdu.head2.bias`.
        name: String,
    },
    /// A stored moment has another shape than its variable.
    #[error("the optimiser's state holds {name} as {actual:?}, wanted {wanted:?}")]
    Shape {
        /// The moment.
        name: String,
        /// Its dimensions.
        actual: Vec<usize>,
        /// Those of the variable.
        wanted: Vec<usize>,
    },
    /// A stored moment belongs to no variable.
    #[error("the optimiser's state holds {name}, which belongs to no variable")]
    Unknown {
        /// The moment.
        name: String,
    },
    /// The tensor library failed.
    #[error("tensor operation failed: {0}")]
    Tensor(#[from] candle_core::Error),
}

/// What has to be stored to go on later as if nothing had happened.
#[derive(Debug, Clone)]
pub struct AdamState {
    /// Steps taken.
    pub steps: u64,
    /// Means of gradients (`m/NAME`) and of their squares (`v/NAME`), shaped as the variables.
    pub moments: BTreeMap<String, Tensor>,
}

struct Slot {
    name: String,
    var: Var,
    mean: Tensor,
    square: Tensor,
}

/// The optimiser of a fixed set of variables in single precision.
pub struct Adam {
    slots: Vec<Slot>,
    options: AdamOptions,
    steps: u64,
}

impl Adam {
    /// Starts with moments of zero. Variables may lie on any device.
    pub fn new(vars: Vec<(String, Var)>, options: AdamOptions) -> Result<Self, AdamError> {
        let slots = vars
            .into_iter()
            .map(|(name, var)| {
                let zeros = || Tensor::zeros(var.shape(), DType::F32, var.device());
                Ok(Slot {
                    mean: zeros()?,
                    square: zeros()?,
                    name,
                    var,
                })
            })
            .collect::<Result<_, AdamError>>()?;
        Ok(Self {
            slots,
            options,
            steps: 0,
        })
    }

    /// Steps taken so far.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Moves every variable that has a gradient in `grads`; the others, and their moments, stay.
    ///
    /// Gradients are scaled to a common norm of `clip_norm` where theirs is larger. Returns the
    /// norm before clipping; where that is not finite, nothing is changed and no step is counted.
    pub fn step(
        &mut self,
        grads: &GradStore,
        lr: f64,
        clip_norm: Option<f64>,
    ) -> Result<f64, AdamError> {
        let norm = self.norm(grads)?;
        if !norm.is_finite() {
            return Ok(norm);
        }
        self.steps += 1;
        let clip = match clip_norm {
            Some(limit) if norm > limit => limit / norm,
            _ => 1.0,
        };
        let rates = self.rates(lr, clip);
        for slot in &mut self.slots {
            let Some(gradient) = grads.get(&slot.var) else {
                continue;
            };
            if slot.var.device().is_cpu() {
                slot.step_in_one_pass(gradient, rates)?;
            } else {
                slot.step_in_tensors(gradient, rates)?;
            }
        }
        Ok(norm)
    }

    /// Root of the sum of squares over all gradients of our variables.
    fn norm(&self, grads: &GradStore) -> Result<f64, AdamError> {
        let mut sum = 0.0;
        for slot in &self.slots {
            let Some(gradient) = grads.get(&slot.var) else {
                continue;
            };
            sum += if gradient.device().is_cpu() {
                values(gradient, |gradient| {
                    gradient.iter().map(|g| f64::from(*g).powi(2)).sum::<f64>()
                })?
            } else {
                f64::from(gradient.sqr()?.sum_all()?.to_scalar::<f32>()?)
            };
        }
        Ok(sum.sqrt())
    }

    #[allow(
        clippy::cast_possible_truncation,
        reason = "step counts fit, factors are rounded to single precision"
    )]
    fn rates(&self, lr: f64, clip: f64) -> AdamRates {
        let AdamOptions { beta1, beta2, eps } = self.options;
        let steps = self.steps.min(i32::MAX as u64) as i32;
        AdamRates {
            beta1: beta1 as f32,
            beta2: beta2 as f32,
            eps: eps as f32,
            gain: clip as f32,
            step: (lr / (1.0 - beta1.powi(steps))) as f32,
            spread: (1.0 / (1.0 - beta2.powi(steps))).sqrt() as f32,
        }
    }

    /// The state as it is now; tensors are copies that later steps do not change.
    pub fn state(&self) -> Result<AdamState, AdamError> {
        let mut moments = BTreeMap::new();
        for slot in &self.slots {
            moments.insert(format!("m/{}", slot.name), slot.mean.copy()?);
            moments.insert(format!("v/{}", slot.name), slot.square.copy()?);
        }
        Ok(AdamState {
            steps: self.steps,
            moments,
        })
    }

    /// Goes on from a stored state, which must hold exactly the moments of these variables.
    /// On an error nothing has changed.
    pub fn restore(&mut self, state: &AdamState) -> Result<(), AdamError> {
        let take = |name: String, slot: &Slot| match state.moments.get(&name) {
            None => Err(AdamError::Missing { name }),
            Some(moment) if moment.dims() != slot.var.dims() => Err(AdamError::Shape {
                name,
                actual: moment.dims().to_vec(),
                wanted: slot.var.dims().to_vec(),
            }),
            Some(moment) => Ok(moment
                .to_device(slot.var.device())?
                .to_dtype(DType::F32)?
                .copy()?),
        };
        let moments: Vec<(Tensor, Tensor)> = self
            .slots
            .iter()
            .map(|slot| {
                let mean = take(format!("m/{}", slot.name), slot)?;
                Ok((mean, take(format!("v/{}", slot.name), slot)?))
            })
            .collect::<Result<_, AdamError>>()?;
        let is_ours = |name: &str| {
            let bare = name.strip_prefix("m/").or_else(|| name.strip_prefix("v/"));
            bare.is_some_and(|bare| self.slots.iter().any(|slot| slot.name == bare))
        };
        if let Some(name) = state.moments.keys().find(|name| !is_ours(name)) {
            return Err(AdamError::Unknown { name: name.clone() });
        }
        for (slot, (mean, square)) in self.slots.iter_mut().zip(moments) {
            (slot.mean, slot.square) = (mean, square);
        }
        self.steps = state.steps;
        Ok(())
    }
}

impl Slot {
    fn step_in_one_pass(&mut self, gradient: &Tensor, rates: AdamRates) -> Result<(), AdamError> {
        let copy = |tensor: &Tensor| values(tensor, <[f32]>::to_vec);
        let mut weights = copy(&self.var)?;
        let (mut mean, mut square) = (copy(&self.mean)?, copy(&self.square)?);
        values(gradient, |gradient| {
            adam_update(&mut weights, &mut mean, &mut square, gradient, rates);
        })?;
        let tensor = |values| Tensor::from_vec(values, self.var.shape(), &Device::Cpu);
        (self.mean, self.square) = (tensor(mean)?, tensor(square)?);
        Ok(self.var.set(&tensor(weights)?)?)
    }

    fn step_in_tensors(&mut self, gradient: &Tensor, rates: AdamRates) -> Result<(), AdamError> {
        let AdamRates { beta1, beta2, .. } = rates;
        let mix = |old: &Tensor, new: &Tensor, beta: f32| {
            let beta = f64::from(beta);
            (old * beta)? + (new * (1.0 - beta))?
        };
        let gradient = (gradient * f64::from(rates.gain))?;
        self.mean = mix(&self.mean, &gradient, beta1)?;
        self.square = mix(&self.square, &gradient.sqr()?, beta2)?;
        let spread = self.square.sqrt()?;
        let spread = spread.affine(f64::from(rates.spread), f64::from(rates.eps))?;
        let change = ((&self.mean / spread)? * f64::from(rates.step))?;
        Ok(self.var.set(&(self.var.as_tensor() - change)?)?)
    }
}

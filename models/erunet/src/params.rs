//! Where layers get their tensors: a cursor over dotted names, such as `rdu.dec0.conf.weight`.
//!
//! The same constructors serve two purposes. Over given tensors they build a network; over a
//! recording source they write down which tensors the network wants, so that the list of names
//! in a weights file and the code that reads them cannot disagree.

use std::cell::RefCell;
use std::collections::BTreeMap;

use candle_core::{DType, Device, Result, Tensor, bail};

/// How a tensor starts before any training.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Init {
    /// Gaussian of standard deviation `gain * sqrt(2 / fan_in)`.
    Normal {
        /// Factor on the usual spread; small for branches that should start as near-identities.
        gain: f64,
    },
    /// One value throughout.
    Constant(f32),
    /// The fixed Fourier-Bessel filters of this decoder level.
    Atoms {
        /// Pyramid level, 0 to 3.
        level: usize,
    },
}

/// What training does with a tensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// Changed by gradients; counted as a parameter.
    Trained,
    /// A running mean or variance of a batch normalisation.
    Statistic,
    /// Never changes.
    Fixed,
}

/// One tensor a network wants: the entry of a weights file.
#[derive(Debug, Clone, PartialEq)]
pub struct Slot {
    /// Dotted name, the key in the weights file.
    pub name: String,
    /// Dimensions, outermost first.
    pub shape: Vec<usize>,
    /// What it holds before training.
    pub init: Init,
    /// What training does with it.
    pub role: Role,
}

impl Slot {
    /// Number of values.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Whether the tensor has no values; no valid configuration asks for one.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// What to do with batch normalisations while building.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Norms {
    /// Merge each into the convolution before it: fewer passes, for inference only.
    Fold,
    /// Leave weight, bias, mean and variance as tensors of their own: for training.
    Keep,
}

pub(crate) enum Source<'a> {
    Given(&'a BTreeMap<String, Tensor>),
    Recording(RefCell<Vec<Slot>>),
}

/// A cursor at one prefix of names.
pub(crate) struct Params<'a> {
    source: &'a Source<'a>,
    path: String,
    pub(crate) norms: Norms,
}

impl<'a> Params<'a> {
    pub(crate) fn root(source: &'a Source<'a>, norms: Norms) -> Self {
        Self {
            source,
            path: String::new(),
            norms,
        }
    }

    /// The cursor one name further down.
    pub(crate) fn at(&self, name: &str) -> Self {
        Self {
            source: self.source,
            path: self.full_name(name),
            norms: self.norms,
        }
    }

    /// The dotted prefix of this cursor.
    pub(crate) fn path(&self) -> &str {
        &self.path
    }

    fn full_name(&self, name: &str) -> String {
        if self.path.is_empty() {
            name.into()
        } else {
            format!("{}.{name}", self.path)
        }
    }

    /// The tensor called `name` under this cursor. A recording source hands out zeros that own
    /// a single value, whatever their shape.
    pub(crate) fn tensor(
        &self,
        name: &str,
        shape: &[usize],
        init: Init,
        role: Role,
    ) -> Result<Tensor> {
        let name = self.full_name(name);
        match self.source {
            Source::Given(tensors) => match tensors.get(&name) {
                None => bail!("tensor {name} is missing"),
                Some(tensor) if tensor.dims() != shape => {
                    bail!("tensor {name} is {:?}, wanted {shape:?}", tensor.dims())
                }
                Some(tensor) => Ok(tensor.clone()),
            },
            Source::Recording(slots) => {
                slots.borrow_mut().push(Slot {
                    name,
                    shape: shape.to_vec(),
                    init,
                    role,
                });
                Tensor::zeros((), DType::F32, &Device::Cpu)?.broadcast_as(shape)
            }
        }
    }
}

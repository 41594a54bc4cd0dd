//! The layers both halves of a plan are made of, drawn from named weights.

use noctule_kernels::{Activation, Builder, Conv, Feature, Intake, Size, Store};

use super::{Slices, any_step, builder_with_slices};
use crate::config::Config;
use crate::weights::Weights;
use candle_core::Result;

/// Added to a variance before its root, as in the definition.
const NORM_EPSILON: f32 = 1e-5;

/// A feature and its size.
#[derive(Clone, Copy)]
pub(super) struct Map {
    pub(super) feature: Feature,
    pub(super) size: Size,
}

/// Weights of one convolution: `[outputs, inputs, kernel, kernel]` and `[outputs]`.
pub(super) struct Layer {
    pub(super) weight: Vec<f32>,
    pub(super) bias: Vec<f32>,
    pub(super) inputs: usize,
    pub(super) kernel: usize,
}

/// What follows a convolution.
#[derive(Clone, Copy)]
pub(super) struct Then {
    pub(super) stride: usize,
    pub(super) gain: Option<Map>,
    pub(super) residual: Option<Map>,
    pub(super) activation: Activation,
    pub(super) store: Store,
    /// Where the result goes; a feature of its own where there is none.
    pub(super) into: Option<Map>,
}

impl Then {
    /// Stride 1 and an activation.
    pub(super) const fn new(activation: Activation) -> Self {
        Self {
            stride: 1,
            gain: None,
            residual: None,
            activation,
            store: Store::Direct,
            into: None,
        }
    }

    pub(super) const fn halving(self) -> Self {
        Self { stride: 2, ..self }
    }

    pub(super) const fn plus(self, residual: Map) -> Self {
        Self {
            residual: Some(residual),
            ..self
        }
    }

    pub(super) const fn times(self, gain: Map) -> Self {
        Self {
            gain: Some(gain),
            ..self
        }
    }

    pub(super) const fn stored(self, store: Store) -> Self {
        Self { store, ..self }
    }

    pub(super) const fn into(self, map: Map) -> Self {
        Self {
            into: Some(map),
            ..self
        }
    }
}

/// A program in the making.
pub(super) struct Draft<'a> {
    pub(super) builder: Builder,
    pub(super) config: &'a Config,
    pub(super) slices: Slices,
    pub(super) size: Size,
    weights: &'a Weights,
    voxel: Option<Map>,
}

impl<'a> Draft<'a> {
    pub(super) fn new(
        config: &'a Config,
        weights: &'a Weights,
        height: usize,
        width: usize,
    ) -> Self {
        let size = Size { height, width };
        let (builder, slices) = builder_with_slices(config, size.area());
        Self {
            builder,
            config,
            slices,
            size,
            weights,
            voxel: None,
        }
    }

    /// All values of a tensor.
    pub(super) fn values(&self, name: &str) -> Result<Vec<f32>> {
        match self.weights.tensors().get(name) {
            Some(tensor) => tensor.flatten_all()?.to_vec1(),
            None => candle_core::bail!("tensor {name} is missing"),
        }
    }

    fn dims(&self, name: &str) -> Result<(usize, usize)> {
        match self.weights.tensors().get(name) {
            Some(tensor) => {
                let (_, inputs, kernel, _) = tensor.dims4()?;
                Ok((inputs, kernel))
            }
            None => candle_core::bail!("tensor {name} is missing"),
        }
    }

    /// A biased convolution.
    pub(super) fn layer(&self, path: &str) -> Result<Layer> {
        let weight = format!("{path}.weight");
        let (inputs, kernel) = self.dims(&weight)?;
        Ok(Layer {
            weight: self.values(&weight)?,
            bias: self.values(&format!("{path}.bias"))?,
            inputs,
            kernel,
        })
    }

    /// An unbiased convolution with its norm folded in.
    pub(super) fn normed(&self, path: &str, conv: &str, norm: &str) -> Result<Layer> {
        let name = format!("{path}.{conv}.weight");
        let (inputs, kernel) = self.dims(&name)?;
        let mut weight = self.values(&name)?;
        let of = |part: &str| self.values(&format!("{path}.{norm}.{part}"));
        let (scale, shift) = (of("weight")?, of("bias")?);
        let (mean, variance) = (of("running_mean")?, of("running_var")?);
        let mut bias = Vec::with_capacity(scale.len());
        let filters = weight.chunks_mut(inputs * kernel * kernel);
        for (o, filter) in filters.enumerate() {
            let factor = scale[o] / (variance[o] + NORM_EPSILON).sqrt();
            filter.iter_mut().for_each(|w| *w *= factor);
            bias.push(shift[o] - mean[o] * factor);
        }
        Ok(Layer {
            weight,
            bias,
            inputs,
            kernel,
        })
    }

    /// Adds a convolution over the concatenation of `inputs`; profiles call it `path`.
    pub(super) fn conv(&mut self, path: &str, layer: &Layer, inputs: &[Map], then: Then) -> Map {
        let scale = match then.store {
            Store::Direct => 1,
            Store::Shuffle | Store::Nearest => 2,
        };
        let from = inputs[0].size;
        let size = Size {
            height: from.height / then.stride * scale,
            width: from.width / then.stride * scale,
        };
        // Several biases for one filter are those of the steps.
        let outputs = layer.weight.len() / (layer.inputs * layer.kernel * layer.kernel);
        let channels = match then.store {
            Store::Shuffle => outputs / 4,
            Store::Direct | Store::Nearest => outputs,
        };
        let output = then.into.unwrap_or_else(|| Map {
            feature: self.builder.feature(channels, size),
            size,
        });
        let features: Vec<Feature> = inputs.iter().map(|map| map.feature).collect();
        self.builder.set_label(path);
        self.builder.conv(&Conv {
            inputs: &features,
            weight: &layer.weight,
            bias: &layer.bias,
            kernel: layer.kernel,
            stride: then.stride,
            gain: then.gain.map(|map| map.feature),
            residual: then.residual.map(|map| map.feature),
            activation: then.activation,
            store: then.store,
            output: output.feature,
        });
        output
    }

    /// A convolution by name.
    pub(super) fn named(&mut self, path: &str, inputs: &[Map], then: Then) -> Result<Map> {
        let layer = self.layer(path)?;
        Ok(self.conv(path, &layer, inputs, then))
    }

    /// Convolution, norm, rectifier: `path.conv` and `path.bn`.
    pub(super) fn conv_bn(&mut self, path: &str, inputs: &[Map], stride: usize) -> Result<Map> {
        let layer = self.normed(path, "conv", "bn")?;
        let then = Then {
            stride,
            ..Then::new(Activation::Relu)
        };
        Ok(self.conv(path, &layer, inputs, then))
    }

    /// `count` residual blocks of the restoration network.
    pub(super) fn res_e(&mut self, path: &str, count: usize, mut x: Map) -> Result<Map> {
        for index in 0..count {
            let first = Then::new(Activation::LeakyRelu);
            let h = self.named(&format!("{path}.{index}.conv1"), &[x], first)?;
            let second = Then::new(Activation::None).plus(x);
            x = self.named(&format!("{path}.{index}.conv2"), &[h], second)?;
        }
        Ok(x)
    }

    /// `count` residual blocks of the depth network.
    pub(super) fn res_d(&mut self, path: &str, count: usize, mut x: Map) -> Result<Map> {
        for index in 0..count {
            let path = format!("{path}.{index}");
            let first = self.normed(&path, "conv1", "bn1")?;
            let then = Then::new(Activation::Relu);
            let h = self.conv(&format!("{path}.conv1"), &first, &[x], then);
            let second = self.normed(&path, "conv2", "bn2")?;
            x = self.conv(&format!("{path}.conv2"), &second, &[h], then.plus(x));
        }
        Ok(x)
    }

    /// 1x1 convolution and pixel shuffle: `path.conv`.
    pub(super) fn up(&mut self, path: &str, x: Map, activation: Activation) -> Result<Map> {
        let then = Then::new(activation).stored(Store::Shuffle);
        self.named(&format!("{path}.conv"), &[x], then)
    }

    /// The voxels of the step at hand; taken in once, however many parts ask.
    pub(super) fn voxel(&mut self) -> Map {
        if let Some(map) = self.voxel {
            return map;
        }
        self.builder.set_passes(any_step());
        let map = Map {
            feature: self.builder.feature(self.config.bins, self.size),
            size: self.size,
        };
        let from = self.slices.voxel;
        self.builder.set_label("voxel");
        self.builder.take(from, Intake::Planes, map.feature);
        self.voxel = Some(map);
        map
    }
}

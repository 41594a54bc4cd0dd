//! Convolution with zero padding of half the kernel.

use candle_core::{DType, Result, Tensor};
use noctule_kernels::Activation;

use crate::activate::activate;
use crate::conv_cpu::{Window, conv2d};
use crate::params::{Init, Params, Role};

/// Shape and starting values of one convolution; padding is always `kernel / 2`.
#[derive(Clone, Copy)]
pub(crate) struct ConvShape {
    inputs: usize,
    pub(crate) outputs: usize,
    kernel: usize,
    stride: usize,
    bias: Option<f32>,
    gain: f64,
}

impl ConvShape {
    pub(crate) const fn new(kernel: usize, inputs: usize, outputs: usize) -> Self {
        Self {
            inputs,
            outputs,
            kernel,
            stride: 1,
            bias: Some(0.0),
            gain: 1.0,
        }
    }

    /// 3x3, stride 1, biased.
    pub(crate) const fn k3(inputs: usize, outputs: usize) -> Self {
        Self::new(3, inputs, outputs)
    }

    /// 1x1, biased.
    pub(crate) const fn k1(inputs: usize, outputs: usize) -> Self {
        Self::new(1, inputs, outputs)
    }

    pub(crate) const fn halving(self) -> Self {
        Self { stride: 2, ..self }
    }

    pub(crate) const fn unbiased(self) -> Self {
        Self { bias: None, ..self }
    }

    pub(crate) const fn bias_from(self, start: f32) -> Self {
        Self {
            bias: Some(start),
            ..self
        }
    }

    pub(crate) const fn gain(self, gain: f64) -> Self {
        Self { gain, ..self }
    }
}

/// A convolution with zero padding `kernel / 2`.
pub(crate) struct Conv {
    weight: Tensor,
    bias: Option<Tensor>,
    kernel: usize,
    stride: usize,
}

impl Conv {
    pub(crate) fn new(params: &Params<'_>, shape: ConvShape) -> Result<Self> {
        let ConvShape {
            inputs,
            outputs,
            kernel,
            stride,
            bias,
            gain,
        } = shape;
        let dims = [outputs, inputs, kernel, kernel];
        let weight = params.tensor("weight", &dims, Init::Normal { gain }, Role::Trained)?;
        let bias = bias
            .map(|start| params.tensor("bias", &[outputs], Init::Constant(start), Role::Trained))
            .transpose()?;
        Ok(Self {
            weight,
            bias,
            kernel,
            stride,
        })
    }

    /// `x` `[B, I, H, W]`; returns `[B, O, H/stride, W/stride]`.
    pub(crate) fn forward(&self, x: &Tensor) -> Result<Tensor> {
        self.apply(&[x], None, Activation::None)
    }

    /// [`Conv::forward`] and an activation.
    pub(crate) fn activated(&self, x: &Tensor, activation: Activation) -> Result<Tensor> {
        self.apply(&[x], None, activation)
    }

    /// `activation(conv(cat(sources)) + residual)`; sources `[B, channels, H, W]`, whose channels
    /// add up to I, residual and result `[B, O, H/stride, W/stride]`.
    ///
    /// One operation on the processor, candle's own on other devices; both have gradients.
    pub(crate) fn apply(
        &self,
        sources: &[&Tensor],
        residual: Option<&Tensor>,
        activation: Activation,
    ) -> Result<Tensor> {
        let Self {
            weight,
            bias,
            kernel,
            stride,
        } = self;
        if is_plain(weight) && sources.iter().all(|x| is_plain(x)) {
            let window = Window {
                kernel: *kernel,
                stride: *stride,
                activation,
            };
            return conv2d(sources, weight, bias.as_ref(), residual, window);
        }
        let joined;
        let x = if let [x] = sources {
            *x
        } else {
            joined = Tensor::cat(sources, 1)?;
            &joined
        };
        let mut y = if *kernel == 1 && *stride == 1 {
            self.pointwise(x)?
        } else {
            x.contiguous()?.conv2d(weight, kernel / 2, *stride, 1, 1)?
        };
        if let Some(bias) = bias {
            y = y.broadcast_add(&bias.reshape((1, (), 1, 1))?)?;
        }
        if let Some(residual) = residual {
            y = (y + residual)?;
        }
        activate(&y, activation)
    }

    /// A 1x1 convolution is a matrix product per picture.
    fn pointwise(&self, x: &Tensor) -> Result<Tensor> {
        let (b, _, h, w) = x.dims4()?;
        let (outputs, inputs, _, _) = self.weight.dims4()?;
        let pixels = x.contiguous()?.reshape((b, inputs, h * w))?;
        let weight = self.weight.reshape((1, outputs, inputs))?;
        let weight = if b == 1 {
            weight
        } else {
            weight.broadcast_as((b, outputs, inputs))?
        };
        weight
            .contiguous()?
            .matmul(&pixels)?
            .reshape((b, outputs, h, w))
    }

    /// The convolution whose result is scaled and shifted per channel, each `[O]`.
    pub(crate) fn folded(&self, scale: &Tensor, shift: &Tensor) -> Result<Self> {
        let weight = self.weight.broadcast_mul(&scale.reshape(((), 1, 1, 1))?)?;
        let bias = match &self.bias {
            None => shift.clone(),
            Some(bias) => ((bias * scale)? + shift)?,
        };
        Ok(Self {
            weight,
            bias: Some(bias),
            ..*self
        })
    }
}

/// Whether the operations of this crate take `tensor`.
pub(crate) fn is_plain(tensor: &Tensor) -> bool {
    tensor.device().is_cpu() && tensor.dtype() == DType::F32
}

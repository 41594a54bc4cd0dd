//! Convolution with zero padding of half the kernel.

use candle_core::{Result, Tensor};

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
        let y = if self.kernel == 1 && self.stride == 1 {
            self.pointwise(x)?
        } else {
            self.windowed(&x.contiguous()?)?
        };
        match &self.bias {
            None => Ok(y),
            Some(bias) => y.broadcast_add(&bias.reshape((1, (), 1, 1))?),
        }
    }

    /// Gradients and other devices take candle's convolution, the rest the quicker one.
    fn windowed(&self, x: &Tensor) -> Result<Tensor> {
        let Self {
            weight,
            kernel,
            stride,
            ..
        } = self;
        if x.device().is_cpu() && !x.track_op() && !weight.track_op() {
            return conv2d(
                x,
                weight,
                Window {
                    kernel: *kernel,
                    stride: *stride,
                },
            );
        }
        x.conv2d(weight, kernel / 2, *stride, 1, 1)
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
    pub(crate) fn folded(self, scale: &Tensor, shift: &Tensor) -> Result<Self> {
        let weight = self.weight.broadcast_mul(&scale.reshape(((), 1, 1, 1))?)?;
        let bias = match &self.bias {
            None => shift.clone(),
            Some(bias) => ((bias * scale)? + shift)?,
        };
        Ok(Self {
            weight,
            bias: Some(bias),
            ..self
        })
    }
}

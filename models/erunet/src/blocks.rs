//! The small layers every part is made of: convolutions, residual blocks, upsampling, activations.
//!
//! Everything here is made of operations with a correct backward pass. Nearest upsampling is a
//! reshape and a broadcast, because candle's own operation overwrites gradients.

use candle_core::{D, Result, Tensor, bail};

use crate::conv_cpu::{Window, conv2d};
use crate::params::{Init, Norms, Params, Role};
use crate::pass::{Moments, Pass};

/// Slope of the leaky rectifier left of zero.
pub(crate) const SLOPE: f64 = 0.1;
/// Added to a variance before its root.
const NORM_EPSILON: f64 = 1e-5;

/// `max(x, 0.1 x)`, any shape.
pub(crate) fn leaky_relu(x: &Tensor) -> Result<Tensor> {
    rectify(x, SLOPE)
}

/// `max(x, 0)`, any shape.
pub(crate) fn relu(x: &Tensor) -> Result<Tensor> {
    if x.track_op() {
        rectify(x, 0.0)
    } else {
        x.relu()
    }
}

/// The slope at exactly zero is the left one: sparse inputs put many pixels there, and candle's
/// own rectifier would take the right one.
fn rectify(x: &Tensor, slope: f64) -> Result<Tensor> {
    let left = (x * slope)?;
    if x.track_op() {
        x.gt(0f32)?.where_cond(x, &left)
    } else {
        x.maximum(&left)
    }
}

/// Logistic function through the hyperbolic tangent: neither value nor gradient overflows.
pub(crate) fn sigmoid(x: &Tensor) -> Result<Tensor> {
    (x * 0.5)?.tanh()?.affine(0.5, 0.5)
}

/// Doubles height and width by repeating pixels: `[B, C, H, W]` to `[B, C, 2H, 2W]`.
pub(crate) fn nearest_2x(x: &Tensor) -> Result<Tensor> {
    let (b, c, h, w) = x.dims4()?;
    x.reshape((b, c, h, 1, w, 1))?
        .broadcast_as((b, c, h, 2, w, 2))?
        .reshape((b, c, 2 * h, 2 * w))
}

/// Shape and starting values of one convolution; padding is always `kernel / 2`.
#[derive(Clone, Copy)]
pub(crate) struct ConvShape {
    inputs: usize,
    outputs: usize,
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
}

/// Batch normalisation over batch and pixels, per channel.
struct BatchNorm {
    name: String,
    weight: Tensor,
    bias: Tensor,
    running_mean: Tensor,
    running_var: Tensor,
}

impl BatchNorm {
    fn new(params: &Params<'_>, channels: usize) -> Result<Self> {
        let tensor =
            |name, start, role| params.tensor(name, &[channels], Init::Constant(start), role);
        Ok(Self {
            name: params.path().into(),
            weight: tensor("weight", 1.0, Role::Trained)?,
            bias: tensor("bias", 0.0, Role::Trained)?,
            running_mean: tensor("running_mean", 0.0, Role::Statistic)?,
            running_var: tensor("running_var", 1.0, Role::Statistic)?,
        })
    }

    /// Scale and shift per channel that normalise with the running statistics, each `[C]`.
    fn affine(&self) -> Result<(Tensor, Tensor)> {
        affine(
            &self.weight,
            &self.bias,
            &self.running_mean,
            &self.running_var,
        )
    }

    /// Shape kept, `[B, C, H, W]`.
    fn forward(&self, x: &Tensor, pass: &mut Pass) -> Result<Tensor> {
        let (scale, shift) = if pass.uses_batch_statistics() {
            let (mean, variance) = self.batch_moments(x, pass)?;
            affine(&self.weight, &self.bias, &mean, &variance)?
        } else {
            self.affine()?
        };
        let per_channel = (1, (), 1, 1);
        x.broadcast_mul(&scale.reshape(per_channel)?)?
            .broadcast_add(&shift.reshape(per_channel)?)
    }

    /// Mean and biased variance of `x` per channel; reports them to `pass`.
    fn batch_moments(&self, x: &Tensor, pass: &mut Pass) -> Result<(Tensor, Tensor)> {
        let channels = x.dim(1)?;
        let rows = x.transpose(0, 1)?.contiguous()?.reshape((channels, ()))?; // [C, B*H*W]
        let mean = rows.mean_keepdim(D::Minus1)?;
        let variance = rows.broadcast_sub(&mean)?.sqr()?.mean(D::Minus1)?;
        let mean = mean.squeeze(D::Minus1)?;
        #[allow(clippy::cast_precision_loss, reason = "a pixel count fits a double")]
        let count = rows.dim(1)? as f64;
        let corrected = (variance.detach() * (count / (count - 1.0).max(1.0)))?;
        pass.collect(
            &self.name,
            Moments {
                mean: mean.detach(),
                variance: corrected,
            },
        );
        Ok((mean, variance))
    }
}

/// Scale and shift, each `[C]`, equal to normalising and then applying weight and bias.
fn affine(
    weight: &Tensor,
    bias: &Tensor,
    mean: &Tensor,
    variance: &Tensor,
) -> Result<(Tensor, Tensor)> {
    let scale = (weight / (variance + NORM_EPSILON)?.sqrt()?)?;
    let shift = (bias - (mean * &scale)?)?;
    Ok((scale, shift))
}

/// A bias-free convolution and its batch normalisation, merged where the network is built to infer.
struct Normed {
    conv: Conv,
    bn: Option<BatchNorm>,
}

impl Normed {
    fn new(params: &Params<'_>, conv: &str, bn: &str, shape: ConvShape) -> Result<Self> {
        let mut merged = Conv::new(&params.at(conv), shape.unbiased())?;
        let norm = BatchNorm::new(&params.at(bn), shape.outputs)?;
        if params.norms == Norms::Keep {
            return Ok(Self {
                conv: merged,
                bn: Some(norm),
            });
        }
        let (scale, shift) = norm.affine()?;
        merged.weight = merged
            .weight
            .broadcast_mul(&scale.reshape(((), 1, 1, 1))?)?;
        merged.bias = Some(shift);
        Ok(Self {
            conv: merged,
            bn: None,
        })
    }

    fn forward(&self, x: &Tensor, pass: &mut Pass) -> Result<Tensor> {
        let y = self.conv.forward(x)?;
        match &self.bn {
            Some(bn) => bn.forward(&y, pass),
            None if pass.uses_batch_statistics() => {
                bail!("batch statistics asked of a network built with folded norms")
            }
            None => Ok(y),
        }
    }
}

/// Convolution, batch normalisation, rectifier.
pub(crate) struct ConvBn(Normed);

impl ConvBn {
    pub(crate) fn new(params: &Params<'_>, shape: ConvShape) -> Result<Self> {
        Normed::new(params, "conv", "bn", shape).map(Self)
    }

    /// `x` `[B, I, H, W]`; returns `[B, O, H/stride, W/stride]`.
    pub(crate) fn forward(&self, x: &Tensor, pass: &mut Pass) -> Result<Tensor> {
        relu(&self.0.forward(x, pass)?)
    }
}

/// Residual block of the restoration network: no norm, `x + conv2(lrelu(conv1(x)))`.
pub(crate) struct ResE {
    conv1: Conv,
    conv2: Conv,
}

impl ResE {
    fn new(params: &Params<'_>, c: usize) -> Result<Self> {
        Ok(Self {
            conv1: Conv::new(&params.at("conv1"), ConvShape::k3(c, c))?,
            conv2: Conv::new(&params.at("conv2"), ConvShape::k3(c, c).gain(0.1))?,
        })
    }

    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        x + self.conv2.forward(&leaky_relu(&self.conv1.forward(x)?)?)?
    }
}

/// A run of [`ResE`]; may be empty, and is then the identity.
pub(crate) struct ResEs(Vec<ResE>);

impl ResEs {
    pub(crate) fn new(params: &Params<'_>, c: usize, blocks: usize) -> Result<Self> {
        (0..blocks)
            .map(|i| ResE::new(&params.at(&i.to_string()), c))
            .collect::<Result<_>>()
            .map(Self)
    }

    /// Shape kept, `[B, C, H, W]`.
    pub(crate) fn forward(&self, x: Tensor) -> Result<Tensor> {
        self.0.iter().try_fold(x, |x, block| block.forward(&x))
    }
}

/// Residual block of the depth network: `relu(x + bn2(conv2(relu(bn1(conv1(x))))))`.
pub(crate) struct ResD {
    first: Normed,
    second: Normed,
}

impl ResD {
    fn new(params: &Params<'_>, c: usize, gain: f64) -> Result<Self> {
        let shape = ConvShape::k3(c, c);
        Ok(Self {
            first: Normed::new(params, "conv1", "bn1", shape)?,
            second: Normed::new(params, "conv2", "bn2", shape.gain(gain))?,
        })
    }

    fn forward(&self, x: &Tensor, pass: &mut Pass) -> Result<Tensor> {
        let y = relu(&self.first.forward(x, pass)?)?;
        relu(&(x + self.second.forward(&y, pass)?)?)
    }
}

/// A run of [`ResD`]; may be empty, and is then the identity.
pub(crate) struct ResDs(Vec<ResD>);

impl ResDs {
    /// Blocks whose second convolution starts at half strength.
    pub(crate) fn new(params: &Params<'_>, c: usize, blocks: usize) -> Result<Self> {
        Self::with_gain(params, c, blocks, 0.5)
    }

    /// Blocks whose second convolution starts at `gain` times the usual strength.
    pub(crate) fn with_gain(
        params: &Params<'_>,
        c: usize,
        blocks: usize,
        gain: f64,
    ) -> Result<Self> {
        (0..blocks)
            .map(|i| ResD::new(&params.at(&i.to_string()), c, gain))
            .collect::<Result<_>>()
            .map(Self)
    }

    /// Shape kept, `[B, C, H, W]`.
    pub(crate) fn forward(&self, x: Tensor, pass: &mut Pass) -> Result<Tensor> {
        self.0
            .iter()
            .try_fold(x, |x, block| block.forward(&x, pass))
    }
}

/// 1x1 convolution to four times the channels, then pixel shuffle by two.
pub(crate) struct Up {
    conv: Conv,
}

impl Up {
    pub(crate) fn new(params: &Params<'_>, inputs: usize, outputs: usize) -> Result<Self> {
        Ok(Self {
            conv: Conv::new(&params.at("conv"), ConvShape::k1(inputs, 4 * outputs))?,
        })
    }

    /// `x` `[B, I, H, W]`; returns `[B, O, 2H, 2W]` with
    /// `out[o, 2y + a, 2x + b] = conv[4 o + 2 a + b, y, x]`.
    pub(crate) fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let y = self.conv.forward(x)?;
        let (b, c, h, w) = y.dims4()?;
        y.reshape((b, c / 4, 2, 2, h, w))?
            .permute((0, 1, 4, 2, 5, 3))? // [B, O, H, 2, W, 2]
            .reshape((b, c / 4, 2 * h, 2 * w))
    }
}

//! The small layers every part is made of: residual blocks, upsampling, activations.
//!
//! Everything here is made of operations with a correct backward pass. Nearest upsampling is a
//! reshape and a broadcast, because candle's own operation overwrites gradients.

use candle_core::{Result, Tensor};
use noctule_kernels::Activation;

use crate::conv::{Conv, ConvShape};
use crate::norm::Normed;
use crate::params::Params;
use crate::pass::Pass;

/// Slope of the leaky rectifier left of zero.
pub(crate) const SLOPE: f64 = 0.1;

/// An activation in tensor operations, any shape.
pub(crate) fn activate(x: &Tensor, activation: Activation) -> Result<Tensor> {
    match activation {
        Activation::None => Ok(x.clone()),
        Activation::Relu => relu(x),
        Activation::LeakyRelu => leaky_relu(x),
        Activation::Tanh => x.tanh(),
        Activation::Sigmoid => sigmoid(x),
    }
}

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

/// `x` plus `low` of half its size, each pixel repeated: `[B, C, H, W]` and `[B, C, H/2, W/2]`.
pub(crate) fn add_nearest_2x(x: &Tensor, low: &Tensor) -> Result<Tensor> {
    x + nearest_2x(low)?
}

/// `gamma * x + beta`, all of one shape.
pub(crate) fn modulate(gamma: &Tensor, x: &Tensor, beta: &Tensor) -> Result<Tensor> {
    (gamma * x)? + beta
}

/// `confidence * x`: `[B, C, H, W]` and `[B, 1, H, W]`.
pub(crate) fn trust(x: &Tensor, confidence: &Tensor) -> Result<Tensor> {
    x.broadcast_mul(confidence)
}

/// `kept + (1 - confidence) * other`: `[B, C, H, W]` twice and `[B, 1, H, W]`.
pub(crate) fn replace_doubted(
    kept: &Tensor,
    other: &Tensor,
    confidence: &Tensor,
) -> Result<Tensor> {
    kept + other.broadcast_mul(&confidence.affine(-1.0, 1.0)?)?
}

/// Convolution, batch normalisation, rectifier.
pub(crate) struct ConvBn(Normed);

impl ConvBn {
    pub(crate) fn new(params: &Params<'_>, shape: ConvShape) -> Result<Self> {
        Normed::new(params, "conv", "bn", shape).map(Self)
    }

    /// `x` `[B, I, H, W]`; returns `[B, O, H/stride, W/stride]`.
    pub(crate) fn forward(&self, x: &Tensor, pass: &mut Pass) -> Result<Tensor> {
        self.forward_joined(&[x], pass)
    }

    /// As [`ConvBn::forward`], of sources whose channels follow one another.
    pub(crate) fn forward_joined(&self, sources: &[&Tensor], pass: &mut Pass) -> Result<Tensor> {
        self.0.apply(sources, None, Activation::Relu, pass)
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
        let y = self.conv1.activated(x, Activation::LeakyRelu)?;
        self.conv2.apply(&[&y], Some(x), Activation::None)
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
        let y = self.first.apply(&[x], None, Activation::Relu, pass)?;
        self.second.apply(&[&y], Some(x), Activation::Relu, pass)
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

/// `[B, 4 C, H, W]` to `[B, C, 2H, 2W]`: four channels become a square of pixels.
fn shuffle_2x(x: &Tensor) -> Result<Tensor> {
    let (b, c, h, w) = x.dims4()?;
    x.reshape((b, c / 4, 2, 2, h, w))?
        .permute((0, 1, 4, 2, 5, 3))? // [B, C, H, 2, W, 2]
        .reshape((b, c / 4, 2 * h, 2 * w))
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
        self.activated(x, Activation::None)
    }

    /// [`Up::forward`] and an activation.
    pub(crate) fn activated(&self, x: &Tensor, activation: Activation) -> Result<Tensor> {
        // The activation goes value by value: before the shuffle or after it is the same.
        shuffle_2x(&self.conv.activated(x, activation)?)
    }
}

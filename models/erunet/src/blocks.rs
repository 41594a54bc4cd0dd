//! The small layers every part is made of: residual blocks and upsampling.
//!
//! Everything here is made of operations with a correct backward pass. Nearest upsampling is a
//! reshape and a broadcast, because candle's own operation overwrites gradients.

use candle_core::{Result, Tensor, bail};
use noctule_kernels::Activation;

use crate::conv::{Conv, ConvShape, is_plain};
use crate::norm::Normed;
use crate::params::Params;
use crate::pass::Pass;
use crate::planes::{AddNearest, Modulate, ReplaceDoubted, Shuffle, Trust};

/// Doubles height and width by repeating pixels: `[B, C, H, W]` to `[B, C, 2H, 2W]`.
pub(crate) fn nearest_2x(x: &Tensor) -> Result<Tensor> {
    let (b, c, h, w) = x.dims4()?;
    x.reshape((b, c, h, 1, w, 1))?
        .broadcast_as((b, c, h, 2, w, 2))?
        .reshape((b, c, 2 * h, 2 * w))
}

fn check(x: &Tensor, dims: &[usize]) -> Result<()> {
    if x.dims() != dims {
        bail!("operand is {:?}, wanted {dims:?}", x.dims());
    }
    Ok(())
}

/// `x` plus `low` of half its size, each pixel repeated: `[B, C, H, W]` and `[B, C, H/2, W/2]`.
pub(crate) fn add_nearest_2x(x: &Tensor, low: &Tensor) -> Result<Tensor> {
    let (b, c, h, w) = low.dims4()?;
    check(x, &[b, c, 2 * h, 2 * w])?;
    if is_plain(x) && is_plain(low) {
        return x.contiguous()?.apply_op2(&low.contiguous()?, AddNearest);
    }
    x + nearest_2x(low)?
}

/// `gamma * x + beta`, all of one shape.
pub(crate) fn modulate(gamma: &Tensor, x: &Tensor, beta: &Tensor) -> Result<Tensor> {
    if is_plain(x) {
        check(gamma, x.dims())?;
        check(beta, x.dims())?;
        let (gamma, beta) = (gamma.contiguous()?, beta.contiguous()?);
        return gamma.apply_op3(&x.contiguous()?, &beta, Modulate);
    }
    (gamma * x)? + beta
}

/// `confidence * x`: `[B, C, H, W]` and `[B, 1, H, W]`.
pub(crate) fn trust(x: &Tensor, confidence: &Tensor) -> Result<Tensor> {
    if is_plain(x) {
        let (b, _, h, w) = x.dims4()?;
        check(confidence, &[b, 1, h, w])?;
        return x.contiguous()?.apply_op2(&confidence.contiguous()?, Trust);
    }
    x.broadcast_mul(confidence)
}

/// `kept + (1 - confidence) * other`: `[B, C, H, W]` twice and `[B, 1, H, W]`.
pub(crate) fn replace_doubted(
    kept: &Tensor,
    other: &Tensor,
    confidence: &Tensor,
) -> Result<Tensor> {
    if is_plain(kept) {
        let (b, _, h, w) = kept.dims4()?;
        check(other, kept.dims())?;
        check(confidence, &[b, 1, h, w])?;
        let (other, confidence) = (other.contiguous()?, confidence.contiguous()?);
        return kept
            .contiguous()?
            .apply_op3(&other, &confidence, ReplaceDoubted);
    }
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
    if is_plain(x) {
        return x.contiguous()?.apply_op1(Shuffle);
    }
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

#[cfg(test)]
mod tests {
    use candle_core::{Device, Var};

    use super::*;

    fn var(shape: &[usize], salt: usize) -> Var {
        let len: usize = shape.iter().product();
        let values = (0..len)
            .map(|i| ((i * 7919 + salt * 104_729 + 13) % 1009) as f32 / 504.5 - 1.0)
            .collect();
        Var::from_vec::<_, f32>(values, shape, &Device::Cpu).unwrap()
    }

    fn read(tensor: &Tensor) -> Vec<f32> {
        tensor.flatten_all().unwrap().to_vec1().unwrap()
    }

    /// Values and all gradients of two ways to compute the same.
    fn assert_same(ours: &Tensor, theirs: &Tensor, vars: &[&Var]) {
        let close = |a: &Tensor, b: &Tensor| {
            assert_eq!(a.dims(), b.dims());
            for (a, b) in read(a).iter().zip(read(b)) {
                assert!((a - b).abs() < 1e-5 * b.abs().max(1.0), "{a} {b}");
            }
        };
        close(ours, theirs);
        let weights = var(ours.dims(), 9);
        let [ours, theirs] = [ours, theirs].map(|y| {
            let weighed = (y * weights.as_tensor()).unwrap();
            weighed.sum_all().unwrap().backward().unwrap()
        });
        for var in vars {
            close(ours.get(var).unwrap(), theirs.get(var).unwrap());
        }
    }

    #[test]
    fn single_operations_equal_tensor_operations_with_their_gradients() {
        let (x, y, z) = (
            var(&[2, 3, 6, 10], 1),
            var(&[2, 3, 6, 10], 2),
            var(&[2, 3, 6, 10], 3),
        );
        let (c, low, four) = (
            var(&[2, 1, 6, 10], 4),
            var(&[2, 3, 3, 5], 5),
            var(&[2, 12, 3, 5], 6),
        );
        let theirs = x.broadcast_mul(&c).unwrap();
        assert_same(&trust(&x, &c).unwrap(), &theirs, &[&x, &c]);
        let doubt = c.affine(-1.0, 1.0).unwrap();
        let theirs = (x.as_tensor() + y.broadcast_mul(&doubt).unwrap()).unwrap();
        assert_same(
            &replace_doubted(&x, &y, &c).unwrap(),
            &theirs,
            &[&x, &y, &c],
        );
        let theirs = ((x.as_tensor() * y.as_tensor()).unwrap() + z.as_tensor()).unwrap();
        assert_same(&modulate(&x, &y, &z).unwrap(), &theirs, &[&x, &y, &z]);
        let theirs = (x.as_tensor() + nearest_2x(&low).unwrap()).unwrap();
        assert_same(&add_nearest_2x(&x, &low).unwrap(), &theirs, &[&x, &low]);
        let theirs = four.reshape((2, 3, 2, 2, 3, 5)).unwrap();
        let theirs = theirs.permute((0, 1, 4, 2, 5, 3)).unwrap();
        let theirs = theirs.reshape((2, 3, 6, 10)).unwrap();
        assert_same(&shuffle_2x(&four).unwrap(), &theirs, &[&four]);
    }

    #[test]
    fn operands_of_other_sizes_are_refused() {
        let (x, y) = (var(&[2, 3, 6, 10], 1), var(&[2, 3, 6, 9], 2));
        assert!(trust(&x, &y).is_err());
        assert!(modulate(&x, &y, &x).is_err());
        assert!(add_nearest_2x(&x, &y).is_err());
        assert!(replace_doubted(&x, &x, &y).is_err());
    }

    /// A tensor that is upsampled and also used elsewhere gets the sum of both gradients, in
    /// whichever order the two are visited. Candle's own upsampling keeps the last one alone; if
    /// that is ever mended the second half of this test says so.
    #[test]
    fn upsampling_adds_to_gradients_that_are_already_there() {
        let gradient = |upsample: &dyn Fn(&Tensor) -> Tensor, upsampled_first: bool| {
            let x = var(&[1, 1, 2, 2], 1);
            let up = upsample(&x).sum_all().unwrap();
            let other = (x.sum_all().unwrap() * 3.0).unwrap();
            let sum = if upsampled_first {
                up + other
            } else {
                other + up
            };
            read(sum.unwrap().backward().unwrap().get(&x).unwrap())[0]
        };
        let zeros = Tensor::zeros((1, 1, 4, 4), candle_core::DType::F32, &Device::Cpu).unwrap();
        let operation = |x: &Tensor| add_nearest_2x(&zeros, x).unwrap();
        let composed = |x: &Tensor| nearest_2x(x).unwrap();
        for first in [false, true] {
            assert_eq!(gradient(&operation, first), 7.0);
            assert_eq!(gradient(&composed, first), 7.0);
        }
        let candles = |x: &Tensor| x.upsample_nearest2d(4, 4).unwrap();
        let both = [false, true].map(|first| gradient(&candles, first));
        assert!(
            both.contains(&4.0),
            "candle's upsampling adds now: {both:?}"
        );
    }
}

//! Batch normalisation, and its merging into the convolution before it.

use candle_core::{D, Result, Tensor, bail};
use noctule_kernels::Activation;

use crate::activate::activate;
use crate::conv::{Conv, ConvShape, is_plain};
use crate::norm_cpu::{NormCpu, Statistics, statistics};
use crate::params::{Init, Norms, Params, Role};
use crate::pass::{Moments, Pass};

/// Added to a variance before its root.
const NORM_EPSILON: f64 = 1e-5;

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

    /// `activation(norm(x) + residual)` with the statistics of `x` itself, which `pass` collects;
    /// shape kept, `[B, C, H, W]`.
    fn forward(
        &self,
        x: &Tensor,
        residual: Option<&Tensor>,
        activation: Activation,
        pass: &mut Pass,
    ) -> Result<Tensor> {
        if is_plain(x) && matches!(activation, Activation::None | Activation::Relu) {
            return self.on_processor(&x.contiguous()?, residual, activation, pass);
        }
        let (mean, variance) = self.batch_moments(x, pass)?;
        let (scale, shift) = affine(&self.weight, &self.bias, &mean, &variance)?;
        let per_channel = (1, (), 1, 1);
        let mut y = x
            .broadcast_mul(&scale.reshape(per_channel)?)?
            .broadcast_add(&shift.reshape(per_channel)?)?;
        if let Some(residual) = residual {
            y = (y + residual)?;
        }
        activate(&y, activation)
    }

    /// As [`BatchNorm::forward`], in one operation.
    fn on_processor(
        &self,
        x: &Tensor,
        residual: Option<&Tensor>,
        activation: Activation,
        pass: &mut Pass,
    ) -> Result<Tensor> {
        let Statistics { mean, variance } = statistics(x)?;
        #[allow(
            clippy::cast_possible_truncation,
            reason = "rounding to single precision"
        )]
        let rstd = |variance: &f32| (1.0 / (f64::from(*variance) + NORM_EPSILON).sqrt()) as f32;
        let op = NormCpu {
            rstd: variance.iter().map(rstd).collect(),
            mean: mean.clone(),
            activation,
        };
        let per_channel = |values| Tensor::from_vec(values, x.dim(1)?, x.device());
        self.collect(x, per_channel(mean)?, per_channel(variance)?, pass)?;
        let factors = Tensor::cat(&[&self.weight, &self.bias], 0)?;
        match residual {
            None => x.apply_op2(&factors, op),
            Some(residual) => x.apply_op3(&factors, &residual.contiguous()?, op),
        }
    }

    /// Mean and biased variance of `x` per channel; reports them to `pass`.
    fn batch_moments(&self, x: &Tensor, pass: &mut Pass) -> Result<(Tensor, Tensor)> {
        let channels = x.dim(1)?;
        let rows = x.transpose(0, 1)?.contiguous()?.reshape((channels, ()))?; // [C, B*H*W]
        let mean = rows.mean_keepdim(D::Minus1)?;
        let variance = rows.broadcast_sub(&mean)?.sqr()?.mean(D::Minus1)?;
        let mean = mean.squeeze(D::Minus1)?;
        self.collect(x, mean.detach(), variance.detach(), pass)?;
        Ok((mean, variance))
    }

    /// Reports the statistics of `x`, the variance with Bessel's correction.
    fn collect(&self, x: &Tensor, mean: Tensor, variance: Tensor, pass: &mut Pass) -> Result<()> {
        #[allow(clippy::cast_precision_loss, reason = "a pixel count fits a double")]
        let count = (x.elem_count() / x.dim(1)?) as f64;
        let variance = (variance * (count / (count - 1.0).max(1.0)))?;
        pass.collect(&self.name, Moments { mean, variance });
        Ok(())
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
pub(crate) struct Normed {
    conv: Conv,
    bn: Option<BatchNorm>,
}

impl Normed {
    pub(crate) fn new(params: &Params<'_>, conv: &str, bn: &str, shape: ConvShape) -> Result<Self> {
        let conv = Conv::new(&params.at(conv), shape.unbiased())?;
        let norm = BatchNorm::new(&params.at(bn), shape.outputs)?;
        if params.norms == Norms::Keep {
            return Ok(Self {
                conv,
                bn: Some(norm),
            });
        }
        let (scale, shift) = norm.affine()?;
        Ok(Self {
            conv: conv.folded(&scale, &shift)?,
            bn: None,
        })
    }

    /// `activation(norm(conv(cat(sources))) + residual)`; shapes as in [`Conv::apply`].
    pub(crate) fn apply(
        &self,
        sources: &[&Tensor],
        residual: Option<&Tensor>,
        activation: Activation,
        pass: &mut Pass,
    ) -> Result<Tensor> {
        match &self.bn {
            Some(bn) if pass.uses_batch_statistics() => {
                let y = self.conv.apply(sources, None, Activation::None)?;
                bn.forward(&y, residual, activation, pass)
            }
            // Running statistics make the norm part of the weights, with gradients to both.
            Some(bn) => {
                let (scale, shift) = bn.affine()?;
                let conv = self.conv.folded(&scale, &shift)?;
                conv.apply(sources, residual, activation)
            }
            None if pass.uses_batch_statistics() => {
                bail!("batch statistics asked of a network built with folded norms")
            }
            None => self.conv.apply(sources, residual, activation),
        }
    }
}

#[cfg(test)]
mod tests {
    use candle_core::{Device, Var};

    use super::*;

    fn pattern(shape: &[usize], salt: usize) -> Tensor {
        let len: usize = shape.iter().product();
        let values = (0..len)
            .map(|i| ((i * 7919 + salt * 31 + 13) % 1009) as f32 / 504.5 - 0.9)
            .collect();
        Tensor::from_vec::<_, f32>(values, shape, &Device::Cpu).unwrap()
    }

    /// Values, statistics and gradients of the one operation and of tensor operations.
    #[test]
    fn one_operation_equals_many() {
        for (activation, has_residual) in [
            (Activation::None, false),
            (Activation::Relu, false),
            (Activation::Relu, true),
        ] {
            let var = |shape: &[usize], salt| Var::from_tensor(&pattern(shape, salt)).unwrap();
            let shape = [3, 5, 7, 9];
            let (x, residual) = (var(&shape, 1), var(&shape, 2));
            let (weight, bias) = (var(&[5], 3), var(&[5], 4));
            let norm = BatchNorm {
                name: "bn".into(),
                weight: weight.as_tensor().clone(),
                bias: bias.as_tensor().clone(),
                running_mean: weight.as_tensor().clone(),
                running_var: weight.as_tensor().clone(),
            };
            let added = has_residual.then_some(residual.as_tensor());
            let mut passes = [Pass::training(), Pass::training()];
            let ours = norm.forward(&x, added, activation, &mut passes[0]).unwrap();
            let (mean, variance) = norm.batch_moments(&x, &mut passes[1]).unwrap();
            let (scale, shift) = affine(&weight, &bias, &mean, &variance).unwrap();
            let per_channel = |t: Tensor| t.reshape((1, (), 1, 1)).unwrap();
            let mut theirs = x.broadcast_mul(&per_channel(scale)).unwrap();
            theirs = theirs.broadcast_add(&per_channel(shift)).unwrap();
            if has_residual {
                theirs = (theirs + residual.as_tensor()).unwrap();
            }
            let theirs = activate(&theirs, activation).unwrap();
            let close = |a: &Tensor, b: &Tensor| {
                let read = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
                for (a, b) in read(a).iter().zip(read(b)) {
                    assert!((a - b).abs() < 2e-4 * b.abs().max(1.0), "{a} {b}");
                }
            };
            close(&ours, &theirs);
            let [a, b] = passes
                .each_ref()
                .map(|pass| pass.moments().next().unwrap().1);
            close(&a.mean, &b.mean);
            close(&a.variance, &b.variance);
            let weigh = |y: &Tensor| (y * pattern(&shape, 5)).unwrap().sum_all().unwrap();
            let [ours, theirs] = [ours, theirs].map(|y| weigh(&y).backward().unwrap());
            for var in [&x, &weight, &bias] {
                close(ours.get(var).unwrap(), theirs.get(var).unwrap());
            }
            assert_eq!(ours.get(&residual).is_some(), has_residual);
            if has_residual {
                close(ours.get(&residual).unwrap(), theirs.get(&residual).unwrap());
            }
        }
    }
}

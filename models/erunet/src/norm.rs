//! Batch normalisation, and its merging into the convolution before it.

use candle_core::{D, Result, Tensor, bail};
use noctule_kernels::Activation;

use crate::blocks::activate;
use crate::conv::{Conv, ConvShape};
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

//! Batch normalisation with the batch's own statistics, as one operation on the processor:
//! residual and activation included, with a backward pass.

use candle_core::{CpuStorage, CustomOp2, CustomOp3, Layout, Result, Shape, Tensor, bail};
use noctule_kernels::Activation;
use rayon::prelude::*;

use crate::slices::{all_values, in_order, values};

/// Numbers summed side by side.
const LANES: usize = 16;

/// Mean and biased variance of each channel over batch and pixels.
pub(crate) struct Statistics {
    pub(crate) mean: Vec<f32>,
    pub(crate) variance: Vec<f32>,
}

/// Sum of `f` over pairs of values of two stretches, in lanes; doubles hold sums of stretches.
fn sum(a: &[f32], b: &[f32], f: impl Fn(f32, f32) -> f32) -> f64 {
    let mut lanes = [0f32; LANES];
    let (blocks, others) = (a.chunks_exact(LANES), b.chunks_exact(LANES));
    let rest = blocks.remainder().iter().zip(others.remainder());
    let mut total: f64 = rest.map(|(a, b)| f64::from(f(*a, *b))).sum();
    for (a, b) in blocks.zip(others) {
        for (lane, (a, b)) in lanes.iter_mut().zip(a.iter().zip(b)) {
            *lane += f(*a, *b);
        }
    }
    total += lanes.iter().map(|lane| f64::from(*lane)).sum::<f64>();
    total
}

/// The planes of one channel of `[B, C, H, W]`.
fn planes(
    x: &[f32],
    channels: usize,
    plane: usize,
    channel: usize,
) -> impl Iterator<Item = &[f32]> {
    x.chunks_exact(plane).skip(channel).step_by(channels)
}

/// Statistics of `x` `[B, C, H, W]`.
#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_precision_loss,
    reason = "results are rounded to single precision; a pixel count fits a double"
)]
pub(crate) fn statistics(x: &Tensor) -> Result<Statistics> {
    let (batch, channels, h, w) = x.dims4()?;
    let (plane, count) = (h * w, (batch * h * w) as f64);
    let pairs: Vec<(f32, f32)> = values(x, |x| {
        let of = |channel| {
            let planes = || planes(x, channels, plane, channel);
            let mean = (planes().map(|x| sum(x, x, |x, _| x)).sum::<f64>() / count) as f32;
            let squares = planes().map(|x| sum(x, x, |x, _| (x - mean) * (x - mean)));
            (mean, (squares.sum::<f64>() / count) as f32)
        };
        (0..channels).into_par_iter().map(of).collect()
    })?;
    let (mean, variance) = pairs.into_iter().unzip();
    Ok(Statistics { mean, variance })
}

/// `activation((x - mean) / sqrt(variance + epsilon) * weight + bias + residual)`; the operands
/// are x `[B, C, H, W]`, weight and then bias as one `[2 C]`, and the residual if there is one.
///
/// Gradients go through the statistics, which are those of x.
pub(crate) struct NormCpu {
    pub(crate) mean: Vec<f32>,
    /// One over the root of the guarded variance.
    pub(crate) rstd: Vec<f32>,
    pub(crate) activation: Activation,
}

impl NormCpu {
    fn forward(&self, shape: &Shape, operands: &[&[f32]]) -> Result<(CpuStorage, Shape)> {
        let (_, channels, h, w) = shape.dims4()?;
        let (x, factors, residual) = (operands[0], operands[1], operands.get(2));
        let fits = residual.is_none_or(|residual| residual.len() == x.len());
        if self.mean.len() != channels || factors.len() != 2 * channels || !fits {
            bail!("operands do not fit a normalisation of {shape:?}");
        }
        let plane = h * w;
        let mut out = vec![0f32; x.len()];
        out.par_chunks_mut(plane).enumerate().for_each(|(i, out)| {
            let channel = i % channels;
            let scale = factors[channel] * self.rstd[channel];
            let shift = factors[channels + channel] - self.mean[channel] * scale;
            let x = &x[i * plane..][..plane];
            match residual {
                None => {
                    for (out, x) in out.iter_mut().zip(x) {
                        *out = x * scale + shift;
                    }
                }
                Some(residual) => {
                    let residual = &residual[i * plane..][..plane];
                    for (out, (x, residual)) in out.iter_mut().zip(x.iter().zip(residual)) {
                        *out = x * scale + shift + residual;
                    }
                }
            }
            if self.activation == Activation::Relu {
                out.iter_mut()
                    .for_each(|y| *y = if *y < 0.0 { 0.0 } else { *y });
            }
        });
        Ok((CpuStorage::F32(out), shape.clone()))
    }

    /// Gradients of x, of weight and bias, and before the activation.
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_precision_loss,
        reason = "results are rounded to single precision; a pixel count fits a double"
    )]
    fn backward(
        &self,
        x: &Tensor,
        factors: &Tensor,
        out: &Tensor,
        grad: &Tensor,
    ) -> Result<(Tensor, Tensor, Tensor)> {
        let (batch, channels, h, w) = x.dims4()?;
        let (plane, count) = (h * w, (batch * h * w) as f64);
        let (x_grad, factor_grad, inner) = all_values(&[x, factors, out, grad], |values| {
            let (x, factors, out, grad) = (values[0], values[1], values[2], values[3]);
            let inner = self.inner(out, grad, plane);
            let sums: Vec<(f32, f32)> = (0..channels)
                .into_par_iter()
                .map(|channel| {
                    let (mean, rstd) = (self.mean[channel], self.rstd[channel]);
                    let (mut plain, mut weighted) = (0.0, 0.0);
                    let of = |values| planes(values, channels, plane, channel);
                    for (g, x) in of(&inner).zip(of(x)) {
                        plain += sum(g, g, |g, _| g);
                        weighted += sum(g, x, |g, x| g * ((x - mean) * rstd));
                    }
                    (plain as f32, weighted as f32)
                })
                .collect();
            let mut x_grad = vec![0f32; x.len()];
            let parts = x_grad.par_chunks_mut(plane).enumerate();
            parts.for_each(|(i, to)| {
                let channel = i % channels;
                let (mean, rstd) = (self.mean[channel], self.rstd[channel]);
                let scale = factors[channel] * rstd;
                let (plain, weighted) = sums[channel];
                let share = 1.0 / count as f32;
                let at = i * plane..(i + 1) * plane;
                for (to, (g, x)) in to.iter_mut().zip(inner[at.clone()].iter().zip(&x[at])) {
                    let normed = (x - mean) * rstd;
                    *to = scale * (g - share * (plain + normed * weighted));
                }
            });
            let weighted = sums.iter().map(|(_, weighted)| *weighted);
            let plain = sums.iter().map(|(plain, _)| *plain);
            (x_grad, weighted.chain(plain).collect::<Vec<f32>>(), inner)
        })?;
        let like =
            |values, tensor: &Tensor| Tensor::from_vec(values, tensor.shape(), tensor.device());
        Ok((
            like(x_grad, x)?,
            like(factor_grad, factors)?,
            like(inner, x)?,
        ))
    }

    /// The gradient before the activation.
    fn inner(&self, out: &[f32], grad: &[f32], plane: usize) -> Vec<f32> {
        let mut inner = grad.to_vec();
        if self.activation == Activation::Relu {
            let parts = inner.par_chunks_mut(plane).zip(out.par_chunks(plane));
            parts.for_each(|(inner, out)| {
                for (g, y) in inner.iter_mut().zip(out) {
                    *g *= if *y > 0.0 { 1.0 } else { 0.0 };
                }
            });
        }
        inner
    }
}

impl CustomOp2 for NormCpu {
    fn name(&self) -> &'static str {
        "norm"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        factors: &CpuStorage,
        factors_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let operands = [in_order(x, x_layout)?, in_order(factors, factors_layout)?];
        self.forward(x_layout.shape(), &operands)
    }

    fn bwd(
        &self,
        x: &Tensor,
        factors: &Tensor,
        out: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let (x_grad, factor_grad, _) = self.backward(x, factors, out, grad)?;
        Ok((Some(x_grad), Some(factor_grad)))
    }
}

impl CustomOp3 for NormCpu {
    fn name(&self) -> &'static str {
        "norm"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        factors: &CpuStorage,
        factors_layout: &Layout,
        residual: &CpuStorage,
        residual_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let operands = [
            in_order(x, x_layout)?,
            in_order(factors, factors_layout)?,
            in_order(residual, residual_layout)?,
        ];
        self.forward(x_layout.shape(), &operands)
    }

    fn bwd(
        &self,
        x: &Tensor,
        factors: &Tensor,
        _: &Tensor,
        out: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (x_grad, factor_grad, inner) = self.backward(x, factors, out, grad)?;
        Ok((Some(x_grad), Some(factor_grad), Some(inner)))
    }
}

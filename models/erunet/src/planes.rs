//! What goes value by value between convolutions, one operation each on the processor: gates,
//! modulation, pixel shuffle and nearest upsampling, with their gradients.
//!
//! In tensor operations each of these would go through memory several times, and candle's own
//! nearest upsampling overwrites gradients that are already there.

use candle_core::{CpuStorage, CustomOp1, CustomOp2, CustomOp3, Layout, Result, Shape, Tensor};
use rayon::prelude::*;

use crate::slices::{all_values, in_order, values};

/// `len` values, `part` at a time and side by side.
fn filled(len: usize, part: usize, fill: impl Fn(usize, &mut [f32]) + Sync) -> Vec<f32> {
    let mut out = vec![0.0; len];
    let parts = out.par_chunks_mut(part.max(1)).enumerate();
    parts.for_each(|(i, out)| fill(i, out));
    out
}

fn tensor_like(values: Vec<f32>, like: &Tensor) -> Result<Tensor> {
    Tensor::from_vec(values, like.shape(), like.device())
}

/// `c * x` for `x` `[B, C, H, W]` and `c` `[B, 1, H, W]`.
pub(crate) struct Trust;

/// Per pixel, the sum over channels of `a * b`, times `sign`: `[B, 1, H, W]`.
fn sum_of_products(shape: &Shape, a: &[f32], b: &[f32], sign: f32) -> Result<Vec<f32>> {
    let (batch, channels, h, w) = shape.dims4()?;
    let plane = h * w;
    Ok(filled(batch * plane, plane, |i, out| {
        let picture = i * channels * plane..(i + 1) * channels * plane;
        let planes = a[picture.clone()].chunks_exact(plane);
        for (a, b) in planes.zip(b[picture].chunks_exact(plane)) {
            for (out, (a, b)) in out.iter_mut().zip(a.iter().zip(b)) {
                *out += sign * (a * b);
            }
        }
    }))
}

/// `f(x, c)` for every channel of `x` `[B, C, H, W]` with `c` `[B, 1, H, W]`.
fn with_each_channel(
    shape: &Shape,
    x: &[f32],
    c: &[f32],
    f: impl Fn(f32, f32) -> f32 + Sync,
) -> Result<Vec<f32>> {
    let (_, channels, h, w) = shape.dims4()?;
    let plane = h * w;
    Ok(filled(x.len(), plane, |i, out| {
        let c = &c[i / channels * plane..][..plane];
        let pairs = x[i * plane..][..plane].iter().zip(c);
        for (out, (x, c)) in out.iter_mut().zip(pairs) {
            *out = f(*x, *c);
        }
    }))
}

impl CustomOp2 for Trust {
    fn name(&self) -> &'static str {
        "trust"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        c: &CpuStorage,
        c_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (x, c) = (in_order(x, x_layout)?, in_order(c, c_layout)?);
        let out = with_each_channel(x_layout.shape(), x, c, |x, c| x * c)?;
        Ok((CpuStorage::F32(out), x_layout.shape().clone()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        c: &Tensor,
        _: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let (x_grad, c_grad) = all_values(&[x, c, grad], |values| {
            Ok::<_, candle_core::Error>((
                with_each_channel(x.shape(), values[2], values[1], |g, c| g * c)?,
                sum_of_products(x.shape(), values[2], values[0], 1.0)?,
            ))
        })??;
        Ok((Some(tensor_like(x_grad, x)?), Some(tensor_like(c_grad, c)?)))
    }
}

/// `kept + (1 - c) * other` for `[B, C, H, W]` twice and `c` `[B, 1, H, W]`.
pub(crate) struct ReplaceDoubted;

impl CustomOp3 for ReplaceDoubted {
    fn name(&self) -> &'static str {
        "replace_doubted"
    }

    fn cpu_fwd(
        &self,
        kept: &CpuStorage,
        kept_layout: &Layout,
        other: &CpuStorage,
        other_layout: &Layout,
        c: &CpuStorage,
        c_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (kept, other) = (in_order(kept, kept_layout)?, in_order(other, other_layout)?);
        let c = in_order(c, c_layout)?;
        let shape = kept_layout.shape();
        let (_, channels, h, w) = shape.dims4()?;
        let plane = h * w;
        let out = filled(kept.len(), plane, |i, out| {
            let c = &c[i / channels * plane..][..plane];
            let at = i * plane..(i + 1) * plane;
            let values = kept[at.clone()].iter().zip(&other[at]).zip(c);
            for (out, ((kept, other), c)) in out.iter_mut().zip(values) {
                *out = kept + (1.0 - c) * other;
            }
        });
        Ok((CpuStorage::F32(out), shape.clone()))
    }

    fn bwd(
        &self,
        _: &Tensor,
        other: &Tensor,
        c: &Tensor,
        _: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (other_grad, c_grad) = all_values(&[other, c, grad], |values| {
            Ok::<_, candle_core::Error>((
                with_each_channel(other.shape(), values[2], values[1], |g, c| g * (1.0 - c))?,
                sum_of_products(other.shape(), values[2], values[0], -1.0)?,
            ))
        })??;
        Ok((
            Some(grad.clone()),
            Some(tensor_like(other_grad, other)?),
            Some(tensor_like(c_grad, c)?),
        ))
    }
}

/// `gamma * x + beta`, all of one shape.
pub(crate) struct Modulate;

/// Values handled by one unit of work where planes do not matter.
const PART: usize = 16 * 1024;

fn multiplied(a: &[f32], b: &[f32]) -> Vec<f32> {
    filled(a.len(), PART, |i, out| {
        let pairs = a[i * PART..].iter().zip(&b[i * PART..]);
        for (out, (a, b)) in out.iter_mut().zip(pairs) {
            *out = a * b;
        }
    })
}

impl CustomOp3 for Modulate {
    fn name(&self) -> &'static str {
        "modulate"
    }

    fn cpu_fwd(
        &self,
        gamma: &CpuStorage,
        gamma_layout: &Layout,
        x: &CpuStorage,
        x_layout: &Layout,
        beta: &CpuStorage,
        beta_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (gamma, x) = (in_order(gamma, gamma_layout)?, in_order(x, x_layout)?);
        let beta = in_order(beta, beta_layout)?;
        let out = filled(x.len(), PART, |i, out| {
            let at = i * PART..i * PART + out.len();
            let values = gamma[at.clone()].iter().zip(&x[at.clone()]).zip(&beta[at]);
            for (out, ((gamma, x), beta)) in out.iter_mut().zip(values) {
                *out = gamma * x + beta;
            }
        });
        Ok((CpuStorage::F32(out), x_layout.shape().clone()))
    }

    fn bwd(
        &self,
        gamma: &Tensor,
        x: &Tensor,
        _: &Tensor,
        _: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (gamma_grad, x_grad) = all_values(&[gamma, x, grad], |values| {
            (
                multiplied(values[2], values[1]),
                multiplied(values[2], values[0]),
            )
        })?;
        Ok((
            Some(tensor_like(gamma_grad, gamma)?),
            Some(tensor_like(x_grad, x)?),
            Some(grad.clone()),
        ))
    }
}

/// `[B, 4 C, H, W]` to `[B, C, 2H, 2W]`: `out[c, 2y + a, 2x + b] = x[4 c + 2 a + b, y, x]`.
pub(crate) struct Shuffle;

/// The two planes that make up the rows `2y + a` of an output, of planes `[4 C]` of one size.
fn pair(planes: &[f32], plane: usize, output: usize, a: usize) -> (&[f32], &[f32]) {
    let first = (4 * output + 2 * a) * plane;
    planes[first..first + 2 * plane].split_at(plane)
}

impl CustomOp1 for Shuffle {
    fn name(&self) -> &'static str {
        "shuffle"
    }

    fn cpu_fwd(&self, x: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let x = in_order(x, layout)?;
        let (b, c, h, w) = layout.shape().dims4()?;
        let out = filled(x.len(), 4 * h * w, |output, out| {
            for (y, out) in out.chunks_exact_mut(2 * w).enumerate() {
                let (left, right) = pair(x, h * w, output, y % 2);
                let at = y / 2 * w..(y / 2 + 1) * w;
                let values = left[at.clone()].iter().zip(&right[at]);
                for (out, (left, right)) in out.chunks_exact_mut(2).zip(values) {
                    (out[0], out[1]) = (*left, *right);
                }
            }
        });
        Ok((CpuStorage::F32(out), Shape::from((b, c / 4, 2 * h, 2 * w))))
    }

    fn bwd(&self, x: &Tensor, _: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        let (_, _, h, w) = x.dims4()?;
        let x_grad = values(grad, |grad| {
            filled(grad.len(), h * w, |plane, out| {
                let grad = &grad[plane / 4 * 4 * h * w..][..4 * h * w];
                let (a, b) = (plane % 4 / 2, plane % 2);
                let rows = grad.chunks_exact(2 * w).skip(a).step_by(2);
                for (out, grad) in out.chunks_exact_mut(w).zip(rows) {
                    for (out, grad) in out.iter_mut().zip(grad.chunks_exact(2)) {
                        *out = grad[b];
                    }
                }
            })
        })?;
        Ok(Some(tensor_like(x_grad, x)?))
    }
}

/// `x` `[B, C, 2H, 2W]` plus `low` `[B, C, H, W]`, each of whose pixels counts four times.
pub(crate) struct AddNearest;

impl CustomOp2 for AddNearest {
    fn name(&self) -> &'static str {
        "add_nearest"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        low: &CpuStorage,
        low_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (x, low) = (in_order(x, x_layout)?, in_order(low, low_layout)?);
        let (_, _, h, w) = low_layout.shape().dims4()?;
        let out = filled(x.len(), 4 * h * w, |plane, out| {
            let x = x[plane * 4 * h * w..].chunks_exact(2 * w);
            for (y, (out, x)) in out.chunks_exact_mut(2 * w).zip(x).enumerate() {
                let low = &low[(plane * h + y / 2) * w..][..w];
                let pairs = out.chunks_exact_mut(2).zip(x.chunks_exact(2));
                for ((out, x), low) in pairs.zip(low) {
                    (out[0], out[1]) = (x[0] + low, x[1] + low);
                }
            }
        });
        Ok((CpuStorage::F32(out), x_layout.shape().clone()))
    }

    fn bwd(
        &self,
        _: &Tensor,
        low: &Tensor,
        _: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let (_, _, h, w) = low.dims4()?;
        let low_grad = values(grad, |grad| {
            filled(grad.len() / 4, h * w, |plane, out| {
                let grad = &grad[plane * 4 * h * w..][..4 * h * w];
                let pairs = grad.chunks_exact(4 * w);
                for (out, rows) in out.chunks_exact_mut(w).zip(pairs) {
                    let (upper, lower) = rows.split_at(2 * w);
                    let squares = upper.chunks_exact(2).zip(lower.chunks_exact(2));
                    for (out, (upper, lower)) in out.iter_mut().zip(squares) {
                        *out = (upper[0] + upper[1]) + (lower[0] + lower[1]);
                    }
                }
            })
        })?;
        Ok((Some(grad.clone()), Some(tensor_like(low_grad, low)?)))
    }
}

//! The filtering of GARF as one loop over pixels, for inference on the processor.

use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, bail};
use rayon::prelude::*;

/// Applies per-pixel kernels to every channel; first operand x `[N, d, h, w]`, second the kernels
/// `[N, M, J, h, w]`, both contiguous; result `[N, d*M, h, w]`, index c*M + m.
pub(super) struct FilterCpu {
    /// Row and column of each tap in a picture padded by `reach`.
    pub(super) taps: Vec<(usize, usize)>,
    /// Pixels a kernel reaches beyond its centre.
    pub(super) reach: usize,
}

impl CustomOp2 for FilterCpu {
    fn name(&self) -> &'static str {
        "garf_filter"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        kernels: &CpuStorage,
        kernels_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (n, d, h, w) = x_layout.shape().dims4()?;
        let (kernels_n, filters, live, kernels_h, kernels_w) = kernels_layout.shape().dims5()?;
        if (kernels_n, live, kernels_h, kernels_w) != (n, self.taps.len(), h, w) {
            bail!(
                "kernels {:?} do not fit {:?}",
                kernels_layout.shape(),
                x_layout.shape()
            );
        }
        let x = contiguous(x.as_slice::<f32>()?, x_layout)?;
        let kernels = contiguous(kernels.as_slice::<f32>()?, kernels_layout)?;
        let plane = h * w;
        let mut out = vec![0f32; n * d * filters * plane];
        out.par_chunks_mut(plane * filters)
            .enumerate()
            .for_each(|(index, out)| {
                let x = &x[index * plane..][..plane];
                let kernels =
                    &kernels[index / d * filters * live * plane..][..filters * live * plane];
                for (out, kernel) in out.chunks_mut(plane).zip(kernels.chunks(live * plane)) {
                    self.channel(x, kernel, out, w);
                }
            });
        Ok((CpuStorage::F32(out), Shape::from((n, d * filters, h, w))))
    }
}

impl FilterCpu {
    /// One channel through one filter: `x` and `out` `[h, w]`, `kernel` `[J, h, w]`.
    fn channel(&self, x: &[f32], kernel: &[f32], out: &mut [f32], w: usize) {
        let h = out.len() / w;
        for (y, out) in out.chunks_mut(w).enumerate() {
            for (tap, &(row, column)) in self.taps.iter().enumerate() {
                let Some(source) = (y + row).checked_sub(self.reach).filter(|y| *y < h) else {
                    continue;
                };
                let source = &x[source * w..][..w];
                let weights = &kernel[(tap * h + y) * w..][..w];
                // Column z reads source column z + column - reach, where that lies inside.
                let first = self.reach.saturating_sub(column).min(w);
                let skipped = column.saturating_sub(self.reach).min(w);
                let len = (w - first).min(w - skipped);
                let pairs = source[skipped..][..len]
                    .iter()
                    .zip(&weights[first..][..len]);
                for (out, (x, weight)) in out[first..][..len].iter_mut().zip(pairs) {
                    *out += x * weight;
                }
            }
        }
    }
}

fn contiguous<'a>(values: &'a [f32], layout: &Layout) -> Result<&'a [f32]> {
    match layout.contiguous_offsets() {
        Some((start, end)) => Ok(&values[start..end]),
        None => bail!("garf_filter wants contiguous operands, got {layout:?}"),
    }
}

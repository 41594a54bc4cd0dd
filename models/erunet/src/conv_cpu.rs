//! Convolution on the processor for inference: strips of the picture are unfolded into a matrix
//! that fits the second-level cache, and multiplied with the weights.
//!
//! The matrix product is candle's. It replaces candle's own unfolding, which copies value by value;
//! the results differ in rounding only. There is no backward pass here.

use candle_core::{CpuStorage, Device, Result, Storage, Tensor, bail};
use rayon::prelude::*;

/// Size the unfolded strip should stay below, in values; half of a 1 MiB cache.
const STRIP_LEN: usize = 128 * 1024;

/// A square kernel with zero padding of half its size.
#[derive(Clone, Copy)]
pub(crate) struct Window {
    pub(crate) kernel: usize,
    pub(crate) stride: usize,
}

/// One picture, channel by channel.
#[derive(Clone, Copy)]
struct Picture<'a> {
    values: &'a [f32],
    height: usize,
    width: usize,
}

/// `x` `[B, I, H, W]` contiguous, `weight` `[O, I, k, k]`; returns `[B, O, H/stride, W/stride]`,
/// rounded up.
pub(crate) fn conv2d(x: &Tensor, weight: &Tensor, window: Window) -> Result<Tensor> {
    let (b, inputs, height, width) = x.dims4()?;
    let outputs = weight.dim(0)?;
    let depth = inputs * window.kernel * window.kernel;
    let weight = weight.reshape((outputs, depth))?;
    let (out_h, out_w) = (
        height.div_ceil(window.stride),
        width.div_ceil(window.stride),
    );
    let (storage, layout) = x.storage_and_layout();
    let (Storage::Cpu(CpuStorage::F32(values)), Some((start, end))) =
        (&*storage, layout.contiguous_offsets())
    else {
        bail!("conv2d wants contiguous single-precision values on the processor, got {x:?}");
    };
    let rows = (STRIP_LEN / (depth * out_w)).clamp(1, out_h);
    let strips = out_h.div_ceil(rows);
    let mut out = vec![0f32; b * outputs * out_h * out_w];
    let pictures = values[start..end].chunks_exact(inputs * height * width);
    for (values, out) in pictures.zip(out.chunks_exact_mut(outputs * out_h * out_w)) {
        let picture = Picture {
            values,
            height,
            width,
        };
        let products: Vec<Vec<f32>> = (0..strips)
            .into_par_iter()
            .map(|strip| {
                let first = strip * rows;
                let count = rows.min(out_h - first);
                let unfolded = picture.unfold(window, first, count, out_w);
                let unfolded = Tensor::from_vec(unfolded, (depth, count * out_w), &Device::Cpu)?;
                weight.matmul(&unfolded)?.flatten_all()?.to_vec1()
            })
            .collect::<Result<_>>()?;
        for (strip, product) in products.iter().enumerate() {
            let len = product.len() / outputs;
            let planes = out.chunks_exact_mut(out_h * out_w);
            for (plane, product) in planes.zip(product.chunks_exact(len)) {
                plane[strip * rows * out_w..][..len].copy_from_slice(product);
            }
        }
    }
    Tensor::from_vec(out, (b, outputs, out_h, out_w), x.device())
}

impl Picture<'_> {
    /// What each output pixel of rows `first..first + count` sees: `[I k k, count * out_w]`.
    fn unfold(&self, window: Window, first: usize, count: usize, out_w: usize) -> Vec<f32> {
        let Window { kernel, stride } = window;
        let planes = self.values.chunks_exact(self.height * self.width);
        let mut out = Vec::with_capacity(planes.len() * kernel * kernel * count * out_w);
        for plane in planes {
            for (ky, kx) in (0..kernel).flat_map(|ky| (0..kernel).map(move |kx| (ky, kx))) {
                for y in first..first + count {
                    let row = (y * stride + ky).checked_sub(kernel / 2);
                    match row.filter(|row| *row < self.height) {
                        None => out.resize(out.len() + out_w, 0.0),
                        Some(row) => {
                            let row = &plane[row * self.width..][..self.width];
                            extend_shifted(&mut out, row, kx, window, out_w);
                        }
                    }
                }
            }
        }
        out
    }
}

/// Appends `row[z * stride + kx - kernel / 2]` for `z` in `0..out_w`, zero outside the row.
fn extend_shifted(out: &mut Vec<f32>, row: &[f32], kx: usize, window: Window, out_w: usize) {
    let Window { kernel, stride } = window;
    let (end, reach) = (out.len() + out_w, kernel / 2);
    // Outputs left of the row's first value, and the column the next one reads.
    let before = reach.saturating_sub(kx).div_ceil(stride).min(out_w);
    out.resize(out.len() + before, 0.0);
    let column = before * stride + kx - reach;
    let seen = row.get(column..).unwrap_or_default();
    let left = end - out.len();
    if stride == 1 {
        out.extend_from_slice(&seen[..seen.len().min(left)]);
    } else {
        out.extend(seen.iter().step_by(stride).take(left));
    }
    out.resize(end, 0.0);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pattern(shape: &[usize]) -> Tensor {
        let len: usize = shape.iter().product();
        let values = (0..len)
            .map(|i| ((i * 7919 + 13) % 1009) as f32 / 504.5 - 1.0)
            .collect();
        Tensor::from_vec::<_, f32>(values, shape, &Device::Cpu).unwrap()
    }

    /// Candle's own convolution is the reference; sizes cover one-pixel pictures, pictures
    /// narrower than the kernel and pictures of several strips.
    #[test]
    fn strips_equal_candles_convolution() {
        for (h, w) in [(1, 1), (2, 3), (5, 1), (7, 10), (96, 64)] {
            for (kernel, stride) in [(1, 2), (3, 1), (3, 2), (5, 1), (5, 2)] {
                let x = pattern(&[2, 6, h, w]);
                let weight = pattern(&[3, 6, kernel, kernel]);
                let wanted = x.conv2d(&weight, kernel / 2, stride, 1, 1).unwrap();
                let got = conv2d(&x, &weight, Window { kernel, stride }).unwrap();
                assert_eq!(got.dims(), wanted.dims());
                let difference = (got - wanted)
                    .unwrap()
                    .abs()
                    .unwrap()
                    .flatten_all()
                    .unwrap();
                let worst: f32 = difference.max(0).unwrap().to_scalar().unwrap();
                assert!(
                    worst < 1e-4,
                    "{h}x{w} kernel {kernel} stride {stride}: {worst}"
                );
            }
        }
    }

    #[test]
    fn a_view_into_a_larger_tensor_is_read_where_it_lies() {
        let whole = pattern(&[3, 2, 4, 4]);
        let (part, weight) = (whole.narrow(0, 1, 1).unwrap(), pattern(&[2, 2, 3, 3]));
        let window = Window {
            kernel: 3,
            stride: 1,
        };
        let got = conv2d(&part, &weight, window).unwrap();
        let wanted = conv2d(&part.copy().unwrap(), &weight, window).unwrap();
        let values = |x: Tensor| x.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(values(got), values(wanted));
        assert!(conv2d(&whole.narrow(3, 0, 2).unwrap(), &weight, window).is_err());
    }
}

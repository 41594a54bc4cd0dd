//! Plain double-precision forms of every kernel, over planes: slow, obvious, and what the tests
//! compare with.

use crate::layout::Size;

/// Zero-padded convolution: `x` `[I, H, W]`, `weight` `[O, I, k, k]`, `bias` `[O]`; returns
/// `[O, H / stride, W / stride]`, rounded up.
pub fn conv2d(
    x: &[f64],
    size: Size,
    weight: &[f64],
    bias: &[f64],
    kernel: usize,
    stride: usize,
) -> Vec<f64> {
    let inputs = x.len() / size.area();
    let (height, width) = (size.height.div_ceil(stride), size.width.div_ceil(stride));
    let mut out = Vec::with_capacity(bias.len() * height * width);
    for (o, bias) in bias.iter().enumerate() {
        for y in 0..height {
            for z in 0..width {
                let mut sum = *bias;
                for i in 0..inputs {
                    for ky in 0..kernel {
                        for kx in 0..kernel {
                            let (row, column) = (y * stride + ky, z * stride + kx);
                            let w = weight[((o * inputs + i) * kernel + ky) * kernel + kx];
                            let plane = &x[i * size.area()..][..size.area()];
                            sum += w * padded(plane, size, row, column, kernel / 2);
                        }
                    }
                }
                out.push(sum);
            }
        }
    }
    out
}

/// The value `reach` above and left of (row, column), zero outside.
fn padded(plane: &[f64], size: Size, row: usize, column: usize, reach: usize) -> f64 {
    match (row.checked_sub(reach), column.checked_sub(reach)) {
        (Some(y), Some(x)) if y < size.height && x < size.width => plane[y * size.width + x],
        _ => 0.0,
    }
}

/// Pixel shuffle by two: `[4 C, H, W]` to `[C, 2 H, 2 W]` with
/// `out[c, 2 y + a, 2 x + b] = x[4 c + 2 a + b, y, x]`.
pub fn shuffle(x: &[f64], size: Size) -> Vec<f64> {
    let channels = x.len() / size.area() / 4;
    let mut out = Vec::with_capacity(x.len());
    for c in 0..channels {
        for y in 0..2 * size.height {
            for z in 0..2 * size.width {
                let plane = 4 * c + 2 * (y % 2) + z % 2;
                out.push(x[plane * size.area() + y / 2 * size.width + z / 2]);
            }
        }
    }
    out
}

/// Every pixel four times: `[C, H, W]` to `[C, 2 H, 2 W]`.
pub fn nearest(x: &[f64], size: Size) -> Vec<f64> {
    let mut out = Vec::with_capacity(4 * x.len());
    for plane in x.chunks(size.area()) {
        for y in 0..2 * size.height {
            for z in 0..2 * size.width {
                out.push(plane[y / 2 * size.width + z / 2]);
            }
        }
    }
    out
}

/// The paper's order of GARF: filter `x` `[d, H, W]` with each of `atoms` `[K, side, side]`, then
/// combine with `coefficients` `[M * K, H, W]`; returns `[d * M, H, W]`, channel c * M + m.
pub fn adaptive_filter(
    x: &[f64],
    size: Size,
    atoms: &[f64],
    side: usize,
    coefficients: &[f64],
) -> Vec<f64> {
    let (area, taps) = (size.area(), side * side);
    let count = atoms.len() / taps;
    let filters = coefficients.len() / area / count;
    let mut out = Vec::new();
    for plane in x.chunks(area) {
        let by_atom: Vec<Vec<f64>> = atoms
            .chunks(taps)
            .map(|atom| conv2d(plane, size, atom, &[0.0], side, 1))
            .collect();
        for m in 0..filters {
            for pixel in 0..area {
                let term =
                    |k: usize| coefficients[(m * count + k) * area + pixel] * by_atom[k][pixel];
                out.push((0..count).map(term).sum());
            }
        }
    }
    out
}

//! Lens flare: 3 % of the light spread over about 6 pixels, 1.5 % over about 25 (at 256 pixels
//! width), before any noise.
//!
//! The wide Gaussians are taken on a reduced picture, where their sigma is about 3 pixels.

/// `(share, sigma at 256 pixels, reduction at 256 pixels)` of each halo.
const HALOS: [(f32, f32, usize); 2] = [(0.03, 6.0, 2), (0.015, 25.0, 8)];

/// What a lens makes of a square plane of light; the total is kept up to the borders.
pub(crate) fn spread(plane: &[f32], size: usize) -> Vec<f32> {
    let scale = size as f32 / 256.0;
    let direct = 1.0 - HALOS.iter().map(|(share, ..)| share).sum::<f32>();
    let mut out: Vec<f32> = plane.iter().map(|e| direct * e).collect();
    for (share, sigma, reduction) in HALOS {
        let factor = ((reduction * size) / 256).clamp(1, size / 8);
        let small = reduce(plane, size, factor);
        let blurred = gauss(&small, size / factor, sigma * scale / factor as f32);
        add_enlarged(&blurred, size / factor, factor, share, &mut out);
    }
    out
}

fn reduce(plane: &[f32], size: usize, factor: usize) -> Vec<f32> {
    let small = size / factor;
    let mut out = vec![0.0; small * small];
    let weight = 1.0 / (factor * factor) as f32;
    for (y, row) in plane.chunks_exact(size).take(small * factor).enumerate() {
        let target = &mut out[y / factor * small..][..small];
        for (cell, group) in target.iter_mut().zip(row.chunks_exact(factor)) {
            *cell += weight * group.iter().sum::<f32>();
        }
    }
    out
}

/// Separable Gaussian; the border is continued.
fn gauss(plane: &[f32], size: usize, sigma: f32) -> Vec<f32> {
    let radius = (3.0 * sigma).ceil() as usize;
    let kernel: Vec<f32> = (0..=2 * radius)
        .map(|i| (-0.5 * ((i as f32 - radius as f32) / sigma).powi(2)).exp())
        .collect();
    let total: f32 = kernel.iter().sum();
    let clamped = |i: usize| i.saturating_sub(radius).min(size - 1);
    let mut across = vec![0.0; size * size];
    let mut padded = vec![0.0; size + 2 * radius];
    for (row, target) in plane.chunks_exact(size).zip(across.chunks_exact_mut(size)) {
        for (i, cell) in padded.iter_mut().enumerate() {
            *cell = row[clamped(i)];
        }
        for (k, weight) in kernel.iter().enumerate() {
            for (cell, value) in target.iter_mut().zip(&padded[k..]) {
                *cell += weight / total * value;
            }
        }
    }
    let mut down = vec![0.0; size * size];
    for (y, target) in down.chunks_exact_mut(size).enumerate() {
        for (k, weight) in kernel.iter().enumerate() {
            let row = &across[clamped(y + k) * size..][..size];
            for (cell, value) in target.iter_mut().zip(row) {
                *cell += weight / total * value;
            }
        }
    }
    down
}

/// Adds `share` times the bilinear enlargement of `small`.
fn add_enlarged(small: &[f32], small_size: usize, factor: usize, share: f32, out: &mut [f32]) {
    let size = small_size * factor;
    let place = |i: usize| {
        let position = ((i as f32 + 0.5) / factor as f32 - 0.5).clamp(0.0, small_size as f32 - 1.0);
        let index = (position as usize).min(small_size.saturating_sub(2));
        (index, position - index as f32)
    };
    let columns: Vec<(usize, f32)> = (0..size).map(place).collect();
    let mut mixed = vec![0.0; small_size];
    for (y, target) in out.chunks_exact_mut(size).enumerate() {
        let (row, v) = place(y);
        let upper = &small[row * small_size..][..small_size];
        let lower = &small[(row + 1) * small_size..][..small_size];
        for (cell, (a, b)) in mixed.iter_mut().zip(upper.iter().zip(lower)) {
            *cell = share * (a + v * (b - a));
        }
        for (cell, &(x, u)) in target.iter_mut().zip(&columns) {
            *cell += mixed[x] + u * (mixed[x + 1] - mixed[x]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_point_keeps_its_light_and_gets_two_halos() {
        let size = 256;
        let mut plane = vec![0.0; size * size];
        plane[128 * size + 128] = 1000.0;
        let out = spread(&plane, size);
        let total: f32 = out.iter().sum();
        assert!((total - 1000.0).abs() < 1.0, "{total}");
        assert!((out[128 * size + 128] - 955.0).abs() < 1.0);
        // Second moment of the 3 % and 1.5 % halos: sigma^2 per axis.
        let moment: f32 = out
            .iter()
            .enumerate()
            .map(|(i, e)| e * ((i % size) as f32 - 128.0).powi(2))
            .sum();
        let expected = 1000.0 * (0.03 * 36.0 + 0.015 * 625.0);
        assert!(
            (moment / expected - 1.0).abs() < 0.08,
            "{moment} for {expected}"
        );
    }

    #[test]
    fn even_light_stays_even() {
        let out = spread(&vec![2.0; 64 * 64], 64);
        assert!(out.iter().all(|e| (e - 2.0).abs() < 1e-4));
    }
}

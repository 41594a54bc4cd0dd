//! Edge-keeping blurs with holes between their taps, the widest first.
//!
//! The scheme is the edge-avoiding a-trous filter (Dammertz, Sewtz, Hanika and Lensch, 2010) with
//! a 3x3 kernel and a weight that falls to exactly nothing across an edge.

use crate::size::Size;

/// Relative difference of inverse depth beyond which two pixels are not blended.
const EDGE_SHARE: f32 = 0.566;
/// Weights of the centre, of a tap beside or above, of a tap across the corner.
const CENTRE: f32 = 4.0;
const SIDE: f32 = 2.0;
const CORNER: f32 = 1.0;

pub(crate) struct Blender {
    size: Size,
    blurred: Vec<f32>,
}

impl Blender {
    pub(crate) fn new(size: Size) -> Self {
        Self {
            size,
            blurred: vec![0.0; size.pixels()],
        }
    }

    /// Blurs `inverse` (all above zero) in place with `step`, half of it, and so on down to 1.
    pub(crate) fn blend(&mut self, inverse: &mut [f32], step: usize) {
        let mut step = step;
        while step > 0 {
            self.pass(inverse, step);
            inverse.copy_from_slice(&self.blurred);
            step /= 2;
        }
    }

    fn pass(&mut self, inverse: &[f32], step: usize) {
        let (width, height) = (self.size.width(), self.size.height());
        for (y, out) in self.blurred.chunks_exact_mut(width).enumerate() {
            let row = |y: usize| &inverse[y * width..][..width];
            let above = row(y.saturating_sub(step));
            let below = row((y + step).min(height - 1));
            blur_row([above, row(y), below], step, out);
        }
    }
}

/// One row of the blur; taps beyond an end repeat the end.
fn blur_row(rows: [&[f32]; 3], step: usize, out: &mut [f32]) {
    let width = out.len();
    let inner = width.saturating_sub(2 * step);
    for x in (0..step.min(width)).chain((step + inner).min(width)..width) {
        let columns = [x.saturating_sub(step), x, (x + step).min(width - 1)];
        out[x] = blended(rows.map(|row| columns.map(|column| row[column])));
    }
    if inner == 0 {
        return;
    }
    // Slices of one length, so that the loop below needs no bounds checks and vectorises.
    let [above, middle, below] = rows.map(|row| {
        [
            &row[..inner],
            &row[step..][..inner],
            &row[2 * step..][..inner],
        ]
    });
    for (x, out) in out[step..][..inner].iter_mut().enumerate() {
        *out = blended([above, middle, below].map(|row| row.map(|tap| tap[x])));
    }
}

/// Weighted mean of a 3x3 neighbourhood, each tap counting less the more it differs.
#[inline(always)]
fn blended(taps: [[f32; 3]; 3]) -> f32 {
    let centre = taps[1][1];
    let tolerance_inverse = 1.0 / (EDGE_SHARE * centre);
    let (mut sum, mut total) = (0.0, CENTRE);
    for (y, row) in taps.into_iter().enumerate() {
        for (x, tap) in row.into_iter().enumerate() {
            let kernel = if x == 1 || y == 1 { SIDE } else { CORNER };
            let step = tap - centre;
            let contrast = step * tolerance_inverse;
            let likeness = (1.0 - contrast * contrast).max(0.0);
            let is_centre = x == 1 && y == 1;
            let weight = if is_centre {
                0.0
            } else {
                kernel * likeness * likeness
            };
            sum += weight * step;
            total += weight;
        }
    }
    // The mean is taken of differences, so a level neighbourhood stays exactly what it was.
    centre + sum / total
}

#[cfg(test)]
mod tests {
    use super::*;

    fn blend(values: &[f32], width: usize, height: usize, step: usize) -> Vec<f32> {
        let mut inverse = values.to_vec();
        Blender::new(Size::new(width, height).expect("a size")).blend(&mut inverse, step);
        inverse
    }

    #[test]
    fn level_and_strong_edges_stay_exactly() {
        for (width, height, step) in [(1, 1, 8), (3, 5, 4), (40, 9, 8), (16, 16, 64)] {
            let values: Vec<f32> = (0..width * height)
                .map(|i| if i % width < width / 2 { 0.5 } else { 0.1 })
                .collect();
            assert_eq!(
                blend(&values, width, height, step),
                values,
                "{width}x{height} / {step}"
            );
        }
    }

    /// 0.10 between 0.11 and 0.13: contrasts 0.01 and 0.03 of 0.0566, by hand.
    #[test]
    fn the_weights_by_hand() {
        let (near, far) = (0.01_f32 / 0.0566, 0.03_f32 / 0.0566);
        let (a, b) = ((1.0 - near * near).powi(2), (1.0 - far * far).powi(2));
        // One row: above and below repeat the row, so a side counts 2 + 1 + 1, the centre 4 + 2 + 2.
        let expected = 0.1 + (4.0 * a * 0.01 + 4.0 * b * 0.03) / (8.0 + 4.0 * a + 4.0 * b);
        let found = blend(&[0.11, 0.10, 0.13], 3, 1, 1)[1];
        assert!((found - expected).abs() < 1e-6, "{found} {expected}");
    }

    #[test]
    fn rows_blur_the_same_through_the_ends_and_the_middle() {
        // The same three values around x, once inside and once with repeated ends.
        let wide = blend(&[0.2, 0.2, 0.2, 0.21, 0.22, 0.22, 0.22], 7, 1, 1);
        let narrow = blend(&[0.2, 0.21, 0.22], 3, 1, 1);
        assert_eq!(wide[3], narrow[1]);
    }
}

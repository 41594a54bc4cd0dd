//! Grids of numbers, as the flow estimator needs them: sampled between cells, halved, sloped.

/// Numbers row by row, top left first; neither side is 0.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Plane {
    pub width: usize,
    pub height: usize,
    pub values: Vec<f32>,
}

impl Plane {
    pub(super) fn zeros(width: usize, height: usize) -> Self {
        Self {
            width,
            height,
            values: vec![0.0; width * height],
        }
    }

    pub(super) fn row(&self, y: usize) -> &[f32] {
        &self.values[y * self.width..][..self.width]
    }

    /// The value at a place, linear between the four cells around it; beyond the edge, the edge's.
    pub(super) fn at(&self, x: f32, y: f32) -> f32 {
        Corners::around(x, y, self.width, self.height).of(&self.values)
    }

    /// Convolved with (1 4 6 4 1) / 16 both ways, edges repeated.
    fn smoothed(&self) -> Self {
        const WEIGHTS: [f32; 5] = [0.0625, 0.25, 0.375, 0.25, 0.0625];
        let clamped = |at: usize, k: usize, len: usize| (at + k).saturating_sub(2).min(len - 1);
        let mut across = Self::zeros(self.width, self.height);
        for y in 0..self.height {
            let row = self.row(y);
            for (x, out) in across.values[y * self.width..][..self.width]
                .iter_mut()
                .enumerate()
            {
                *out = (0..5)
                    .map(|k| WEIGHTS[k] * row[clamped(x, k, self.width)])
                    .sum();
            }
        }
        let mut down = Self::zeros(self.width, self.height);
        for y in 0..self.height {
            let out = &mut down.values[y * self.width..][..self.width];
            for (k, weight) in WEIGHTS.iter().enumerate() {
                let row = across.row(clamped(y, k, self.height));
                out.iter_mut().zip(row).for_each(|(o, r)| *o += weight * r);
            }
        }
        down
    }

    /// Every second cell both ways of the smoothed plane.
    pub(super) fn halved(&self) -> Self {
        let smooth = self.smoothed();
        let rows = (0..self.height).step_by(2);
        Self {
            width: self.width.div_ceil(2),
            height: self.height.div_ceil(2),
            values: rows
                .flat_map(|y| smooth.row(y).iter().step_by(2).copied())
                .collect(),
        }
    }

    /// The inverse of halving for what varies slowly; values are multiplied by `factor`.
    pub(super) fn doubled(&self, width: usize, height: usize, factor: f32) -> Self {
        let cells = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        Self {
            width,
            height,
            values: cells
                .map(|(x, y)| factor * self.at(x as f32 * 0.5, y as f32 * 0.5))
                .collect(),
        }
    }

    /// Central differences to the right and down; half of it is missing at the edges.
    pub(super) fn slopes(&self) -> [Self; 2] {
        let (w, h) = (self.width, self.height);
        let mut slopes = [Self::zeros(w, h), Self::zeros(w, h)];
        for y in 0..h {
            let (row, above, below) = (
                self.row(y),
                self.row(y.saturating_sub(1)),
                self.row((y + 1).min(h - 1)),
            );
            for x in 0..w {
                let (left, right) = (row[x.saturating_sub(1)], row[(x + 1).min(w - 1)]);
                slopes[0].values[y * w + x] = 0.5 * (right - left);
                slopes[1].values[y * w + x] = 0.5 * (below[x] - above[x]);
            }
        }
        slopes
    }

    /// The middle of each cell and its eight neighbours, edges repeated.
    pub(super) fn medians(&self) -> Self {
        let (w, h) = (self.width, self.height);
        let mut out = Self::zeros(w, h);
        for y in 0..h {
            let rows = [
                self.row(y.saturating_sub(1)),
                self.row(y),
                self.row((y + 1).min(h - 1)),
            ];
            for x in 0..w {
                let columns = [x.saturating_sub(1), x, (x + 1).min(w - 1)];
                let [a, b, c] = columns.map(|x| sorted(rows.map(|row| row[x])));
                // Of sorted columns: the middle of greatest low, middle middle and least high.
                let low = a[0].max(b[0]).max(c[0]);
                let middle = sorted([a[1], b[1], c[1]])[1];
                let high = a[2].min(b[2]).min(c[2]);
                out.values[y * w + x] = sorted([low, middle, high])[1];
            }
        }
        out
    }
}

fn sorted([a, b, c]: [f32; 3]) -> [f32; 3] {
    let (low, high) = (a.min(b), a.max(b));
    [low.min(c), low.max(high.min(c)), high.max(c)]
}

/// The four cells around a place and their shares.
#[derive(Debug, Clone, Copy)]
pub(super) struct Corners {
    cells: [usize; 4],
    shares: [f32; 4],
}

impl Corners {
    /// In a grid of `width` by `height`; a place beyond the edge is moved onto it.
    pub(super) fn around(x: f32, y: f32, width: usize, height: usize) -> Self {
        let (x, y) = (
            x.max(0.0).min((width - 1) as f32),
            y.max(0.0).min((height - 1) as f32),
        );
        let (left, top) = (x as usize, y as usize);
        let (right, bottom) = ((left + 1).min(width - 1), (top + 1).min(height - 1));
        let (fx, fy) = (x - left as f32, y - top as f32);
        Self {
            cells: [
                top * width + left,
                top * width + right,
                bottom * width + left,
                bottom * width + right,
            ],
            shares: [
                (1.0 - fx) * (1.0 - fy),
                fx * (1.0 - fy),
                (1.0 - fx) * fy,
                fx * fy,
            ],
        }
    }

    /// The cell with the greatest share.
    pub(super) fn nearest(&self) -> usize {
        let right = self.shares[1] + self.shares[3] > 0.5;
        let bottom = self.shares[2] + self.shares[3] > 0.5;
        self.cells[2 * usize::from(bottom) + usize::from(right)]
    }

    /// The value of a plane there.
    pub(super) fn of(&self, values: &[f32]) -> f32 {
        let pairs = self.cells.iter().zip(&self.shares);
        pairs.map(|(cell, share)| share * values[*cell]).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp(width: usize, height: usize) -> Plane {
        let mut plane = Plane::zeros(width, height);
        for (i, value) in plane.values.iter_mut().enumerate() {
            *value = 3.0 * (i % width) as f32 - 2.0 * (i / width) as f32;
        }
        plane
    }

    #[test]
    fn a_slope_is_kept_by_everything_but_the_edges() {
        let plane = ramp(17, 12);
        assert!((plane.at(3.25, 4.5) - (9.75 - 9.0)).abs() < 1e-5);
        assert_eq!(plane.at(-5.0, 100.0), plane.at(0.0, 11.0));
        let [across, down] = plane.slopes();
        assert_eq!((across.at(5.0, 5.0), down.at(5.0, 5.0)), (3.0, -2.0));
        let half = plane.halved();
        assert_eq!((half.width, half.height), (9, 6));
        assert!((half.at(4.0, 3.0) - plane.at(8.0, 6.0)).abs() < 1e-4);
        let back = half.doubled(17, 12, 1.0);
        assert!((back.at(8.0, 7.0) - plane.at(8.0, 7.0)).abs() < 1e-4);
        assert_eq!(plane.medians().at(5.0, 5.0), plane.at(5.0, 5.0));
    }

    #[test]
    fn a_median_is_the_fifth_of_nine() {
        let mut plane = Plane::zeros(3, 3);
        plane.values = vec![9.0, 1.0, 8.0, 2.0, 7.0, 3.0, 6.0, 4.0, 5.0];
        assert_eq!(plane.medians().at(1.0, 1.0), 5.0);
    }

    #[test]
    fn one_cell_is_a_plane() {
        let mut plane = Plane::zeros(1, 1);
        plane.values[0] = 4.0;
        assert_eq!(plane.at(0.7, -3.0), 4.0);
        assert_eq!(plane.halved().values, [4.0]);
        assert_eq!(plane.medians().values, [4.0]);
        assert_eq!(plane.slopes()[0].values, [0.0]);
        assert_eq!(plane.doubled(2, 3, 0.5).values, [2.0; 6]);
    }
}

//! Exact Euclidean nearest return of every pixel, in time proportional to the pixel count.
//!
//! Two passes over the map, after Felzenszwalb and Huttenlocher, "Distance Transforms of Sampled
//! Functions" (2012): first the nearest return within each column, then along each row the lower
//! envelope of the parabolas those candidates span. Each parabola is lifted by its return's index,
//! scaled below one unit of squared distance, so that no two ever tie at a pixel and equal
//! distances go to the return that comes first row by row. Knows nothing of depths.

use crate::size::{Size, is_return};

/// Row of a candidate in a column that holds no return; far outside any map.
const NO_ROW: i32 = 1 << 20;

/// A parabola of the lower envelope of one row.
#[derive(Clone, Copy)]
struct Arc {
    column: u32,
    /// First column at which this parabola is the lowest.
    start: i32,
    /// `pixels * (column^2 + rise^2) + index` of the candidate, exact in `f64`.
    key: f64,
}

/// Nearest return of every pixel of one map; buffers are reused from call to call.
pub(crate) struct NearestField {
    size: Size,
    /// Row of the nearest return within the pixel's own column, or beyond +-`NO_ROW`.
    candidate_row: Vec<i32>,
    below: Vec<i32>,
    arcs: Vec<Arc>,
    /// Index of the nearest return.
    pub(crate) source: Vec<u32>,
    /// Squared distance to it in pixels.
    pub(crate) distance_sq: Vec<u32>,
}

impl NearestField {
    pub(crate) fn new(size: Size) -> Self {
        Self {
            size,
            candidate_row: vec![0; size.pixels()],
            below: vec![0; size.width()],
            arcs: vec![
                Arc {
                    column: 0,
                    start: 0,
                    key: 0.0
                };
                size.width()
            ],
            source: vec![0; size.pixels()],
            distance_sq: vec![0; size.pixels()],
        }
    }

    /// Finds the nearest return of every pixel; `false` if `sparse` holds none, in which case
    /// `source` and `distance_sq` mean nothing.
    pub(crate) fn find(&mut self, sparse: &[f32]) -> bool {
        self.search_columns(sparse);
        // Candidates are the nearest of a whole column, so row 0 sees every column that has one.
        if self.candidate_row[..self.size.width()]
            .iter()
            .all(|&row| row >= NO_ROW)
        {
            return false;
        }
        for y in 0..self.size.height() {
            let arc_count = self.envelope(y);
            self.read_envelope(y, arc_count);
        }
        true
    }

    /// Nearest return within each column; of two at equal distance, the upper.
    fn search_columns(&mut self, sparse: &[f32]) {
        let width = self.size.width();
        self.below.fill(-NO_ROW);
        for (y, (row, out)) in sparse
            .chunks_exact(width)
            .zip(self.candidate_row.chunks_exact_mut(width))
            .enumerate()
        {
            let y = y as i32;
            for ((&depth, out), above) in row.iter().zip(out).zip(&mut self.below) {
                *above = if is_return(depth) { y } else { *above };
                *out = *above;
            }
        }
        self.below.fill(2 * NO_ROW);
        for (y, out) in self.candidate_row.chunks_exact_mut(width).enumerate().rev() {
            let y = y as i32;
            for (candidate, below) in out.iter_mut().zip(&mut self.below) {
                *below = if *candidate == y { y } else { *below };
                *candidate = if *below - y < y - *candidate {
                    *below
                } else {
                    *candidate
                };
            }
        }
        // A column without returns has `-NO_ROW` above and `2 * NO_ROW` below: say it once.
        for candidate in &mut self.candidate_row {
            *candidate = if *candidate < 0 { NO_ROW } else { *candidate };
        }
    }

    /// Lower envelope of row `y`; returns how many arcs it has.
    fn envelope(&mut self, y: usize) -> usize {
        let width = self.size.width();
        let scale = self.size.pixels() as f64;
        let mut arc_count = 0;
        for (x, &row) in self.candidate_row[y * width..][..width].iter().enumerate() {
            if row >= NO_ROW {
                continue;
            }
            let rise = i64::from(row) - y as i64;
            let index = row as usize * width + x;
            let key = ((x * x) as i64 + rise * rise) as f64 * scale + index as f64;
            let mut start = 0;
            while arc_count > 0 {
                let top = self.arcs[arc_count - 1];
                let run = (x - top.column as usize) as f64;
                start = ceil((key - top.key) / (2.0 * scale * run));
                if start > top.start {
                    break;
                }
                arc_count -= 1;
                start = 0;
            }
            if start < width as i32 {
                self.arcs[arc_count] = Arc {
                    column: x as u32,
                    start,
                    key,
                };
                arc_count += 1;
            }
        }
        arc_count
    }

    /// Writes source and squared distance of row `y` from its envelope.
    fn read_envelope(&mut self, y: usize, arc_count: usize) {
        let width = self.size.width();
        let row_start = y * width;
        let mut end = width;
        for arc in self.arcs[..arc_count].iter().rev() {
            let column = arc.column as usize;
            let start = arc.start as usize;
            let row = self.candidate_row[row_start + column] as usize;
            let rise_sq = (row.abs_diff(y) * row.abs_diff(y)) as u32;
            self.source[row_start + start..row_start + end].fill((row * width + column) as u32);
            let distances = &mut self.distance_sq[row_start + start..row_start + end];
            for (x, distance_sq) in (start as i32..).zip(distances) {
                let run = x - column as i32;
                *distance_sq = (run * run) as u32 + rise_sq;
            }
            end = start;
        }
    }
}

/// `f64::ceil` without a library call, for quotients that fit an `i32` (others saturate).
#[inline]
fn ceil(value: f64) -> i32 {
    let whole = value as i32;
    whole.saturating_add(i32::from(f64::from(whole) < value))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// First index row by row among the nearest, by looking at every return.
    fn brute_force(sparse: &[f32], width: usize) -> Option<Vec<(u32, u32)>> {
        let returns: Vec<usize> = (0..sparse.len())
            .filter(|&index| is_return(sparse[index]))
            .collect();
        (0..sparse.len())
            .map(|pixel| {
                let distance_sq = |&index: &usize| {
                    let dx = (index % width).abs_diff(pixel % width);
                    let dy = (index / width).abs_diff(pixel / width);
                    dx * dx + dy * dy
                };
                // `min_by_key` keeps the first of equals.
                let nearest = returns.iter().min_by_key(|&index| distance_sq(index))?;
                Some((*nearest as u32, distance_sq(nearest) as u32))
            })
            .collect()
    }

    fn check(sparse: &[f32], width: usize, height: usize) {
        let mut field = NearestField::new(Size::new(width, height).expect("a size"));
        // Twice, so that what the first call left behind cannot matter.
        field.find(&vec![1.0; width * height]);
        let found = field.find(sparse);
        let expected = brute_force(sparse, width);
        assert_eq!(found, expected.is_some());
        if let Some(expected) = expected {
            let actual: Vec<(u32, u32)> = field
                .source
                .iter()
                .copied()
                .zip(field.distance_sq.iter().copied())
                .collect();
            assert_eq!(actual, expected);
        }
    }

    #[test]
    fn equal_distances_go_to_the_return_that_comes_first_row_by_row() {
        // Four returns around the centre of a 5x5 map, all two pixels away.
        let mut sparse = vec![0.0; 25];
        for index in [2, 10, 14, 22] {
            sparse[index] = 1.0;
        }
        check(&sparse, 5, 5);
        let mut field = NearestField::new(Size::new(5, 5).expect("a size"));
        assert!(field.find(&sparse));
        assert_eq!((field.source[12], field.distance_sq[12]), (2, 4));
    }

    #[test]
    fn rings_full_of_ties_match_brute_force() {
        for step in 2..7 {
            let (width, height) = (37, 29);
            let sparse: Vec<f32> = (0..width * height)
                .map(|index| {
                    let (x, y) = (index % width, index / width);
                    f32::from(u8::from(x % step == 0 && y % (step + 1) == step))
                })
                .collect();
            check(&sparse, width, height);
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]

        /// Any size, any density, invalid values included.
        #[test]
        fn matches_brute_force(
            width in 1_usize..40,
            height in 1_usize..40,
            density in 0.0_f64..0.3,
            seed in any::<u64>(),
        ) {
            let mut state = seed | 1;
            let mut random = || {
                state ^= state << 13;
                state ^= state >> 7;
                state ^= state << 17;
                (state >> 11) as f64 / (1_u64 << 53) as f64
            };
            let sparse: Vec<f32> = (0..width * height)
                .map(|_| match random() {
                    value if value < density => 1.0 + random() as f32,
                    value if value < 0.95 => 0.0,
                    value if value < 0.97 => f32::NAN,
                    value if value < 0.99 => -3.0,
                    _ => f32::INFINITY,
                })
                .collect();
            check(&sparse, width, height);
        }
    }
}

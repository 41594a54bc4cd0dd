//! Where the road really lies: what the returns on it say of a ground told a little wrongly.

use crate::ground::Ground;

/// Shifts looked for, rows up or down.
pub const HORIZON_ROWS_MAX: f32 = 10.0;
/// What a shift is found to, rows. Finer would be noise: a return's row is a whole number.
pub const HORIZON_ROWS_STEP: f32 = 0.5;

/// Returns nearer than this say little: a centimetre moves them by a tenth of a row and more.
const NEAR_M: f32 = 5.0;
/// Roads seldom stay level farther than this.
const FAR_M: f32 = 50.0;
/// Bins of a row.
const BINS_PER_ROW: usize = 4;
/// Bins in all.
const BINS: usize = 2 * HORIZON_ROWS_MAX as usize * BINS_PER_ROW;
/// Bins that returns from one plane fill: their rows are rounded, their ranges noisy.
const PEAK_BINS: usize = 2 * BINS_PER_ROW;
/// A road has at least so many returns,
const RETURNS_MIN: u32 = 48;
/// that are one in so many of those that might be its own,
const SHARE_MIN: u32 = 8;
/// and so many times as many as the best that does not overlap it.
const LEAD_MIN: u32 = 2;

/// Finds by how many rows the horizon lies elsewhere than told, from one map of returns.
///
/// A camera that pitches by a small angle moves every row of the road by the same number of rows, and the
/// road's inverse depth is linear over the rows ([`Ground`]). So each return names the one shift that
/// would put it on the road. Those on the road agree; those on walls, cars and posts name as many shifts
/// as they have rows. Where no shift stands out nothing is said. Height and roll of the camera are taken
/// as told. Allocates nothing.
///
/// ```
/// use noctule_depth::{Ground, Levelling};
///
/// let told = Ground::level(1.5, 262.0, 63.5).unwrap();
/// let (width, truth) = (128, told.lowered(2.0));
/// let mut sparse = vec![0.0; width * width];
/// for cell in (80 * width..100 * width).step_by(7) {
///     sparse[cell] = 1.0 / truth.inverse_depth(0.0, (cell / width) as f32);
/// }
/// assert_eq!(Levelling::new().rows_down(&told, &sparse, width), Some(2.0));
/// ```
#[derive(Debug, Clone)]
pub struct Levelling {
    /// Returns that ask for a shift within each bin.
    count: [u32; BINS],
    /// What they ask for, added up, rows.
    total: [f32; BINS],
}

impl Default for Levelling {
    fn default() -> Self {
        Self {
            count: [0; BINS],
            total: [0.0; BINS],
        }
    }
}

impl Levelling {
    /// Nothing counted yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// How many rows farther down than `told` the road lies in a picture of `width` columns, to
    /// [`HORIZON_ROWS_STEP`] and within [`HORIZON_ROWS_MAX`], by the returns of `sparse`, metres, 0 for
    /// none. What it finds is `told.lowered(rows)`. `None` where the returns do not say.
    pub fn rows_down(&mut self, told: &Ground, sparse: &[f32], width: usize) -> Option<f32> {
        let per_row = told.per_row;
        if width == 0 || per_row.is_nan() || per_row <= 0.0 {
            return None;
        }
        self.count(told, sparse, width);
        let (peak, returns) = self.peak(0..0);
        let (_, second) = self.peak(peak.saturating_sub(PEAK_BINS - 1)..peak + PEAK_BINS);
        let all: u32 = self.count.iter().sum();
        let stands_out =
            returns >= RETURNS_MIN.max(all / SHARE_MIN) && returns >= LEAD_MIN * second;
        stands_out.then(|| {
            let total: f32 = self.total[peak..peak + PEAK_BINS].iter().sum();
            let rows = total / returns as f32;
            (rows / HORIZON_ROWS_STEP).round() * HORIZON_ROWS_STEP
        })
    }

    fn count(&mut self, told: &Ground, sparse: &[f32], width: usize) {
        self.count.fill(0);
        self.total.fill(0.0);
        for (row, line) in sparse.chunks(width).enumerate() {
            for (column, &depth) in line.iter().enumerate() {
                if !(NEAR_M..FAR_M).contains(&depth) {
                    continue;
                }
                let excess = told.inverse_depth(column as f32, row as f32) - 1.0 / depth;
                let rows = excess / told.per_row;
                let bin = ((rows + HORIZON_ROWS_MAX) * BINS_PER_ROW as f32).floor();
                if (0.0..BINS as f32).contains(&bin) {
                    self.count[bin as usize] += 1;
                    self.total[bin as usize] += rows;
                }
            }
        }
    }

    /// The run of [`PEAK_BINS`] bins with the most returns that does not begin within `beside`: its first
    /// bin, and its returns. Of equals, the one closest to what was told.
    fn peak(&self, beside: std::ops::Range<usize>) -> (usize, u32) {
        let middle = (BINS - PEAK_BINS) / 2;
        (0..=BINS - PEAK_BINS)
            .filter(|first| !beside.contains(first))
            .map(|first| (first, self.count[first..first + PEAK_BINS].iter().sum()))
            .max_by_key(|&(first, returns): &(usize, u32)| {
                (returns, usize::MAX - first.abs_diff(middle))
            })
            .unwrap_or((middle, 0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: usize = 64;

    fn told() -> Ground {
        Ground::level(1.5, 262.0, 63.5).unwrap()
    }

    /// Rings on a road that lies `rows` lower than told, every fifth column.
    fn road(rows: f32) -> Vec<f32> {
        let truth = told().lowered(rows);
        let mut sparse = vec![0.0; 2 * WIDTH * WIDTH];
        for row in (74..126).step_by(5) {
            for column in (0..WIDTH).step_by(5) {
                // A ring hits somewhere within its row.
                let true_row = row as f32 + (column as f32 * 0.37).fract() - 0.5;
                sparse[row * WIDTH + column] = 1.0 / truth.inverse_depth(0.0, true_row);
            }
        }
        sparse
    }

    #[test]
    fn a_pitch_is_found_to_half_a_row() {
        for rows in [-9.0, -6.0, -2.3, -0.2, 0.0, 0.2, 1.1, 2.5, 6.0, 9.0] {
            let found = Levelling::new().rows_down(&told(), &road(rows), WIDTH);
            let found = found.unwrap_or_else(|| panic!("nothing for {rows}"));
            assert!((found - rows).abs() <= 0.35, "{found} for {rows}");
            assert_eq!(found, (2.0 * found).round() / 2.0);
        }
        let mut levelling = Levelling::new();
        let first = levelling.rows_down(&told(), &road(4.0), WIDTH);
        assert_eq!(first, Some(4.0));
        assert_eq!(
            levelling.rows_down(&told(), &road(0.0), WIDTH),
            Some(0.0),
            "nothing is kept"
        );
    }

    #[test]
    fn a_road_that_leans_sideways_is_compared_column_by_column() {
        let told = Ground {
            per_column: 1e-4,
            ..told()
        };
        let truth = told.lowered(3.0);
        let mut sparse = vec![0.0; 2 * WIDTH * WIDTH];
        for row in (80..120).step_by(4) {
            for column in (0..WIDTH).step_by(4) {
                sparse[row * WIDTH + column] = 1.0 / truth.inverse_depth(column as f32, row as f32);
            }
        }
        let found = Levelling::new().rows_down(&told, &sparse, WIDTH);
        assert_eq!(found, Some(3.0));
    }

    #[test]
    fn a_wall_does_not_outvote_the_road() {
        // 14 m ahead, a return in every pixel.
        let behind_a_wall = |columns: usize| {
            let mut sparse = road(2.0);
            (40..100).for_each(|row| sparse[row * WIDTH..row * WIDTH + columns].fill(14.0));
            Levelling::new().rows_down(&told(), &sparse, WIDTH)
        };
        assert_eq!(
            behind_a_wall(10),
            Some(2.0),
            "600 returns on it, 120 beside"
        );
        assert_eq!(behind_a_wall(50), None, "next to no road is left");
    }

    #[test]
    fn where_no_road_is_seen_nothing_is_said() {
        let mut levelling = Levelling::new();
        let told = told();
        let mut say = |sparse: &[f32]| levelling.rows_down(&told, sparse, WIDTH);
        assert_eq!(say(&[]), None);
        assert_eq!(say(&vec![0.0; 4096]), None);
        assert_eq!(say(&vec![14.0; 8192]), None, "a wall");
        assert_eq!(say(&vec![f32::NAN; 4096]), None);
        let mut few = vec![0.0; 2 * WIDTH * WIDTH];
        few[80 * WIDTH..80 * WIDTH + 40].fill(1.0 / told.inverse_depth(0.0, 80.0));
        assert_eq!(say(&few), None, "forty returns");
        let upside_down = Ground {
            per_row: -told.per_row,
            ..told
        };
        let sparse = road(0.0);
        let mut levelling = Levelling::new();
        assert_eq!(levelling.rows_down(&upside_down, &sparse, WIDTH), None);
        assert_eq!(levelling.rows_down(&told, &sparse, 0), None);
    }
}

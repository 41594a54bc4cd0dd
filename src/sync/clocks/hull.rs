//! The lower convex hull of a bucket of points: whatever slope turns out to be right, the lowest
//! point under that slope is one of its corners.

/// Corners kept per bucket; exponential delays give about 2 ln n, 16 of 3000 packets.
const CORNERS: usize = 32;

/// One bucket: consecutive (sensor time, arrival minus sensor time) points, reduced to their hull.
///
/// INVARIANT: corner `x` strictly increase and slopes between corners strictly increase.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bucket {
    corners: [(f64, f64); CORNERS],
    len: usize,
    /// Points offered.
    pub count: u32,
    /// Sum of their heights, for the mean delay.
    sum: f64,
    sum_x: f64,
}

impl Bucket {
    pub const EMPTY: Self = Self {
        corners: [(0.0, 0.0); CORNERS],
        len: 0,
        count: 0,
        sum: 0.0,
        sum_x: 0.0,
    };

    /// Adds a point to the right of all others.
    pub fn push(&mut self, x: f64, y: f64) {
        self.count = self.count.saturating_add(1);
        self.sum += y;
        self.sum_x += x;
        while self.len >= 2 {
            let (x0, y0) = self.corners[self.len - 2];
            let (x1, y1) = self.corners[self.len - 1];
            if (y1 - y0) * (x - x1) < (y - y1) * (x1 - x0) {
                break;
            }
            self.len -= 1;
        }
        if self.len == CORNERS {
            self.drop_flattest();
        }
        self.corners[self.len] = (x, y);
        self.len += 1;
    }

    /// Gives up the inner corner that sticks out least, so that there is room for another.
    fn drop_flattest(&mut self) {
        let area = |i: usize| {
            let [(x0, y0), (x1, y1), (x2, y2)] =
                [self.corners[i - 1], self.corners[i], self.corners[i + 1]];
            ((x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)).abs()
        };
        let flattest = (1..CORNERS - 1)
            .min_by(|&i, &j| area(i).total_cmp(&area(j)))
            .unwrap_or(1);
        self.corners.copy_within(flattest + 1.., flattest);
        self.len -= 1;
    }

    /// The point lowest under a line of this slope.
    pub fn lowest(&self, slope: f64) -> Option<(f64, f64)> {
        self.corners[..self.len]
            .iter()
            .copied()
            .min_by(|a, b| (a.1 - slope * a.0).total_cmp(&(b.1 - slope * b.0)))
    }

    /// Mean height above the lowest point under this slope: the mean of the random delay.
    pub fn mean_excess(&self, slope: f64) -> f64 {
        let Some((x, y)) = self.lowest(slope) else {
            return 0.0;
        };
        let n = f64::from(self.count.max(1));
        ((self.sum / n - slope * self.sum_x / n) - (y - slope * x)).max(0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_hull_finds_the_same_lowest_point_as_looking_at_all() {
        let mut state = 7_u64;
        let mut next = || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 11) as f64 / (1_u64 << 53) as f64
        };
        let mut bucket = Bucket::EMPTY;
        let points: Vec<(f64, f64)> = (0..3000)
            .map(|i| (f64::from(i) * 333e3, -3e4 * next().ln()))
            .collect();
        for &(x, y) in &points {
            bucket.push(x, y);
        }
        for slope in [-2e-4, -5e-5, 0.0, 1e-6, 2e-4] {
            let best = points
                .iter()
                .map(|(x, y)| y - slope * x)
                .fold(f64::INFINITY, f64::min);
            let (x, y) = bucket.lowest(slope).unwrap();
            assert_eq!(y - slope * x, best);
        }
        assert!((bucket.mean_excess(0.0) - 3e4).abs() < 3e3);
    }

    #[test]
    fn a_hull_with_too_many_corners_stays_close() {
        let mut bucket = Bucket::EMPTY;
        for i in 0..1000_i32 {
            let x = f64::from(i - 500);
            bucket.push(x, x * x);
        }
        assert!(bucket.len <= CORNERS);
        let (_, y) = bucket.lowest(0.0).unwrap();
        assert!(y <= 1000.0, "{y}");
    }
}

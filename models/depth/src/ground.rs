//! Level ground as a camera sees it.

/// A plane in a picture: the inverse of its depth is linear over the pixels.
///
/// Points X of the plane satisfy `normal . X = height`, with the camera's frame x right, y down, z
/// forward. The ray through pixel (u, v) is ((u - cx) / fx, (v - cy) / fy, 1), so that
/// 1 / depth = normal . ray / height. Whole pixel coordinates are pixel centres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ground {
    /// What one column to the right adds to the inverse depth, 1/m.
    pub per_column: f32,
    /// What one row down adds, 1/m.
    pub per_row: f32,
    /// The inverse depth at the first pixel of the first row, 1/m; below 0 above the horizon.
    pub first: f32,
}

impl Ground {
    /// The plane `height_m` beneath a camera of focal lengths `focal_px` and principal point
    /// `centre_px` (both horizontal, vertical; pixels); `normal` points down, away from the
    /// camera, in the camera's frame. `None` where the numbers describe no plane beneath.
    #[must_use]
    pub fn beneath(
        height_m: f64,
        normal: [f64; 3],
        focal_px: [f64; 2],
        centre_px: [f64; 2],
    ) -> Option<Self> {
        let column = normal[0] / (focal_px[0] * height_m);
        let row = normal[1] / (focal_px[1] * height_m);
        let first = normal[2] / height_m - column * centre_px[0] - row * centre_px[1];
        let is_plane = height_m > 0.0 && focal_px.iter().all(|f| *f > 0.0);
        Self::from_numbers([column, row, first].map(|number| number as f32)).filter(|_| is_plane)
    }

    /// The ground beneath a camera that looks along the horizon.
    #[must_use]
    pub fn level(height_m: f64, focal_px: f64, horizon_row: f64) -> Option<Self> {
        let (down, focal) = ([0.0, 1.0, 0.0], [focal_px; 2]);
        Self::beneath(height_m, down, focal, [0.0, horizon_row])
    }

    /// As it is stored and sent: `per_column`, `per_row`, `first`.
    #[must_use]
    pub fn numbers(&self) -> [f32; 3] {
        [self.per_column, self.per_row, self.first]
    }

    /// The inverse of [`numbers`](Self::numbers); `None` for three zeros, which stand for a ground
    /// that is not known, and for what is not finite.
    #[must_use]
    pub fn from_numbers(numbers: [f32; 3]) -> Option<Self> {
        let [per_column, per_row, first] = numbers;
        let is_told = numbers != [0.0; 3] && numbers.iter().all(|number| number.is_finite());
        is_told.then_some(Self {
            per_column,
            per_row,
            first,
        })
    }

    /// Inverse depth at a pixel, 1/m; 0 and below from the horizon up.
    #[must_use]
    pub fn inverse_depth(&self, column: f32, row: f32) -> f32 {
        self.per_column * column + (self.per_row * row + self.first)
    }

    /// As a picture would show it whose rows all lie `rows` farther down, as when the camera pitches up.
    #[must_use]
    pub fn lowered(&self, rows: f32) -> Self {
        Self {
            first: self.first - rows * self.per_row,
            ..*self
        }
    }

    /// In the pixels of a square cut out at column `x0`, row `y0`.
    #[must_use]
    pub fn cut(&self, x0: usize, y0: usize) -> Self {
        Self {
            first: self.inverse_depth(x0 as f32, y0 as f32),
            ..*self
        }
    }

    /// In the pixels of the picture enlarged by `factor`.
    #[must_use]
    pub fn enlarged(&self, factor: f64) -> Self {
        let (shrink, corner) = ((1.0 / factor) as f32, (0.5 / factor - 0.5) as f32);
        Self {
            per_column: self.per_column * shrink,
            per_row: self.per_row * shrink,
            first: self.inverse_depth(corner, corner),
        }
    }

    /// In the pixels of the mirrored picture of `width` columns.
    #[must_use]
    pub fn mirrored(&self, width: usize) -> Self {
        Self {
            per_column: -self.per_column,
            per_row: self.per_row,
            first: self.inverse_depth(width as f32 - 1.0, 0.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_level_camera_sees_ground_by_the_rule_of_three() {
        // 1.5 m up, 200 px: 10 m ahead the ground is 30 rows below the horizon.
        let ground = Ground::level(1.5, 200.0, 127.5).unwrap();
        assert!((ground.inverse_depth(17.0, 157.5) - 0.1).abs() < 1e-6);
        assert!((ground.inverse_depth(200.0, 142.5) - 0.05).abs() < 1e-6);
        assert!(ground.inverse_depth(0.0, 127.0) < 0.0, "above the horizon");
    }

    #[test]
    fn cut_enlarged_and_mirrored_pictures_see_the_same_ground() {
        let normal = [0.1, 0.9, 0.2];
        let ground = Ground::beneath(2.0, normal, [150.0, 160.0], [60.0, 40.0]).unwrap();
        let same = |a: f32, b: f32| assert!((a - b).abs() < 1e-5, "{a} and {b}");
        let by_hand = (0.1 * (90.0 - 60.0) / 150.0 + 0.9 * (70.0 - 40.0) / 160.0 + 0.2) / 2.0;
        same(ground.inverse_depth(90.0, 70.0), by_hand as f32);
        same(ground.cut(20, 30).inverse_depth(70.0, 40.0), by_hand as f32);
        // Twice as large, pixel 90 spans 180 and 181.
        let twice = ground.enlarged(2.0);
        same(twice.inverse_depth(180.5, 140.5), by_hand as f32);
        same(
            ground.mirrored(128).inverse_depth(37.0, 70.0),
            by_hand as f32,
        );
    }

    #[test]
    fn it_survives_its_numbers() {
        let ground = Ground::beneath(2.0, [0.1, 0.9, 0.2], [150.0; 2], [60.0, 40.0]);
        assert_eq!(
            ground.and_then(|g| Ground::from_numbers(g.numbers())),
            ground
        );
        assert!(ground.is_some());
        assert_eq!(Ground::from_numbers([0.0; 3]), None);
        assert_eq!(Ground::from_numbers([0.0, f32::NAN, 1.0]), None);
    }

    #[test]
    fn what_is_no_plane_is_none() {
        let down = [0.0, 1.0, 0.0];
        assert_eq!(Ground::beneath(0.0, down, [1.0; 2], [0.0; 2]), None);
        assert_eq!(Ground::beneath(-1.0, down, [1.0; 2], [0.0; 2]), None);
        assert_eq!(Ground::beneath(1.0, down, [0.0, 1.0], [0.0; 2]), None);
        assert_eq!(Ground::beneath(f64::NAN, down, [1.0; 2], [0.0; 2]), None);
        assert_eq!(
            Ground::beneath(1.0, [0.0, f64::NAN, 0.0], [1.0; 2], [0.0; 2]),
            None
        );
    }
}

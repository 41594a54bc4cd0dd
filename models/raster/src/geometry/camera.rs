//! A pinhole camera with Brown-Conrady distortion, in both directions.
//!
//! The camera's frame of reference: x right, y down, z forward, metres.

use nalgebra::{Matrix2, Point3, Vector2, Vector3};

use super::Rescale;
use crate::RasterError;

/// Points nearer than this to the camera's plane are not projected, metres.
const NEAR_M: f64 = 1e-6;
/// Squared tangent beyond which no lens of this model is looked at (84 degrees off the axis).
const RADIUS2_LIMIT: f64 = 100.0;

/// Brown-Conrady coefficients in the usual order of calibration tools; all zero for a perfect lens.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Distortion {
    /// Radial, second order.
    pub k1: f64,
    /// Radial, fourth order.
    pub k2: f64,
    /// Tangential, along y.
    pub p1: f64,
    /// Tangential, along x.
    pub p2: f64,
    /// Radial, sixth order.
    pub k3: f64,
}

impl Distortion {
    /// Distorted normalised coordinates of `(x, y)`.
    fn apply(&self, x: f64, y: f64) -> Vector2<f64> {
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3));
        Vector2::new(
            x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x),
            y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y,
        )
    }

    /// Derivative of [`apply`](Self::apply).
    fn jacobian(&self, x: f64, y: f64) -> Matrix2<f64> {
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3));
        let slope = 2.0 * (self.k1 + r2 * (2.0 * self.k2 + r2 * 3.0 * self.k3));
        let cross = x * y * slope + 2.0 * (self.p1 * x + self.p2 * y);
        Matrix2::new(
            radial + x * x * slope + 2.0 * self.p1 * y + 6.0 * self.p2 * x,
            cross,
            cross,
            radial + y * y * slope + 6.0 * self.p1 * y + 2.0 * self.p2 * x,
        )
    }

    /// Squared radius at which the radial polynomial stops growing: beyond it the model folds the
    /// world back into the image, so points there are not seen.
    fn radius2_max(&self) -> f64 {
        let slope = |s: f64| 1.0 + s * (3.0 * self.k1 + s * (5.0 * self.k2 + s * 7.0 * self.k3));
        let mut inside = 0.0;
        while inside < RADIUS2_LIMIT {
            let mut beyond = inside + 1e-3 * (1.0 + inside);
            if slope(beyond) <= 0.0 {
                for _ in 0..50 {
                    let middle = 0.5 * (inside + beyond);
                    if slope(middle) > 0.0 {
                        inside = middle
                    } else {
                        beyond = middle
                    }
                }
                return inside;
            }
            inside = beyond;
        }
        f64::INFINITY
    }
}

/// Focal lengths, principal point and distortion of one camera, in pixels of one image size.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pinhole {
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    distortion: Distortion,
    radius2_max: f64,
}

impl Pinhole {
    /// A camera with focal lengths `fx`, `fy` and principal point (`cx`, `cy`), all in pixels.
    ///
    /// # Errors
    /// [`RasterError::Camera`], naming the parameter that is not finite, or the focal length that
    /// is not positive.
    pub fn new(
        fx: f64,
        fy: f64,
        cx: f64,
        cy: f64,
        distortion: Distortion,
    ) -> Result<Self, RasterError> {
        let Distortion { k1, k2, p1, p2, k3 } = distortion;
        let named = [
            ("fx", fx),
            ("fy", fy),
            ("cx", cx),
            ("cy", cy),
            ("k1", k1),
            ("k2", k2),
            ("p1", p1),
            ("p2", p2),
            ("k3", k3),
        ];
        for (index, (name, value)) in named.into_iter().enumerate() {
            if !value.is_finite() || (index < 2 && value <= 0.0) {
                return Err(RasterError::Camera { name, value });
            }
        }
        Ok(Self {
            fx,
            fy,
            cx,
            cy,
            distortion,
            radius2_max: distortion.radius2_max(),
        })
    }

    /// Focal lengths (fx, fy), pixels.
    #[must_use]
    pub const fn focal(&self) -> (f64, f64) {
        (self.fx, self.fy)
    }

    /// Principal point (cx, cy), pixels.
    #[must_use]
    pub const fn centre(&self) -> (f64, f64) {
        (self.cx, self.cy)
    }

    /// The lens's distortion.
    #[must_use]
    pub const fn distortion(&self) -> Distortion {
        self.distortion
    }

    /// The same camera in pixels of the cropped and rescaled image.
    #[must_use]
    pub fn rescaled(&self, rescale: &Rescale) -> Self {
        let (sx, sy) = rescale.scale();
        let (cx, cy) = rescale.grid_from_sensor((self.cx, self.cy));
        Self {
            fx: self.fx * sx,
            fy: self.fy * sy,
            cx,
            cy,
            ..*self
        }
    }

    /// Pixel coordinates (u, v) of a point in the camera's frame, metres.
    ///
    /// `None` for points behind the camera, not finite, or so far off the axis that the lens model
    /// folds; the coordinates may lie outside the image.
    #[inline]
    #[must_use]
    pub fn project(&self, point: &Point3<f64>) -> Option<(f64, f64)> {
        if point.z.is_nan() || point.z < NEAR_M {
            return None;
        }
        let inverse = 1.0 / point.z;
        let (x, y) = (point.x * inverse, point.y * inverse);
        let r2 = x * x + y * y;
        if r2.is_nan() || r2 > self.radius2_max {
            return None;
        }
        let bent = if self.distortion == Distortion::default() {
            Vector2::new(x, y)
        } else {
            self.distortion.apply(x, y)
        };
        Some((self.fx * bent.x + self.cx, self.fy * bent.y + self.cy))
    }

    /// Direction, with z = 1, of the ray through pixel coordinates (u, v): the inverse of
    /// [`project`](Self::project) to 1e-12.
    ///
    /// `None` where no ray the lens model holds for meets that pixel.
    #[must_use]
    pub fn unproject(&self, (u, v): (f64, f64)) -> Option<Vector3<f64>> {
        let target = Vector2::new((u - self.cx) / self.fx, (v - self.cy) / self.fy);
        let mut ray = target;
        for _ in 0..50 {
            let error = self.distortion.apply(ray.x, ray.y) - target;
            if error.norm() < 1e-13 * (1.0 + target.norm()) {
                return (ray.norm_squared() <= self.radius2_max)
                    .then(|| Vector3::new(ray.x, ray.y, 1.0));
            }
            ray -= self.distortion.jacobian(ray.x, ray.y).try_inverse()? * error;
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Crop, Grid};
    use nalgebra::Matrix3;
    use proptest::prelude::*;

    fn lens() -> Pinhole {
        let distortion = Distortion {
            k1: -0.31,
            k2: 0.12,
            p1: 8e-4,
            p2: -5e-4,
            k3: -0.02,
        };
        Pinhole::new(520.0, 524.0, 250.5, 261.25, distortion).unwrap()
    }

    #[test]
    fn a_perfect_lens_is_the_matrix_product() {
        let camera = Pinhole::new(262.0, 260.0, 127.5, 128.5, Distortion::default()).unwrap();
        let matrix = Matrix3::new(262.0, 0.0, 127.5, 0.0, 260.0, 128.5, 0.0, 0.0, 1.0);
        let point = Point3::new(1.5, -0.75, 12.0);
        let expected = matrix * point;
        let (u, v) = camera.project(&point).unwrap();
        assert!(
            (u - expected.x / expected.z).abs() < 1e-12
                && (v - expected.y / expected.z).abs() < 1e-12
        );
    }

    #[test]
    fn distortion_worked_by_hand() {
        // x = 0.5, y = 0: r2 = 1/4; radial 1 + 0.1/4 = 1.025; p2 adds 0.01 * (1/4 + 1/2).
        let lens = Distortion {
            k1: 0.1,
            p2: 0.01,
            ..Distortion::default()
        };
        let camera = Pinhole::new(100.0, 100.0, 0.0, 0.0, lens).unwrap();
        let (u, v) = camera.project(&Point3::new(1.0, 0.0, 2.0)).unwrap();
        assert!((u - 52.0).abs() < 1e-12 && v == 0.0, "{u} {v}");
    }

    proptest! {
        #[test]
        fn rays_come_back(u in 0.0..512.0f64, v in 0.0..512.0f64, depth in 0.2..80.0f64) {
            let ray = lens().unproject((u, v)).unwrap();
            let (a, b) = lens().project(&Point3::from(ray * depth)).unwrap();
            prop_assert!((a - u).abs() < 1e-9 && (b - v).abs() < 1e-9);
        }
    }

    #[test]
    fn points_the_lens_folds_back_are_not_seen() {
        // Barrel distortion alone: r (1 - 0.3 r2) turns round at r2 = 1/0.9.
        let lens = Distortion {
            k1: -0.3,
            ..Distortion::default()
        };
        let camera = Pinhole::new(200.0, 200.0, 128.0, 128.0, lens).unwrap();
        assert!(camera.project(&Point3::new(1.05, 0.0, 1.0)).is_some());
        assert_eq!(camera.project(&Point3::new(1.06, 0.0, 1.0)), None);
        // At r = 1.8 the polynomial reads r * 0.028: a point 61 degrees off the axis that would
        // otherwise land ten pixels from the centre.
        assert_eq!(camera.project(&Point3::new(1.8, 0.0, 1.0)), None);
        assert_eq!(camera.project(&Point3::new(0.0, 0.0, -1.0)), None);
        assert_eq!(camera.project(&Point3::new(0.0, f64::NAN, 1.0)), None);
        assert_eq!(camera.unproject((128.0 + 200.0 * 0.71, 128.0)), None); // the fold is at 0.703
    }

    #[test]
    fn a_rescaled_camera_sees_the_rescaled_pixel() {
        let crop = Crop {
            x: 64,
            y: 32,
            width: 384,
            height: 448,
        };
        let rescale = Rescale::new(Grid::new(512, 512), crop, Grid::new(256, 224)).unwrap();
        let point = Point3::new(0.7, -0.4, 3.0);
        let (u, v) = lens().rescaled(&rescale).project(&point).unwrap();
        let expected = rescale.grid_from_sensor(lens().project(&point).unwrap());
        assert!((u - expected.0).abs() < 1e-9 && (v - expected.1).abs() < 1e-9);
    }

    #[test]
    fn bad_parameters_are_named() {
        let none = Distortion::default();
        let error = Pinhole::new(0.0, 1.0, 0.0, 0.0, none).unwrap_err();
        assert_eq!(error.to_string(), "camera parameter fx is 0");
        let nan = Distortion {
            k3: f64::NAN,
            ..none
        };
        assert_eq!(
            Pinhole::new(1.0, 1.0, 0.0, 0.0, nan)
                .unwrap_err()
                .to_string(),
            "camera parameter k3 is NaN"
        );
    }
}

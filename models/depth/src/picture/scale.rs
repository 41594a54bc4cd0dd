//! From metres to a position on a colour ramp, the same for every picture of a sheet.

use super::canvas::PictureError;

/// Colour of pixels without a value.
pub const INVALID_RGB: [u8; 3] = [38, 40, 44];

/// Which depths the two ends of the ramp stand for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scale {
    near_m: f32,
    far_m: f32,
    is_log: bool,
}

impl Scale {
    /// Night driving: 1 to 80 m, each doubling of the distance equally wide.
    pub const DRIVE: Self = Self {
        near_m: 1.0,
        far_m: 80.0,
        is_log: true,
    };
    /// Indoors: 0.5 to 10 m, logarithmic.
    pub const INDOOR: Self = Self {
        near_m: 0.5,
        far_m: 10.0,
        is_log: true,
    };

    /// Logarithmic between two depths in metres; errs unless `0 < near_m < far_m`, both finite.
    pub fn log(near_m: f32, far_m: f32) -> Result<Self, PictureError> {
        Self::checked(near_m, far_m, true)
    }

    /// Linear between two depths in metres; errs unless `0 < near_m < far_m`, both finite.
    pub fn linear(near_m: f32, far_m: f32) -> Result<Self, PictureError> {
        Self::checked(near_m, far_m, false)
    }

    fn checked(near_m: f32, far_m: f32, is_log: bool) -> Result<Self, PictureError> {
        if near_m > 0.0 && near_m < far_m && far_m.is_finite() {
            Ok(Self {
                near_m,
                far_m,
                is_log,
            })
        } else {
            Err(PictureError::Scale { near_m, far_m })
        }
    }

    /// Depth at the light end, metres.
    pub fn near_m(self) -> f32 {
        self.near_m
    }

    /// Depth at the dark end, metres.
    pub fn far_m(self) -> f32 {
        self.far_m
    }

    /// Position of a depth on the ramp, clamped to `0..=1`.
    #[inline]
    pub fn position(self, depth_m: f32) -> f32 {
        let depth_m = depth_m.clamp(self.near_m, self.far_m);
        if self.is_log {
            (depth_m / self.near_m).ln() / (self.far_m / self.near_m).ln()
        } else {
            (depth_m - self.near_m) / (self.far_m - self.near_m)
        }
    }

    /// Round depths (1, 2 or 5 times a power of ten) to label, near to far.
    pub fn ticks_m(self) -> Vec<f32> {
        if self.is_log {
            let first = self.near_m.log10().floor() as i32;
            let last = self.far_m.log10().floor() as i32;
            let mut ticks: Vec<f32> = (first..=last)
                .flat_map(|decade| [1.0, 2.0, 5.0].map(|digit| digit * 10_f32.powi(decade)))
                .filter(|tick| (self.near_m..=self.far_m).contains(tick))
                .collect();
            // The dark end itself, unless a round depth sits close by.
            if ticks.last().is_none_or(|&tick| self.position(tick) < 0.93) {
                ticks.push(self.far_m);
            }
            return ticks;
        }
        let raw = (self.far_m - self.near_m) / 5.0;
        let decade = 10_f32.powf(raw.log10().floor());
        let step = decade
            * [1.0, 2.0, 5.0, 10.0]
                .into_iter()
                .find(|&d| d * decade >= raw)
                .unwrap_or(10.0);
        let (first, last) = (
            (self.near_m / step).ceil() as u32,
            (self.far_m / step).floor() as u32,
        );
        (first..=last).map(|count| count as f32 * step).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_doubling_is_equally_wide_on_the_log_scale() {
        let scale = Scale::DRIVE;
        let step = scale.position(4.0) - scale.position(2.0);
        for depth in [1.0, 5.0, 10.0, 40.0] {
            let wide = scale.position(2.0 * depth) - scale.position(depth);
            assert!((wide - step).abs() < 1e-5, "{depth}");
        }
        assert_eq!((scale.position(0.2), scale.position(300.0)), (0.0, 1.0));
        assert_eq!(
            Scale::linear(10.0, 30.0).expect("a scale").position(15.0),
            0.25
        );
    }

    #[test]
    fn ticks_are_round_and_inside() {
        assert_eq!(
            Scale::DRIVE.ticks_m(),
            [1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 80.0]
        );
        assert_eq!(Scale::INDOOR.ticks_m(), [0.5, 1.0, 2.0, 5.0, 10.0]);
        let linear = Scale::linear(0.5, 10.0).expect("a scale");
        assert_eq!(linear.ticks_m(), [2.0, 4.0, 6.0, 8.0, 10.0]);
    }

    #[test]
    fn a_scale_needs_two_ends() {
        let pairs = [
            (0.0, 5.0),
            (5.0, 5.0),
            (6.0, 5.0),
            (1.0, f32::INFINITY),
            (f32::NAN, 5.0),
        ];
        for (near, far) in pairs {
            assert!(Scale::log(near, far).is_err() && Scale::linear(near, far).is_err());
        }
        let error = Scale::log(6.0, 5.0).expect_err("reversed");
        assert_eq!(
            error.to_string(),
            "colour scale from 6 m to 5 m is not a rising range above 0"
        );
    }
}

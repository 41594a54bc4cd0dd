//! How far a depth map is from the truth: the published five, per image.
//!
//! Sums run in `f64` in pixel order, so a number does not depend on who computed it.

use crate::size::{SizeError, check_len};
use thiserror::Error;

/// Ratio under which a pixel counts as right for `delta1`.
const DELTA1_RATIO: f64 = 1.25;

/// Why an image has no metrics.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum MetricsError {
    /// Slices of different lengths.
    #[error(transparent)]
    Size(#[from] SizeError),
    /// The prediction is not a number where there is truth.
    #[error("predicted depth is not a number at pixel {index}")]
    NotANumber {
        /// Index of the first such pixel.
        index: usize,
    },
    /// `d_min` and `cap` leave no depth to predict.
    #[error("predictions cannot be clamped to {d_min} m ..= {cap} m")]
    Range {
        /// Lower bound asked for, metres.
        d_min: f32,
        /// Upper bound asked for, metres.
        cap: f32,
    },
    /// No pixel of the truth lies in `0 < depth <= cap`.
    #[error("truth has no pixel between 0 and {cap} m")]
    NoTruth {
        /// Upper bound asked for, metres.
        cap: f32,
    },
}

/// Errors of one depth map, or their mean over several.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Metrics {
    /// Root of the mean squared error, millimetres.
    pub rmse_mm: f64,
    /// Mean absolute error, millimetres.
    pub mae_mm: f64,
    /// Root of the mean squared error of 1/depth, 1/km.
    pub irmse_per_km: f64,
    /// Mean absolute error over true depth, dimensionless.
    pub rel: f64,
    /// Share of pixels with `max(p/g, g/p) < 1.25`, percent.
    pub delta1_pct: f64,
    /// Pixels with truth that went in.
    pub pixels: u64,
}

/// Whether truth exists at this pixel under the cap.
pub(crate) fn has_truth(truth_m: f32, cap: f32) -> bool {
    truth_m > 0.0 && truth_m <= cap && truth_m.is_finite()
}

/// Errors unless `d_min` and `cap` (metres, `cap` may be infinite) form a range above zero.
pub(crate) fn check_range(d_min: f32, cap: f32) -> Result<(), MetricsError> {
    if d_min > 0.0 && d_min.is_finite() && d_min <= cap {
        Ok(())
    } else {
        Err(MetricsError::Range { d_min, cap })
    }
}

/// Compares a dense prediction with the truth, both in metres.
///
/// Pixels count where `0 < gt <= cap`; the prediction is clamped to `d_min..=cap` first. Reports
/// use 0.1 m and 80 m (10 m indoors); `f32::INFINITY` means no cap.
pub fn metrics(pred: &[f32], gt: &[f32], d_min: f32, cap: f32) -> Result<Metrics, MetricsError> {
    check_len("pred", pred.len(), gt.len())?;
    check_range(d_min, cap)?;
    let (mut square, mut absolute, mut inverse_square, mut relative) = (0.0, 0.0, 0.0, 0.0);
    let (mut right, mut pixels) = (0_u64, 0_u64);
    for (index, (&p, &g)) in pred.iter().zip(gt).enumerate() {
        if !has_truth(g, cap) {
            continue;
        }
        if p.is_nan() {
            return Err(MetricsError::NotANumber { index });
        }
        let (p, g) = (f64::from(p.clamp(d_min, cap)), f64::from(g));
        let error = p - g;
        let inverse_error = 1000.0 / p - 1000.0 / g;
        square += error * error;
        absolute += error.abs();
        inverse_square += inverse_error * inverse_error;
        relative += error.abs() / g;
        right += u64::from((p / g).max(g / p) < DELTA1_RATIO);
        pixels += 1;
    }
    if pixels == 0 {
        return Err(MetricsError::NoTruth { cap });
    }
    let count = pixels as f64;
    Ok(Metrics {
        rmse_mm: 1000.0 * (square / count).sqrt(),
        mae_mm: 1000.0 * absolute / count,
        irmse_per_km: (inverse_square / count).sqrt(),
        rel: relative / count,
        delta1_pct: 100.0 * right as f64 / count,
        pixels,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two pixels worked by hand: 2 m seen as 3 m, 4 m seen as 4 m; two more without truth.
    #[test]
    fn two_pixels_by_hand() {
        let found = metrics(&[3.0, 4.0, 9.0, 9.0], &[2.0, 4.0, 0.0, 81.0], 0.1, 80.0)
            .expect("two pixels have truth");
        assert_eq!(found.pixels, 2);
        assert!((found.rmse_mm - 1000.0 * 0.5_f64.sqrt()).abs() < 1e-9); // sqrt((1 + 0) / 2) m
        assert!((found.mae_mm - 500.0).abs() < 1e-9);
        // 1/3 - 1/2 = -1/6 per m = 166.67 per km; sqrt(166.67^2 / 2)
        assert!((found.irmse_per_km - 1000.0 / 6.0 / 2.0_f64.sqrt()).abs() < 1e-9);
        assert!((found.rel - 0.25).abs() < 1e-12);
        assert!((found.delta1_pct - 50.0).abs() < 1e-12);
    }

    #[test]
    fn predictions_are_clamped_to_both_ends() {
        let found = metrics(&[0.0, 500.0], &[0.5, 50.0], 0.1, 80.0).expect("both count");
        assert!((found.mae_mm - 1000.0 * (0.4 + 30.0) / 2.0).abs() < 1e-3);
        // 1/0.1 - 1/0.5 = 8 per m, 1/80 - 1/50 = -0.0075 per m
        let expected = 1000.0 * ((64.0 + 0.0075_f64 * 0.0075) / 2.0).sqrt();
        assert!(
            (found.irmse_per_km - expected).abs() < 1e-2,
            "{}",
            found.irmse_per_km
        );
        let infinite = metrics(&[f32::INFINITY], &[50.0], 0.1, 80.0).expect("clamped to the cap");
        assert!((infinite.mae_mm - 30_000.0).abs() < 1e-9);
    }

    #[test]
    fn the_ratio_is_strict_and_symmetric() {
        let at = |p: f32, g: f32| metrics(&[p], &[g], 0.1, 80.0).expect("truth").delta1_pct;
        assert_eq!(at(5.0, 4.0), 0.0); // exactly 1.25
        assert_eq!(at(4.0, 5.0), 0.0);
        assert_eq!(at(4.99, 4.0), 100.0);
        assert_eq!(at(4.01, 5.0), 100.0);
    }

    #[test]
    fn what_cannot_be_measured_is_an_error_with_its_values() {
        let text =
            |result: Result<Metrics, MetricsError>| result.expect_err("an error").to_string();
        assert_eq!(
            text(metrics(&[1.0], &[], 0.1, 80.0)),
            "pred holds 1 values, needs 0"
        );
        assert_eq!(
            text(metrics(&[1.0], &[0.0], 0.1, 80.0)),
            "truth has no pixel between 0 and 80 m"
        );
        assert_eq!(
            text(metrics(&[1.0, f32::NAN], &[1.0, 1.0], 0.1, 80.0)),
            "predicted depth is not a number at pixel 1"
        );
        assert_eq!(
            text(metrics(&[1.0], &[1.0], 2.0, 1.0)),
            "predictions cannot be clamped to 2 m ..= 1 m"
        );
        assert!(metrics(&[1.0], &[1.0], f32::NAN, 1.0).is_err());
        assert!(metrics(&[1.0], &[1.0], 0.1, f32::NAN).is_err());
        assert!(
            metrics(&[f32::NAN], &[0.0], 0.1, 80.0).is_err(),
            "no truth there"
        );
    }
}

//! Whether a sequence of depth maps flickers: change along the true flow, less the truth's own.

use crate::metrics::{MetricsError, check_range, has_truth};
use crate::size::{Size, SizeError};

/// One step's depth map beside its truth, both in metres.
#[derive(Debug, Clone, Copy)]
pub struct Step<'a> {
    /// Predicted depth.
    pub pred: &'a [f32],
    /// True depth, 0 where unknown.
    pub gt: &'a [f32],
}

/// True motion of each pixel of a step until the next, in pixels.
#[derive(Debug, Clone, Copy)]
pub struct Flow<'a> {
    /// To the right.
    pub dx: &'a [f32],
    /// Downwards.
    pub dy: &'a [f32],
}

/// What [`temporal_change`] found, over the pixels whose truth is known at both ends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TemporalChange {
    /// Mean `|D_k+1(p + flow) - D_k(p)|` of the prediction, millimetres.
    pub pred_mm: f64,
    /// The same of the truth: real motion in depth and occlusion, millimetres.
    pub truth_mm: f64,
    /// Pixels that went in.
    pub pixels: u64,
}

impl TemporalChange {
    /// Change beyond the truth's own, millimetres; below zero for maps smoother than the truth.
    pub fn excess_mm(self) -> f64 {
        self.pred_mm - self.truth_mm
    }
}

/// Compares each pixel of step `now` with where the true flow takes it in step `next`.
///
/// The next step is sampled bilinearly. A pixel counts where the truth lies in `0..=cap` at its
/// start and at all sampled pixels, and the flow is finite and stays inside the map; predictions
/// are clamped to `d_min..=cap`. `None` when no pixel counts.
pub fn temporal_change(
    now: Step<'_>,
    next: Step<'_>,
    flow: Flow<'_>,
    size: Size,
    d_min: f32,
    cap: f32,
) -> Result<Option<TemporalChange>, MetricsError> {
    check_slices(now, next, flow, size)?;
    check_range(d_min, cap)?;
    let (mut pred_sum, mut truth_sum, mut pixels) = (0.0, 0.0, 0_u64);
    for y in 0..size.height() {
        for x in 0..size.width() {
            let index = y * size.width() + x;
            if !has_truth(now.gt[index], cap) {
                continue;
            }
            let end = (x as f32 + flow.dx[index], y as f32 + flow.dy[index]);
            let Some(tap) = Tap::at(end, size) else {
                continue;
            };
            if tap
                .weighted()
                .any(|(index, _)| !has_truth(next.gt[index], cap))
            {
                continue;
            }
            let start = clamp(now.pred, index, d_min, cap)?;
            let mut end = 0.0;
            for (index, weight) in tap.weighted() {
                end += weight * clamp(next.pred, index, d_min, cap)?;
            }
            let truth_end: f64 = tap
                .weighted()
                .map(|(index, weight)| weight * f64::from(next.gt[index]))
                .sum();
            pred_sum += (end - start).abs();
            truth_sum += (truth_end - f64::from(now.gt[index])).abs();
            pixels += 1;
        }
    }
    let mean_mm = |sum: f64| 1000.0 * sum / pixels as f64;
    Ok((pixels > 0).then(|| TemporalChange {
        pred_mm: mean_mm(pred_sum),
        truth_mm: mean_mm(truth_sum),
        pixels,
    }))
}

fn check_slices(
    now: Step<'_>,
    next: Step<'_>,
    flow: Flow<'_>,
    size: Size,
) -> Result<(), SizeError> {
    size.check("now.pred", now.pred.len())?;
    size.check("now.gt", now.gt.len())?;
    size.check("next.pred", next.pred.len())?;
    size.check("next.gt", next.gt.len())?;
    size.check("flow.dx", flow.dx.len())?;
    size.check("flow.dy", flow.dy.len())
}

fn clamp(pred: &[f32], index: usize, d_min: f32, cap: f32) -> Result<f64, MetricsError> {
    if pred[index].is_nan() {
        return Err(MetricsError::NotANumber { index });
    }
    Ok(f64::from(pred[index].clamp(d_min, cap)))
}

/// The pixels around a point and their bilinear weights.
struct Tap {
    index: usize,
    width: usize,
    fraction: (f64, f64),
}

impl Tap {
    /// `None` outside the map or where the point is not a number.
    fn at((x, y): (f32, f32), size: Size) -> Option<Self> {
        let inside = |value: f32, side: usize| value >= 0.0 && value <= (side - 1) as f32;
        if !inside(x, size.width()) || !inside(y, size.height()) {
            return None;
        }
        Some(Self {
            index: y as usize * size.width() + x as usize,
            width: size.width(),
            fraction: (f64::from(x.fract()), f64::from(y.fract())),
        })
    }

    /// Index and weight of each pixel that has one; on whole coordinates that is a single pixel.
    fn weighted(&self) -> impl Iterator<Item = (usize, f64)> {
        let (fx, fy) = self.fraction;
        [
            (self.index, (1.0 - fx) * (1.0 - fy)),
            (self.index + 1, fx * (1.0 - fy)),
            (self.index + self.width, (1.0 - fx) * fy),
            (self.index + self.width + 1, fx * fy),
        ]
        .into_iter()
        .filter(|&(_, weight)| weight > 0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn size() -> Size {
        Size::new(3, 2).expect("a size")
    }

    /// Everything moves one pixel right; the prediction flickers by 1 m on top of a true 0.5 m.
    #[test]
    fn motion_of_the_truth_is_not_held_against_the_prediction() {
        let (gt_now, gt_next) = (
            [2.0, 3.0, 4.0, 2.0, 3.0, 4.0],
            [9.0, 2.5, 3.5, 9.0, 2.5, 3.5],
        );
        let flickering = gt_next.map(|depth| depth + 1.0);
        let (dx, dy) = ([1.0; 6], [0.0; 6]);
        let change = |next_pred: &[f32]| {
            temporal_change(
                Step {
                    pred: &gt_now,
                    gt: &gt_now,
                },
                Step {
                    pred: next_pred,
                    gt: &gt_next,
                },
                Flow { dx: &dx, dy: &dy },
                size(),
                0.1,
                80.0,
            )
            .expect("sizes agree")
            .expect("four pixels stay inside")
        };
        let steady = change(&gt_next);
        assert_eq!(
            (steady.pixels, steady.truth_mm, steady.excess_mm()),
            (4, 500.0, 0.0)
        );
        assert_eq!(change(&flickering).excess_mm(), 1000.0);
    }

    #[test]
    fn half_a_pixel_is_the_mean_of_two() {
        let gt_now = [3.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let gt_next = [2.0, 4.0, 0.0, 0.0, 0.0, 0.0];
        let (dx, dy) = ([0.5; 6], [0.0; 6]);
        let found = temporal_change(
            Step {
                pred: &gt_now,
                gt: &gt_now,
            },
            Step {
                pred: &[1.0, 4.0, f32::NAN, f32::NAN, f32::NAN, f32::NAN],
                gt: &gt_next,
            },
            Flow { dx: &dx, dy: &dy },
            size(),
            0.1,
            80.0,
        );
        let expected = TemporalChange {
            pred_mm: 500.0,
            truth_mm: 0.0,
            pixels: 1,
        };
        assert_eq!(
            found,
            Ok(Some(expected)),
            "NaN without truth or weight is never read"
        );
    }

    #[test]
    fn flow_that_leaves_or_is_not_a_number_does_not_count() {
        let gt = [1.0; 6];
        for (dx, dy) in [
            (3.0, 0.0),
            (-3.0, 0.0),
            (0.0, 2.0),
            (f32::NAN, 0.0),
            (0.0, f32::INFINITY),
        ] {
            let found = temporal_change(
                Step { pred: &gt, gt: &gt },
                Step { pred: &gt, gt: &gt },
                Flow {
                    dx: &[dx; 6],
                    dy: &[dy; 6],
                },
                size(),
                0.1,
                80.0,
            );
            assert_eq!(found, Ok(None), "({dx}, {dy})");
        }
        let wrong = Flow {
            dx: &[0.0],
            dy: &[0.0; 6],
        };
        let step = Step { pred: &gt, gt: &gt };
        let error = temporal_change(step, step, wrong, size(), 0.1, 80.0).expect_err("short");
        assert_eq!(error.to_string(), "flow.dx holds 1 values, needs 6");
    }
}

//! Scores of depth sequences against exact truth, as every report of this crate takes them.

use noctule_depth::{
    Flow, MetricsError, Score, Size, SizeError, Step, edge_band, masked_mae, metrics,
    temporal_change,
};
use noctule_world::STEPS;

/// Predictions are held to this or more, metres.
pub const DEPTH_MIN_M: f32 = 0.1;
/// Truth beyond this is not scored, metres (outdoors).
pub const DEPTH_CAP_M: f32 = 80.0;

/// What a sequence of depth maps is scored against; fields `[T, H, W]`.
#[derive(Debug, Clone, Copy)]
pub struct Truth<'a> {
    /// Metres, 0 for none.
    pub depth: &'a [f32],
    /// Things that move on their own; empty where unknown.
    pub movers: &'a [bool],
    /// Things narrower than 0.3 m; empty where unknown.
    pub thin: &'a [bool],
    /// Pixels to the next step, `[T - 1, 2, H, W]`; empty where unknown.
    pub flow: &'a [f32],
    /// Farthest depth scored, metres.
    pub cap_m: f32,
}

/// Scores the eight maps of one exposure, `pred` `[T, H, W]` in metres; `None` for a step without
/// truth. The temporal part of step k compares it with step k + 1; the last step has none.
///
/// # Errors
/// [`MetricsError`], when lengths differ or a prediction is not a number.
pub fn score_sequence(
    pred: &[f32],
    truth: Truth<'_>,
    size: Size,
) -> Result<[Option<Score>; STEPS], MetricsError> {
    let mut scores = [None; STEPS];
    for (step, score) in scores.iter_mut().enumerate() {
        *score = score_step(pred, truth, size, step)?;
    }
    Ok(scores)
}

fn score_step(
    pred: &[f32],
    truth: Truth<'_>,
    size: Size,
    step: usize,
) -> Result<Option<Score>, MetricsError> {
    let area = size.pixels();
    check_steps(size, pred.len(), truth.depth.len())?;
    let at = |step: usize| Step {
        pred: &pred[step * area..][..area],
        gt: &truth.depth[step * area..][..area],
    };
    let now = at(step);
    let all = match metrics(now.pred, now.gt, DEPTH_MIN_M, truth.cap_m) {
        Ok(all) => all,
        Err(MetricsError::NoTruth { .. }) => return Ok(None),
        Err(error) => return Err(error),
    };
    let masked = |mask: &[bool]| {
        masked_mae(now.pred, now.gt, mask, DEPTH_MIN_M, truth.cap_m)
            .map(|found| found.map(|found| found.mae_mm))
    };
    let where_known = |field: &[bool]| match field.get(step * area..(step + 1) * area) {
        Some(mask) => masked(mask),
        None => Ok(None),
    };
    let mut band = vec![false; area];
    edge_band(now.gt, size, &mut band)?;
    let temporal = match truth.flow.get(2 * step * area..2 * (step + 1) * area) {
        Some(flow) if step + 1 < STEPS => {
            let (dx, dy) = flow.split_at(area);
            let flow = Flow { dx, dy };
            temporal_change(now, at(step + 1), flow, size, DEPTH_MIN_M, truth.cap_m)?
        }
        _ => None,
    };
    Ok(Some(Score {
        edge_band_mae_mm: masked(&band)?,
        mover_mae_mm: where_known(truth.movers)?,
        thin_mae_mm: where_known(truth.thin)?,
        temporal_excess_mm: temporal.map(noctule_depth::TemporalChange::excess_mm),
        ..Score::from(all)
    }))
}

/// Both fields hold eight maps of this size.
fn check_steps(size: Size, pred: usize, truth: usize) -> Result<(), SizeError> {
    let expected = STEPS * size.pixels();
    for (name, actual) in [("pred", pred), ("gt", truth)] {
        if actual != expected {
            return Err(SizeError::Length {
                name,
                actual,
                expected,
            });
        }
    }
    Ok(())
}

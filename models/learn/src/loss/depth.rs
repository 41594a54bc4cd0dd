//! Losses of completion (paper, equations 12 to 15).

use candle_core::{Result, Tensor};

use crate::settings::Loss;

/// The terms of eq. 12, each a scalar that carries gradients.
#[derive(Debug, Clone)]
pub struct DepthLoss {
    /// The weighted sum.
    pub total: Tensor,
    /// Eq. 13: everywhere with truth, metres summed over steps.
    pub dense: Tensor,
    /// Eq. 14: where a return is.
    pub sparse: Tensor,
    /// Eq. 15: slopes where a return is.
    pub sparse_gradient: Tensor,
}

/// `depth`, `truth`, `sparse` `[B, T, 1, H, W]` in metres, 0 for none in the latter two; `edges`
/// and `movers` alike, 1 near depth edges and on what moves, for the extra weights there.
///
/// # Errors
/// When shapes differ.
pub fn depth_loss(
    depth: &Tensor,
    truth: &Tensor,
    sparse: &Tensor,
    [edges, movers]: [Option<&Tensor>; 2],
    weights: &Loss,
) -> Result<DepthLoss> {
    let known = truth.gt(0f32)?.to_dtype(truth.dtype())?;
    let both = (sparse.gt(0f32)?.to_dtype(truth.dtype())? * &known)?;
    let error = (depth - truth)?.abs()?;
    let dense = masked_mean(&error, &known)?;
    let at_returns = masked_mean(&error, &both)?;
    let mut slopes = Tensor::zeros((), truth.dtype(), truth.device())?;
    for dim in [4, 3] {
        let len = truth.dim(dim)? - 1;
        let mask = (both.narrow(dim, 0, len)? * known.narrow(dim, 1, len)?)?;
        let slope = (differences(depth, dim)? - differences(truth, dim)?)?.abs()?;
        slopes = (slopes + masked_mean(&slope, &mask)?)?;
    }
    let mut total = (&dense + ((&at_returns + &slopes)? * weights.sparse)?)?;
    if weights.log_depth > 0.0 {
        // Where there is no truth both logarithms are of one metre.
        let floor = |x: &Tensor| x.maximum(1e-2f32)?.log();
        let masked = |x: &Tensor| (x * &known)? + (1.0 - &known)?;
        let ratio = (floor(&masked(depth)?)? - floor(&masked(truth)?)?)?.abs()?;
        total = (total + (masked_mean(&ratio, &known)? * weights.log_depth)?)?;
    }
    if let Some(edges) = edges.filter(|_| weights.depth_edges > 0.0) {
        let near = (edges * &known)?;
        total = (total + (masked_mean(&error, &near)? * weights.depth_edges)?)?;
    }
    if let Some(movers) = movers.filter(|_| weights.depth_movers > 0.0) {
        let on_them = masked_mean(&(&error * movers)?, &known)?;
        total = (total + (on_them * weights.depth_movers)?)?;
    }
    if let Some(movers) = movers.filter(|_| weights.mover_mean > 0.0) {
        let own = mean_by_map(&error, &(movers * &known)?)?;
        total = (total + (own * weights.mover_mean)?)?;
    }
    Ok(DepthLoss {
        total,
        dense,
        sparse: at_returns,
        sparse_gradient: slopes,
    })
}

/// Sum over steps of the mean of `error` where `mask` is one, over all exposures of the batch.
fn masked_mean(error: &Tensor, mask: &Tensor) -> Result<Tensor> {
    let by_step = |x: &Tensor| x.transpose(0, 1)?.contiguous()?.flatten_from(1)?.sum(1);
    (by_step(&(error * mask)?)? / by_step(mask)?.maximum(1f32)?)?.sum_all()
}

/// Sum over steps of the mean over exposures of each map's own mean of `error` where `mask` is one,
/// 0 where it nowhere is.
fn mean_by_map(error: &Tensor, mask: &Tensor) -> Result<Tensor> {
    let of_map = |x: &Tensor| x.flatten_from(2)?.sum(2);
    let means = (of_map(&(error * mask)?)? / of_map(mask)?.maximum(1f32)?)?;
    means.mean(0)?.sum_all()
}

/// Forward differences along one dimension.
pub(super) fn differences(x: &Tensor, dim: usize) -> Result<Tensor> {
    let len = x.dim(dim)? - 1;
    x.narrow(dim, 1, len)? - x.narrow(dim, 0, len)?
}

//! The loss of one batch, with everything that hangs on it.

use candle_core::Tensor;
use noctule_erunet::{Network, Pass};
use noctule_world::STEPS;

use super::error::TrainError;
use crate::batch::{Inputs, Pictures};
use crate::loss::{average, depth_loss, picture_loss, temporal_spread};
use crate::settings::{Kind, Loss};

/// What a batch costs.
pub struct BatchLoss {
    /// To be minimised; carries gradients.
    pub total: Tensor,
    /// Its terms by name, unweighted.
    pub terms: Vec<(&'static str, f64)>,
    /// Restoration alone: beside what its loss must be seen.
    pub beside: Option<Beside>,
    /// Restoration alone: the pictures, `[B, n, 3, H, W]`, detached.
    pub restored: Option<Tensor>,
}

/// What tells learning from collapse in stage 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Beside {
    /// Loss of returning the blurred picture at every step.
    pub blurred: f64,
    /// How much the restored pictures of an exposure differ from their mean.
    pub spread: f64,
}

/// Runs the network on a batch and compares with the truth, as `kind` does.
///
/// # Errors
/// [`TrainError`], when shapes do not fit or the batch lacks the truth that `kind` needs.
pub fn batch_loss(
    network: &Network,
    kind: Kind,
    inputs: &Inputs,
    weights: &Loss,
    pass: &mut Pass,
) -> Result<BatchLoss, TrainError> {
    let first = inputs.first_step;
    pass.stand_over(inputs.grounds.clone());
    let clear = network.restore_window(&inputs.blur, &inputs.voxel, first, pass)?;
    let power = restored_power(&clear)?;
    let priced = |total: Tensor| total + (&power * weights.restored_power)?;
    if kind == Kind::Restore {
        let pictures = inputs.pictures.as_ref().ok_or_else(no_pictures)?;
        let restored = network
            .reconstruct(&clear, &inputs.blur)?
            .ok_or_else(no_pictures)?;
        let mut found = restoration_loss(&restored, pictures, &inputs.blur, weights)?;
        found.total = priced(found.total)?;
        found.terms.push(("restored_power", scalar(&power)?));
        return Ok(found);
    }
    let voxel = inputs.voxel.narrow(1, first, clear.len())?;
    let outputs = network.complete_window(&clear, &voxel, &inputs.sparse, pass)?;
    let loss = depth_loss(
        &outputs.depth,
        &inputs.depth,
        &inputs.sparse,
        [inputs.edges.as_ref(), inputs.movers.as_ref()],
        weights,
    )?;
    let terms = [
        ("dense", &loss.dense),
        ("sparse", &loss.sparse),
        ("sparse_gradient", &loss.sparse_gradient),
        ("restored_power", &power),
    ];
    Ok(BatchLoss {
        terms: scalars(&terms)?,
        total: priced(loss.total)?,
        beside: None,
        restored: None,
    })
}

/// Mean square of restored features over steps.
fn restored_power(clear: &[Tensor]) -> candle_core::Result<Tensor> {
    let powers: Vec<Tensor> = clear
        .iter()
        .map(|clear| clear.sqr()?.mean_all())
        .collect::<candle_core::Result<_>>()?;
    Tensor::stack(&powers, 0)?.mean_all()
}

fn no_pictures() -> TrainError {
    candle_core::Error::Msg("restoration trains on sharp pictures, and there are none".into())
        .into()
}

/// Eq. 11 of `restored` `[B, n, 3, H, W]`, and of the blurred picture in its place.
fn restoration_loss(
    restored: &Tensor,
    pictures: &Pictures,
    blur: &Tensor,
    weights: &Loss,
) -> Result<BatchLoss, TrainError> {
    // Part of an exposure does not add up to the whole one's picture, but to its own.
    let summed = if restored.dim(1)? == STEPS {
        blur.clone()
    } else {
        average(&pictures.sharp, weights.reblur_domain)?
    };
    let against_truth = |restored: &Tensor| {
        let (sharp, grey) = (&pictures.sharp, &pictures.event_grey);
        picture_loss(restored, sharp, &summed, grey, weights)
    };
    let loss = against_truth(restored)?;
    let still = blur
        .unsqueeze(1)?
        .broadcast_as(restored.shape())?
        .contiguous()?;
    let terms = [
        ("charbonnier", &loss.charbonnier),
        ("ssim", &loss.ssim),
        ("edge", &loss.edge),
        ("reblur", &loss.reblur),
        ("gradient", &loss.gradient),
    ];
    Ok(BatchLoss {
        terms: scalars(&terms)?,
        beside: Some(Beside {
            blurred: scalar(&against_truth(&still)?.total)?,
            spread: temporal_spread(&restored.detach())?,
        }),
        restored: Some(restored.detach()),
        total: loss.total,
    })
}

pub(super) fn scalar(tensor: &Tensor) -> candle_core::Result<f64> {
    Ok(f64::from(tensor.to_scalar::<f32>()?))
}

fn scalars(terms: &[(&'static str, &Tensor)]) -> candle_core::Result<Vec<(&'static str, f64)>> {
    terms
        .iter()
        .map(|(name, tensor)| Ok((*name, scalar(tensor)?)))
        .collect()
}

//! Losses of restoration (paper, equations 8 to 11).

use candle_core::{D, Result, Tensor};

use super::depth::differences;
use crate::batch::{GAMMA, GREY};
use crate::settings::{Domain, Loss};

/// Side and spread of SSIM's window, pixels (Wang et al. 2004).
const WINDOW: usize = 11;
const SIGMA: f64 = 1.5;
/// Darkest value that is decoded; darker ones have no slope there.
const DARK: f32 = 1e-3;

/// The terms of eq. 11, each a scalar that carries gradients.
#[derive(Debug, Clone)]
pub struct PictureLoss {
    /// The weighted sum.
    pub total: Tensor,
    /// Charbonnier (eq. 8).
    pub charbonnier: Tensor,
    /// 1 - SSIM (eq. 8).
    pub ssim: Tensor,
    /// Laplacian edges (eq. 8).
    pub edge: Tensor,
    /// Blurred again (eq. 9).
    pub reblur: Tensor,
    /// Gradients that events imply (eq. 10).
    pub gradient: Tensor,
}

/// `restored` and `sharp` `[B, T, 3, H, W]`, `blur` `[B, 3, H, W]` (the average of what the T
/// pictures show), `event_grey` `[B, T, 1, H, W]`; sides of 11 pixels or more.
///
/// # Errors
/// When shapes do not fit.
pub fn picture_loss(
    restored: &Tensor,
    sharp: &Tensor,
    blur: &Tensor,
    event_grey: &Tensor,
    weights: &Loss,
) -> Result<PictureLoss> {
    let fold = |x: &Tensor| x.flatten(0, 2); // [B*T*3, H, W]
    let (ours, theirs) = (fold(restored)?, fold(sharp)?);
    let charbonnier_loss = charbonnier(restored, sharp, weights.charbonnier_guard)?;
    let ssim_loss = (1.0 - ssim(&ours, &theirs)?)?;
    let guard = weights.charbonnier_guard;
    let edge = charbonnier(&laplacian(&ours)?, &laplacian(&theirs)?, guard)?;
    let reblur = (average(restored, weights.reblur_domain)? - blur)?
        .abs()?
        .mean_all()?;
    let grey = grey(restored)?;
    let mut gradient = Tensor::zeros((), grey.dtype(), grey.device())?;
    for dim in [4, 3] {
        let error = (differences(&grey, dim)? - differences(event_grey, dim)?)?.abs()?;
        gradient = (gradient + error.mean_all()?)?;
    }
    let gradient = (gradient * restored.dim(1)? as f64)?; // a sum over steps
    let total = [
        (&charbonnier_loss, weights.charbonnier),
        (&ssim_loss, weights.ssim),
        (&edge, weights.edge),
        (&reblur, weights.reblur),
        (&gradient, weights.gradient),
    ]
    .into_iter()
    .try_fold(None::<Tensor>, |sum, (term, weight)| {
        let term = (term * weight)?;
        Ok::<_, candle_core::Error>(Some(match sum {
            Some(sum) => (sum + term)?,
            None => term,
        }))
    })?
    .expect("five terms");
    Ok(PictureLoss {
        total,
        charbonnier: charbonnier_loss,
        ssim: ssim_loss,
        edge,
        reblur,
        gradient,
    })
}

/// The long exposure that T pictures `[B, T, 3, H, W]` add up to, `[B, 3, H, W]`.
pub(crate) fn average(pictures: &Tensor, domain: Domain) -> Result<Tensor> {
    match domain {
        Domain::Encoded => pictures.mean(1),
        Domain::Linear => pictures
            .maximum(DARK)?
            .powf(f64::from(GAMMA))?
            .mean(1)?
            .powf(f64::from(1.0 / GAMMA)),
    }
}

/// How much the pictures of an exposure differ from one another: mean `|I_t - mean_t I|`. A
/// collapsed restoration has none.
pub(crate) fn temporal_spread(pictures: &Tensor) -> Result<f64> {
    let mean = pictures.mean_keepdim(1)?;
    let spread = pictures.broadcast_sub(&mean)?.abs()?.mean_all()?;
    Ok(f64::from(spread.to_scalar::<f32>()?))
}

fn charbonnier(a: &Tensor, b: &Tensor, guard: f64) -> Result<Tensor> {
    ((a - b)?.sqr()? + guard * guard)?.sqrt()?.mean_all()
}

/// Grey, `[B, T, 1, H, W]`.
fn grey(pictures: &Tensor) -> Result<Tensor> {
    let weights = Tensor::from_slice(&GREY, (1, 1, 3, 1, 1), pictures.device())?;
    pictures.broadcast_mul(&weights)?.sum_keepdim(2)
}

/// Four-neighbour Laplacian of `[N, H, W]` with its border repeated.
fn laplacian(x: &Tensor) -> Result<Tensor> {
    let (_, height, width) = x.dims3()?;
    let padded = x.pad_with_same(1, 1, 1)?.pad_with_same(2, 1, 1)?;
    let shifted = |dy: usize, dx: usize| padded.narrow(1, dy, height)?.narrow(2, dx, width);
    let around = (((shifted(0, 1)? + shifted(2, 1)?)? + shifted(1, 0)?)? + shifted(1, 2)?)?;
    around - (x * 4.0)?
}

/// Mean structural similarity of `[N, H, W]` with values up to 1, over whole windows.
fn ssim(a: &Tensor, b: &Tensor) -> Result<Tensor> {
    let (_, height, width) = a.dims3()?;
    let (rows, columns) = (band(height, a)?, band(width, a)?);
    // Weighted means over windows, [N, W - 10, H - 10]: two products with banded matrices.
    let smooth = |x: &Tensor| -> Result<Tensor> {
        let (n, h, w) = x.dims3()?;
        let x = x.reshape((n * h, w))?.matmul(&columns)?;
        let x = x.reshape((n, h, ()))?.transpose(1, 2)?.contiguous()?;
        let narrow = x.dim(D::Minus2)?;
        x.reshape((n * narrow, h))?
            .matmul(&rows)?
            .reshape((n, narrow, ()))
    };
    let (ma, mb) = (smooth(a)?, smooth(b)?);
    let (ma_sq, mb_sq, m_ab) = (ma.sqr()?, mb.sqr()?, (&ma * &mb)?);
    let variances = ((smooth(&(a.sqr()? + b.sqr()?)?)? - &ma_sq)? - &mb_sq)?;
    let covariance = (smooth(&(a * b)?)? - &m_ab)?;
    let above = (((m_ab * 2.0)? + 1e-4)? * ((covariance * 2.0)? + 9e-4)?)?;
    let below = (((ma_sq + mb_sq)? + 1e-4)? * (variances + 9e-4)?)?;
    (above / below)?.mean_all()
}

/// A matrix `[side, side - 10]` whose columns hold SSIM's Gaussian, each one row further down.
fn band(side: usize, like: &Tensor) -> Result<Tensor> {
    let Some(outputs) = (side + 1).checked_sub(WINDOW).filter(|n| *n > 0) else {
        candle_core::bail!("picture side is {side}, ssim needs {WINDOW} or more");
    };
    let weight = |i: usize| {
        let x = i as f64 - (WINDOW / 2) as f64;
        (-x * x / (2.0 * SIGMA * SIGMA)).exp()
    };
    let total: f64 = (0..WINDOW).map(weight).sum();
    let mut values = vec![0f32; side * outputs];
    for column in 0..outputs {
        for i in 0..WINDOW {
            values[(column + i) * outputs + column] = (weight(i) / total) as f32;
        }
    }
    Tensor::from_vec(values, (side, outputs), like.device())
}

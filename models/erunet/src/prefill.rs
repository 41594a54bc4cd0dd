//! What the residual form starts from: the nearest return of every pixel, and how far to trust it.
//!
//! The network then says by which factor the nearest return's depth is wrong, so that with nothing
//! learned it equals nearest-neighbour completion.

use candle_core::{Device, Result, Tensor};
use noctule_depth::Completer;
use rayon::prelude::*;

/// Depth assumed everywhere where an exposure has not a single return, as a share of the range.
pub const FALLBACK_SHARE: f32 = 0.125;

/// Largest factor, as a natural logarithm, between the nearest return's depth and the network's:
/// depth = nearest * exp(LOG_SPAN * tanh(z / LOG_SPAN)), up to 20 times nearer or farther.
pub const LOG_SPAN: f32 = 3.0;

/// Completes maps of one size; allocates once.
pub(crate) struct Prefill {
    completer: Completer,
    range_m: f32,
}

impl Prefill {
    pub(crate) fn new(height: usize, width: usize, range_m: f32) -> Result<Self> {
        let completer = Completer::new(width, height).map_err(candle_core::Error::wrap)?;
        Ok(Self { completer, range_m })
    }

    /// From `sparse` `[H, W]` in metres, 0 for no return: `nearest` `[H, W]` in metres, and `seen`
    /// `[3, H, W]`: the nearest over the range, 1 at a return, `exp(-distance / 8 px)`.
    pub(crate) fn fill(
        &mut self,
        sparse: &[f32],
        nearest: &mut [f32],
        seen: &mut [f32],
    ) -> Result<()> {
        let area = nearest.len();
        if seen.len() != 3 * area {
            candle_core::bail!("{} values for three planes of {area}", seen.len());
        }
        let (share, rest) = seen.split_at_mut(area);
        let (returned, trust) = rest.split_at_mut(area);
        let any = self
            .completer
            .nearest_with_confidence(sparse, nearest, trust)
            .map_err(candle_core::Error::wrap)?;
        if !any {
            nearest.fill(self.range_m * FALLBACK_SHARE);
        }
        for (mask, trust) in returned.iter_mut().zip(&*trust) {
            // Confidence is exactly one at a return and nowhere else.
            *mask = f32::from(u8::from(*trust == 1.0));
        }
        for (share, nearest) in share.iter_mut().zip(&*nearest) {
            *share = nearest / self.range_m;
        }
        Ok(())
    }
}

/// What the depth encoder sees of a batch, `[N, 3, H, W]`, and the nearest returns `[N, 1, H, W]`
/// in metres, on `device`, from `sparse` `[N, 1, H, W]` on any. Computed on the processor; no
/// gradient passes.
pub(crate) fn prefill(sparse: &Tensor, range_m: f32, device: &Device) -> Result<(Tensor, Tensor)> {
    let (n, _, h, w) = sparse.dims4()?;
    let area = h * w;
    let values: Vec<f32> = sparse.flatten_all()?.to_vec1()?;
    let mut nearest = vec![0.0; n * area];
    let mut seen = vec![0.0; 3 * n * area];
    let maps = values.par_chunks(area).zip(nearest.par_chunks_mut(area));
    maps.zip(seen.par_chunks_mut(3 * area)).try_for_each_init(
        || Prefill::new(h, w, range_m),
        |prefill, ((sparse, nearest), seen)| match prefill {
            Ok(prefill) => prefill.fill(sparse, nearest, seen),
            Err(error) => candle_core::bail!("{error}"),
        },
    )?;
    Ok((
        Tensor::from_vec(seen, (n, 3, h, w), device)?,
        Tensor::from_vec(nearest, (n, 1, h, w), device)?,
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn returns_are_kept_marked_and_trusted() {
        let mut sparse = vec![0.0_f32; 12];
        (sparse[0], sparse[11]) = (10.0, 40.0);
        let sparse = Tensor::from_vec(sparse, (1, 1, 3, 4), &Device::Cpu).unwrap();
        let (seen, nearest) = prefill(&sparse, 80.0, &Device::Cpu).unwrap();
        let nearest: Vec<f32> = nearest.flatten_all().unwrap().to_vec1().unwrap();
        assert_eq!(
            nearest,
            [10., 10., 10., 40., 10., 10., 40., 40., 10., 40., 40., 40.]
        );
        let seen: Vec<f32> = seen.flatten_all().unwrap().to_vec1().unwrap();
        assert_eq!((seen[0], seen[11]), (0.125, 0.5));
        let marked: Vec<usize> = (0..12).filter(|i| seen[12 + i] == 1.0).collect();
        assert_eq!(marked, [0, 11]);
        assert_eq!(seen[24], 1.0);
        assert_eq!(seen[25], (-0.125_f32).exp());
    }

    #[test]
    fn without_a_return_a_middling_depth_with_no_trust_stands_in() {
        let sparse = Tensor::zeros((2, 1, 2, 2), candle_core::DType::F32, &Device::Cpu).unwrap();
        let (seen, nearest) = prefill(&sparse, 80.0, &Device::Cpu).unwrap();
        let nearest: Vec<f32> = nearest.flatten_all().unwrap().to_vec1().unwrap();
        assert_eq!(nearest, [10.0; 8]);
        let seen: Vec<f32> = seen.flatten_all().unwrap().to_vec1().unwrap();
        let of_one = [0.125, 0.125, 0.125, 0.125, 0., 0., 0., 0., 0., 0., 0., 0.];
        assert_eq!(seen, [of_one, of_one].concat());
    }
}

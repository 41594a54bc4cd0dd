//! Temporal encoder: how the scene moves within one step, cell by cell.

use std::f32::consts::PI;

use candle_core::{DType, Device, Result, Tensor};
use noctule_kernels::Activation;

use crate::blocks::ResEs;
use crate::config::Config;
use crate::conv::{Conv, ConvShape};
use crate::params::Params;

/// Phi_temporal: an event stem at a quarter of the size, then a coordinate network.
pub(super) struct Temporal {
    conv1: Conv,
    conv2: Conv,
    rb: ResEs,
    mlp1: Conv,
    mlp2: Conv,
    mlp3: Conv,
    steps: usize,
    freqs: usize,
}

impl Temporal {
    pub(super) fn new(params: &Params<'_>, config: &Config) -> Result<Self> {
        let [k1, k2] = config.k;
        let (cd, freqs) = (config.cd, config.freqs);
        let conv = |name, shape| Conv::new(&params.at(name), shape);
        Ok(Self {
            conv1: conv("conv1", ConvShape::k3(config.bins, k1).halving())?,
            conv2: conv("conv2", ConvShape::k3(k1, k2).halving())?,
            rb: ResEs::new(&params.at("rb"), k2, config.n_t)?,
            mlp1: conv("mlp1", ConvShape::k1(k2 + 6 * freqs, cd))?,
            mlp2: conv("mlp2", ConvShape::k1(cd, cd))?,
            mlp3: conv("mlp3", ConvShape::k1(cd, cd))?,
            steps: config.steps,
            freqs,
        })
    }

    /// `voxel` `[B, bins, H, W]` of step `t` (from 0); returns `F_dyn,t` `[B, cd, H/4, W/4]`.
    pub(super) fn forward(&self, voxel: &Tensor, t: usize) -> Result<Tensor> {
        let leaky = Activation::LeakyRelu;
        let x = self.conv1.activated(voxel, leaky)?; // [B, k1, H/2, W/2]
        let x = self.rb.forward(self.conv2.activated(&x, leaky)?)?; // [B, k2, H/4, W/4]
        let (b, _, h, w) = x.dims4()?;
        let place = coordinates(h, w, centre(t, self.steps), self.freqs, x.device())?;
        let place = place
            .broadcast_as((b, 6 * self.freqs, h, w))?
            .contiguous()?;
        let joined = [&x, &place.to_dtype(x.dtype())?];
        let x = self.mlp1.apply(&joined, None, leaky)?;
        let x = self.mlp2.activated(&x, leaky)?;
        self.mlp3.forward(&x)
    }
}

/// Centre of cell `index` of `count` equal cells over -1 to 1.
#[allow(
    clippy::cast_precision_loss,
    reason = "image sides and step counts are small"
)]
pub(crate) fn centre(index: usize, count: usize) -> f32 {
    (index as f32 + 0.5) / count as f32 * 2.0 - 1.0
}

/// Fourier encoding of place and time, `[1, 6 freqs, h, w]`: for x, y, t in turn and each
/// frequency f, the sine and then the cosine of `2^f pi u`, with `u` in -1 to 1.
pub(crate) fn coordinates(
    h: usize,
    w: usize,
    tau: f32,
    freqs: usize,
    device: &Device,
) -> Result<Tensor> {
    let columns: Vec<f32> = (0..w).map(|i| centre(i, w)).collect();
    let rows: Vec<f32> = (0..h).map(|i| centre(i, h)).collect();
    let mut planes = Vec::with_capacity(6 * freqs * h * w);
    for axis in 0..3 {
        for frequency in 0..freqs {
            let factor = (0..frequency).fold(PI, |factor, _| factor * 2.0);
            for wave in [f32::sin, f32::cos] {
                match axis {
                    0 => {
                        let row: Vec<f32> = columns.iter().map(|u| wave(factor * u)).collect();
                        (0..h).for_each(|_| planes.extend_from_slice(&row));
                    }
                    1 => {
                        for u in &rows {
                            planes.resize(planes.len() + w, wave(factor * u));
                        }
                    }
                    _ => planes.resize(planes.len() + h * w, wave(factor * tau)),
                }
            }
        }
    }
    Tensor::from_vec(planes, (1, 6 * freqs, h, w), device)?.to_dtype(DType::F32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coordinates_put_sine_before_cosine_and_x_before_y_before_t() {
        let planes = coordinates(2, 4, centre(1, 8), 4, &Device::Cpu).unwrap();
        let planes: Vec<Vec<f32>> = planes.reshape((24, 8)).unwrap().to_vec2().unwrap();
        let close = |a: f32, b: f64| assert!((f64::from(a) - b).abs() < 1e-5, "{a} {b}");
        let pi = std::f64::consts::PI;
        close(planes[0][4 + 3], (pi * 0.75).sin()); // x of column 3, either row
        close(planes[3][1], (2.0 * pi * -0.25).cos());
        close(planes[8][2], (pi * -0.5).sin()); // y of row 0
        close(planes[15][7], (8.0 * pi * 0.5).cos());
        close(planes[20][5], (4.0 * pi * -0.625).sin()); // t of step 1 of 8
    }
}

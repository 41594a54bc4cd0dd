//! Reconstruction head: the sharp picture a restored feature stands for, needed by stage 1 alone.

use candle_core::{Result, Tensor};
use noctule_kernels::Activation;

use crate::config::Config;
use crate::conv::{Conv, ConvShape};
use crate::params::Params;

/// The blurred picture plus a correction, which starts as nothing: a random head settles on
/// handing the blurred picture back.
pub(super) struct Recon {
    conv1: Conv,
    conv2: Conv,
}

impl Recon {
    pub(super) fn new(params: &Params<'_>, config: &Config) -> Result<Self> {
        let c0 = config.c[0];
        Ok(Self {
            conv1: Conv::new(&params.at("conv1"), ConvShape::k3(c0, c0))?,
            conv2: Conv::new(&params.at("conv2"), ConvShape::k3(c0, 3).gain(0.0))?,
        })
    }

    /// `clear` `[B, c0, H, W]`, `blur` `[B, 3, H, W]`; returns `I_recon` `[B, 3, H, W]`.
    pub(super) fn forward(&self, clear: &Tensor, blur: &Tensor) -> Result<Tensor> {
        let h = self.conv1.activated(clear, Activation::LeakyRelu)?;
        self.conv2.apply(&[&h], Some(blur), Activation::None)
    }
}

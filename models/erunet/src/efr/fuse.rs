//! Recursion: the feature restored at the last step corrects the still one (paper, eq. 4).

use candle_core::{Result, Tensor};
use noctule_kernels::Activation;

use crate::config::Config;
use crate::conv::{Conv, ConvShape};
use crate::params::Params;

/// `F_static` plus a correction from it and the previous `F_clear`.
pub(super) struct Fuse {
    conv1: Conv,
    conv2: Conv,
}

impl Fuse {
    pub(super) fn new(params: &Params<'_>, config: &Config) -> Result<Self> {
        let c0 = config.c[0];
        Ok(Self {
            conv1: Conv::new(&params.at("conv1"), ConvShape::k3(2 * c0, c0))?,
            conv2: Conv::new(&params.at("conv2"), ConvShape::k3(c0, c0).gain(0.1))?,
        })
    }

    /// Both inputs and the result `[B, c0, H, W]`.
    pub(super) fn forward(&self, still: &Tensor, previous: &Tensor) -> Result<Tensor> {
        let joined = [still, previous];
        let h = self.conv1.apply(&joined, None, Activation::LeakyRelu)?;
        self.conv2.apply(&[&h], Some(still), Activation::None)
    }
}

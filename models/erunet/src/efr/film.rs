//! Conditional fusion: motion scales and shifts appearance, cell by cell (paper, eq. 2).

use candle_core::{Result, Tensor};
use noctule_kernels::Activation;

use crate::config::Config;
use crate::conv::{Conv, ConvShape};
use crate::params::Params;

/// Predicts the scale and the shift that [`super::Efr::step`] applies.
pub(super) struct Film {
    trunk: Conv,
    gamma: Conv,
    beta: Conv,
}

impl Film {
    pub(super) fn new(params: &Params<'_>, config: &Config) -> Result<Self> {
        let (cd, c2) = (config.cd, config.c[2]);
        let branch = ConvShape::k1(cd, c2).gain(0.1);
        Ok(Self {
            trunk: Conv::new(&params.at("trunk"), ConvShape::k3(cd, cd))?,
            gamma: Conv::new(&params.at("gamma"), branch.bias_from(1.0))?,
            beta: Conv::new(&params.at("beta"), branch)?,
        })
    }

    /// `motion` `[B, cd, H/4, W/4]`; returns gamma and beta, each `[B, c2, H/4, W/4]`.
    pub(super) fn forward(&self, motion: &Tensor) -> Result<(Tensor, Tensor)> {
        let h = self.trunk.activated(motion, Activation::LeakyRelu)?;
        Ok((self.gamma.forward(&h)?, self.beta.forward(&h)?))
    }
}

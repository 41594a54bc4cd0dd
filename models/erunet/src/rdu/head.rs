//! Depth head: the last depth feature to a share of the range, or to a factor on the nearest return.

use candle_core::{Result, Tensor};

use crate::blocks::{relu, sigmoid};
use crate::config::Config;
use crate::conv::{Conv, ConvShape};
use crate::params::Params;
use crate::prefill::LOG_SPAN;

/// Two convolutions and a bounded function, so that no depth is ever negative or infinite.
pub(super) struct Head {
    head1: Conv,
    head2: Conv,
}

impl Head {
    /// The names stand directly under `rdu.`.
    pub(super) fn new(params: &Params<'_>, config: &Config) -> Result<Self> {
        let d0 = config.d[0];
        Ok(Self {
            head1: Conv::new(&params.at("head1"), ConvShape::k3(d0, d0))?,
            head2: Conv::new(&params.at("head2"), ConvShape::k3(d0, 1).gain(0.1))?,
        })
    }

    /// `x` `[N, d0, H, W]`; returns the share of the depth range, `[N, 1, H, W]`, 0 to 1.
    pub(super) fn share(&self, x: &Tensor) -> Result<Tensor> {
        sigmoid(&self.logit(x)?)
    }

    /// `x` `[N, d0, H, W]`; returns a factor, `[N, 1, H, W]`, between e^-3 and e^3.
    pub(super) fn factor(&self, x: &Tensor) -> Result<Tensor> {
        let span = f64::from(LOG_SPAN);
        ((self.logit(x)? / span)?.tanh()? * span)?.exp()
    }

    fn logit(&self, x: &Tensor) -> Result<Tensor> {
        self.head2.forward(&relu(&self.head1.forward(x)?)?)
    }
}

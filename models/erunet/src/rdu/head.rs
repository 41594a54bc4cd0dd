//! Depth head: the last depth feature to a share of the range, or to a factor on the nearest return.

use candle_core::{Result, Tensor};

use crate::activate::{relu, sigmoid};
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
        let (d0, outputs) = (config.d[0], config.form.head_channels());
        Ok(Self {
            head1: Conv::new(&params.at("head1"), ConvShape::k3(d0, d0))?,
            head2: Conv::new(&params.at("head2"), ConvShape::k3(d0, outputs).gain(0.1))?,
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

    /// `x` `[N, d0, H, W]`, `drop` and `rise` `[N, 1, H, W]`, logarithms of at least 0; returns a
    /// factor, `[N, 1, H, W]`: between `exp(-drop)` and `exp(rise)` by the second channel, times
    /// one between e^-3 and e^3 by the first.
    pub(super) fn choice(&self, x: &Tensor, drop: &Tensor, rise: &Tensor) -> Result<Tensor> {
        let span = f64::from(LOG_SPAN);
        let logits = self.logit(x)?;
        let free = ((logits.narrow(1, 0, 1)? / span)?.tanh()? * span)?;
        let pick = (logits.narrow(1, 1, 1)? / 2.0)?.tanh()?;
        let moved = ((pick.relu()? * rise)? - (pick.neg()?.relu()? * drop)?)?;
        (free + moved)?.exp()
    }

    fn logit(&self, x: &Tensor) -> Result<Tensor> {
        self.head2.forward(&relu(&self.head1.forward(x)?)?)
    }
}

//! Spatial encoder: what the blurred picture shows, before any motion is known.

use candle_core::{Result, Tensor};
use noctule_kernels::Activation;

use crate::blocks::{ResEs, add_nearest_2x};
use crate::config::Config;
use crate::conv::{Conv, ConvShape};
use crate::params::Params;

/// Phi_spatial: three levels down, merged back up to full size.
pub(super) struct Spatial {
    stem: Conv,
    rb0: ResEs,
    down1: Conv,
    rb1: ResEs,
    down2: Conv,
    rb2: ResEs,
    lat2: Conv,
    lat1: Conv,
    out: Conv,
}

impl Spatial {
    pub(super) fn new(params: &Params<'_>, config: &Config) -> Result<Self> {
        let [c0, c1, c2] = config.c;
        let conv = |name, shape| Conv::new(&params.at(name), shape);
        let blocks = |name, width, count| ResEs::new(&params.at(name), width, count);
        Ok(Self {
            stem: conv("stem", ConvShape::k3(3, c0))?,
            rb0: blocks("rb0", c0, config.n_sp[0])?,
            down1: conv("down1", ConvShape::k3(c0, c1).halving())?,
            rb1: blocks("rb1", c1, config.n_sp[1])?,
            down2: conv("down2", ConvShape::k3(c1, c2).halving())?,
            rb2: blocks("rb2", c2, config.n_sp[2])?,
            lat2: conv("lat2", ConvShape::k1(c2, c1))?,
            lat1: conv("lat1", ConvShape::k1(c1, c0))?,
            out: conv("out", ConvShape::k3(c0, c0))?,
        })
    }

    /// `blur` `[B, 3, H, W]`; returns `F_static` `[B, c0, H, W]`.
    pub(super) fn forward(&self, blur: &Tensor) -> Result<Tensor> {
        let leaky = Activation::LeakyRelu;
        let p0 = self.rb0.forward(self.stem.activated(blur, leaky)?)?; // [B, c0, H, W]
        let p1 = self.rb1.forward(self.down1.activated(&p0, leaky)?)?; // [B, c1, H/2, W/2]
        let p2 = self.rb2.forward(self.down2.activated(&p1, leaky)?)?; // [B, c2, H/4, W/4]
        let m1 = add_nearest_2x(&p1, &self.lat2.forward(&p2)?)?;
        let m0 = add_nearest_2x(&p0, &self.lat1.forward(&m1)?)?;
        self.out.forward(&m0)
    }
}

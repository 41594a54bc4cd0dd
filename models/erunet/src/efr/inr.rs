//! Psi_inr: the encoder and decoder around the fusion (paper, eq. 1 and 3).

use candle_core::{Result, Tensor};
use noctule_kernels::Activation;

use crate::blocks::{ResEs, Up};
use crate::config::Config;
use crate::conv::{Conv, ConvShape};
use crate::params::Params;

/// Halves the size, then refines: Phi_1 (`enc1`) and Phi_2 (`enc2`).
struct Encoder {
    down: Conv,
    rb: ResEs,
}

impl Encoder {
    fn new(params: &Params<'_>, inputs: usize, outputs: usize, blocks: usize) -> Result<Self> {
        Ok(Self {
            down: Conv::new(&params.at("down"), ConvShape::k3(inputs, outputs).halving())?,
            rb: ResEs::new(&params.at("rb"), outputs, blocks)?,
        })
    }

    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        self.rb
            .forward(self.down.activated(x, Activation::LeakyRelu)?)
    }
}

/// Psi_1 (`dec1`): a quarter of the size to half.
struct Dec1 {
    rb: ResEs,
    up: Up,
}

/// Psi_2 (`dec2`): half the size to full, with the skip from `enc1`.
struct Dec2 {
    merge: Conv,
    rb: ResEs,
    up: Up,
    out: Conv,
}

/// The encoder and the decoder; their weight names stand directly under `efr.`.
pub(super) struct Inr {
    enc1: Encoder,
    enc2: Encoder,
    dec1: Dec1,
    dec2: Dec2,
}

impl Inr {
    pub(super) fn new(params: &Params<'_>, config: &Config) -> Result<Self> {
        let [c0, c1, c2] = config.c;
        let (n1, n2) = (config.n1, config.n2);
        let (dec1, dec2) = (params.at("dec1"), params.at("dec2"));
        Ok(Self {
            enc1: Encoder::new(&params.at("enc1"), c0, c1, n1)?,
            enc2: Encoder::new(&params.at("enc2"), c1, c2, n2)?,
            dec1: Dec1 {
                rb: ResEs::new(&dec1.at("rb"), c2, n2)?,
                up: Up::new(&dec1.at("up"), c2, c1)?,
            },
            dec2: Dec2 {
                merge: Conv::new(&dec2.at("merge"), ConvShape::k3(2 * c1, c1))?,
                rb: ResEs::new(&dec2.at("rb"), c1, n1)?,
                up: Up::new(&dec2.at("up"), c1, c0)?,
                out: Conv::new(&dec2.at("out"), ConvShape::k3(c0, c0))?,
            },
        })
    }

    /// `x` `[B, c0, H, W]`; returns E1 `[B, c1, H/2, W/2]` and E2 `[B, c2, H/4, W/4]`.
    pub(super) fn encode(&self, x: &Tensor) -> Result<(Tensor, Tensor)> {
        let e1 = self.enc1.forward(x)?;
        let e2 = self.enc2.forward(&e1)?;
        Ok((e1, e2))
    }

    /// `moved` `[B, c2, H/4, W/4]`, `e1` `[B, c1, H/2, W/2]`; returns `F_clear` `[B, c0, H, W]`.
    pub(super) fn decode(&self, moved: &Tensor, e1: &Tensor) -> Result<Tensor> {
        let Self { dec1, dec2, .. } = self;
        let leaky = Activation::LeakyRelu;
        let d1 = dec1.up.activated(&dec1.rb.forward(moved.clone())?, leaky)?; // [B, c1, H/2, W/2]
        let x = dec2.merge.apply(&[&d1, e1], None, leaky)?;
        let x = dec2.up.activated(&dec2.rb.forward(x)?, leaky)?; // [B, c0, H, W]
        dec2.out.forward(&x)
    }
}

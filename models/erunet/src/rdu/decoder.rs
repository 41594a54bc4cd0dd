//! One decoder stage: how far to trust the depth so far, and what to put in its place
//! (paper, eq. 5 to 7).

use candle_core::{Result, Tensor};

use super::garf::Garf;
use crate::blocks::{ConvBn, ResDs, Up, sigmoid};
use crate::config::Config;
use crate::conv::{Conv, ConvShape};
use crate::params::Params;
use crate::pass::Pass;

/// The gate of one level, with what went into it. All `[N, d, h, w]` but the confidence.
pub(crate) struct Gated {
    /// `F_dep`: upsampled depth feature merged with the sparse encoder's.
    depth: Tensor,
    /// C, `[N, 1, h, w]`, 0 to 1.
    pub(super) confidence: Tensor,
    /// `F_ref`: the depth feature filtered by what the guidance asks for.
    refined: Tensor,
    /// `F_gate`: kept where trusted, refined where not.
    pub(super) out: Tensor,
}

impl Gated {
    pub(super) fn keep(&self, level: usize, pass: &mut Pass) {
        for (name, feature) in [
            ("F_dep", &self.depth),
            ("C", &self.confidence),
            ("F_ref", &self.refined),
            ("F_gate", &self.out),
        ] {
            pass.keep(name, level, feature);
        }
    }
}

/// Doubles the size of the depth feature and gates it.
pub(super) struct DecStage {
    up: Up,
    merge: ConvBn,
    rb: ResDs,
    conf: Conv,
    garf: Garf,
}

impl DecStage {
    pub(super) fn new(params: &Params<'_>, config: &Config, level: usize) -> Result<Self> {
        let d = config.d[level];
        let guided = d + config.guidance_width(level);
        Ok(Self {
            up: Up::new(&params.at("up"), config.d[level + 1], d)?,
            merge: ConvBn::new(&params.at("merge"), ConvShape::k3(2 * d, d))?,
            rb: ResDs::new(&params.at("rb"), d, config.n_u[level])?,
            conf: Conv::new(&params.at("conf"), ConvShape::k3(guided, 1).gain(0.1))?,
            garf: Garf::new(&params.at("garf"), config, level)?,
        })
    }

    /// `x` `[N, d[l+1], h/2, w/2]`, `skip` `[N, d, h, w]`, `guidance` `[N, g + e, h, w]`.
    pub(super) fn forward(
        &self,
        x: &Tensor,
        skip: &Tensor,
        guidance: &Tensor,
        pass: &mut Pass,
    ) -> Result<Gated> {
        let merged = Tensor::cat(&[&self.up.forward(x)?, skip], 1)?; // [N, 2d, h, w]
        let depth = self.rb.forward(self.merge.forward(&merged, pass)?, pass)?;
        let asked = Tensor::cat(&[&depth, guidance], 1)?;
        let confidence = sigmoid(&self.conf.forward(&asked)?)?; // eq. 5
        let kept = depth.broadcast_mul(&confidence)?;
        let refined = self.garf.forward(&kept, guidance)?; // eq. 6
        let doubt = confidence.affine(-1.0, 1.0)?;
        let out = (kept + refined.broadcast_mul(&doubt)?)?; // eq. 7
        Ok(Gated {
            depth,
            confidence,
            refined,
            out,
        })
    }
}

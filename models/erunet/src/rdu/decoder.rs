//! One decoder stage: how far to trust the depth so far, and what to put in its place
//! (paper, eq. 5 to 7).

use candle_core::{Result, Tensor};
use noctule_kernels::Activation;

use super::garf::Garf;
use crate::blocks::{ConvBn, ResDs, Up, replace_doubted, trust};
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
        let merged = [&self.up.forward(x)?, skip]; // [N, 2d, h, w]
        let depth = self.merge.forward_joined(&merged, pass)?;
        let depth = self.rb.forward(depth, pass)?;
        let asked = [&depth, guidance];
        let confidence = self.conf.apply(&asked, None, Activation::Sigmoid)?; // eq. 5
        let kept = trust(&depth, &confidence)?;
        let refined = self.garf.forward(&kept, guidance)?; // eq. 6
        let out = replace_doubted(&kept, &refined, &confidence)?; // eq. 7
        Ok(Gated {
            depth,
            confidence,
            refined,
            out,
        })
    }
}

//! A feature pyramid of five levels, each half the size of the one above.

use candle_core::{Result, Tensor};
use noctule_kernels::Activation;

use crate::blocks::{ConvBn, ResDs};
use crate::conv::{Conv, ConvShape};
use crate::params::Params;
use crate::pass::Pass;

enum Stem {
    Normed(ConvBn),
    /// A wider field and no norm: statistics of a sparse map mean nothing.
    Plain(Conv),
}

/// Five levels of features from one input.
pub(super) struct Pyramid {
    stem: Stem,
    rb: Vec<ResDs>,
    down: Vec<ConvBn>,
}

impl Pyramid {
    /// With a normalised 3x3 stem, for dense inputs.
    pub(super) fn new(
        params: &Params<'_>,
        inputs: usize,
        widths: &[usize; 5],
        blocks: &[usize; 5],
    ) -> Result<Self> {
        let stem = ConvBn::new(&params.at("stem"), ConvShape::k3(inputs, widths[0]))?;
        Self::with_stem(params, Stem::Normed(stem), widths, blocks)
    }

    /// With a plain 5x5 stem, for sparse inputs.
    pub(super) fn with_plain_stem(
        params: &Params<'_>,
        inputs: usize,
        widths: &[usize; 5],
        blocks: &[usize; 5],
    ) -> Result<Self> {
        let stem = Conv::new(&params.at("stem"), ConvShape::new(5, inputs, widths[0]))?;
        Self::with_stem(params, Stem::Plain(stem), widths, blocks)
    }

    fn with_stem(
        params: &Params<'_>,
        stem: Stem,
        widths: &[usize; 5],
        blocks: &[usize; 5],
    ) -> Result<Self> {
        let rb = (0..5)
            .map(|l| ResDs::new(&params.at(&format!("rb{l}")), widths[l], blocks[l]))
            .collect::<Result<_>>()?;
        let down = (1..5)
            .map(|l| {
                let shape = ConvShape::k3(widths[l - 1], widths[l]).halving();
                ConvBn::new(&params.at(&format!("down{l}")), shape)
            })
            .collect::<Result<_>>()?;
        Ok(Self { stem, rb, down })
    }

    /// `x` `[N, I, H, W]`; returns level l as `[N, widths[l], H/2^l, W/2^l]`.
    pub(super) fn forward(&self, x: &Tensor, pass: &mut Pass) -> Result<Vec<Tensor>> {
        let stem = match &self.stem {
            Stem::Normed(conv) => conv.forward(x, pass)?,
            Stem::Plain(conv) => conv.activated(x, Activation::Relu)?,
        };
        let mut levels = vec![self.rb[0].forward(stem, pass)?];
        for (down, rb) in self.down.iter().zip(&self.rb[1..]) {
            let above = &levels[levels.len() - 1];
            levels.push(rb.forward(down.forward(above, pass)?, pass)?);
        }
        Ok(levels)
    }
}

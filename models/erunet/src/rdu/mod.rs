//! Reliability-aware depth upsampling: a restored feature, a step's events and a sparse depth map
//! in, one dense depth map out (paper, section 3.3; equations 5 to 7).
//!
//! Nothing here remembers earlier steps: steps may be folded into the batch.

mod atoms;
mod decoder;
mod garf;
mod garf_cpu;
mod head;
mod pyramid;

use candle_core::{Device, Result, Tensor};

use noctule_depth::Ground;

pub(crate) use atoms::{bank, bank_size};

use crate::activate::leaky_relu;
use crate::blocks::{ConvBn, ResDs};
use crate::config::{Config, Form};
use crate::conv::{Conv, ConvShape};
use crate::params::Params;
use crate::pass::Pass;
use crate::prefill::{DROP, RISE, prefill};
use decoder::DecStage;
use head::Head;
use pyramid::Pyramid;

/// The completion network; weight names start with `rdu.`.
pub(crate) struct Rdu {
    guide: Pyramid,
    event: Option<Pyramid>,
    depth: Pyramid,
    bott: ConvBn,
    bott_rb: ResDs,
    /// Decoder stages for levels 0 to 3; run from 3 to 0.
    dec: [DecStage; 4],
    head: Head,
    rgb_stem: Option<Conv>,
    d_max: f64,
    form: Form,
}

impl Rdu {
    pub(crate) fn new(params: &Params<'_>, config: &Config) -> Result<Self> {
        let (c0, d4) = (config.c[0], config.d[4]);
        let event = config
            .has_event_pyramid()
            .then(|| Pyramid::new(&params.at("event"), config.bins, &config.e, &config.n_e))
            .transpose()?;
        let rgb_stem = (!config.has_efr())
            .then(|| Conv::new(&params.at("rgb_stem"), ConvShape::k3(3, c0)))
            .transpose()?;
        let seen = config.form.depth_channels();
        let joined = d4 + config.guidance_width(4);
        let stage = |l: usize| DecStage::new(&params.at(&format!("dec{l}")), config, l);
        Ok(Self {
            guide: Pyramid::new(&params.at("guide"), c0, &config.g, &config.n_g)?,
            event,
            depth: Pyramid::with_plain_stem(&params.at("depth"), seen, &config.d, &config.n_d)?,
            bott: ConvBn::new(&params.at("bott"), ConvShape::k1(joined, d4))?,
            bott_rb: ResDs::with_gain(&params.at("bott_rb"), d4, config.n_b, 1.0)?,
            dec: [stage(0)?, stage(1)?, stage(2)?, stage(3)?],
            head: Head::new(params, config)?,
            rgb_stem,
            d_max: config.d_max,
            form: config.form,
        })
    }

    /// Stands in for restoration: a sharp picture `[B, 3, H, W]` to a feature `[B, c0, H, W]`;
    /// `None` for networks that restore.
    pub(crate) fn picture_feature(&self, picture: &Tensor) -> Option<Result<Tensor>> {
        self.rgb_stem
            .as_ref()
            .map(|stem| leaky_relu(&stem.forward(picture)?))
    }

    /// `clear` `[N, c0, H, W]`, `voxel` `[N, bins, H, W]`, `sparse` `[N, 1, H, W]` in metres with
    /// 0 for no return; returns depth in metres and confidence at level 0, each `[N, 1, H, W]`.
    pub(crate) fn forward(
        &self,
        clear: &Tensor,
        voxel: &Tensor,
        sparse: &Tensor,
        pass: &mut Pass,
    ) -> Result<(Tensor, Tensor)> {
        let guidance = self.guidance(clear, voxel, pass)?;
        let (seen, nearest) = self.seen(sparse, pass.grounds(), clear.device())?;
        let depth = self.depth.forward(&seen, pass)?;
        let joined = Tensor::cat(&[&depth[4], &guidance[4]], 1)?;
        let mut x = self
            .bott_rb
            .forward(self.bott.forward(&joined, pass)?, pass)?;
        let mut confidence = None;
        for level in (0..4).rev() {
            let stage = &self.dec[level];
            let gated = stage.forward(&x, &depth[level], &guidance[level], pass)?;
            gated.keep(level, pass);
            x = gated.out;
            confidence = Some(gated.confidence);
        }
        let confidence = confidence.expect("the loop above runs four times");
        let depth = match (self.form, nearest) {
            (Form::Choice, Some(nearest)) => {
                let (drop, rise) = (seen.narrow(1, DROP, 1)?, seen.narrow(1, RISE, 1)?);
                (self.head.choice(&x, &drop, &rise)? * nearest)?
            }
            (_, Some(nearest)) => (self.head.factor(&x)? * nearest)?,
            (_, None) => (self.head.share(&x)? * self.d_max)?,
        };
        Ok((depth, confidence))
    }

    /// What the depth encoder sees, `[N, 2 to 7, H, W]`, and what the output is a factor on.
    // A depth range in double precision would not outlive its first rounding.
    #[allow(
        clippy::cast_possible_truncation,
        reason = "metres in single precision"
    )]
    fn seen(
        &self,
        sparse: &Tensor,
        grounds: &[Option<Ground>],
        device: &Device,
    ) -> Result<(Tensor, Option<Tensor>)> {
        match self.form {
            Form::Direct => {
                let returned = sparse.gt(0f32)?.to_dtype(sparse.dtype())?;
                let seen = Tensor::cat(&[&(sparse / self.d_max)?, &returned], 1)?;
                Ok((seen.to_device(device)?, None))
            }
            Form::Residual | Form::Choice => {
                let (seen, nearest) =
                    prefill(sparse, grounds, self.form, self.d_max as f32, device)?;
                Ok((seen, Some(nearest)))
            }
        }
    }

    /// Hierarchical guidance HG per level, `[N, g + e, H/2^l, W/2^l]`.
    fn guidance(&self, clear: &Tensor, voxel: &Tensor, pass: &mut Pass) -> Result<Vec<Tensor>> {
        let guide = self.guide.forward(clear, pass)?;
        let Some(event) = &self.event else {
            return Ok(guide);
        };
        let event = event.forward(voxel, pass)?;
        guide
            .iter()
            .zip(&event)
            .map(|(g, e)| Tensor::cat(&[g, e], 1))
            .collect()
    }
}

//! The completion network as a plan (paper, equations 5 to 7).

use candle_core::Result;
use noctule_kernels::{Activation, Between, Emit, Garf, Gate, Intake};

use super::any_step;
use super::draft::{Draft, Map, Then};
use crate::config::Form;
use crate::prefill::LOG_SPAN;
use crate::rdu::bank_size;

/// The features of one level beside the depth feature: guidance, and events where there are any.
type Guidance = Vec<Map>;

impl Draft<'_> {
    /// Adds everything from `F_clear` to the caller's depth and confidence.
    // A share of the depth range in double precision would not outlive its first rounding.
    #[allow(
        clippy::cast_possible_truncation,
        reason = "metres in single precision"
    )]
    pub(super) fn completion(&mut self, clear: Map) -> Result<()> {
        self.builder.set_passes(any_step());
        let range_m = self.config.d_max as f32;
        let guidance = self.guidance(clear)?;
        let seen = Map {
            feature: self
                .builder
                .feature(self.config.form.depth_channels(), self.size),
            size: self.size,
        };
        let from = self.slices.sparse;
        let (intake, emit) = match self.config.form {
            Form::Direct => (Intake::SparseDepth { range_m }, Emit::Scaled(range_m)),
            form => {
                let (base, span) = (self.slices.nearest, LOG_SPAN);
                let between = (form == Form::Choice).then(|| Between {
                    pick: self.builder.plane(self.size),
                    drop: self.slices.drop,
                    rise: self.slices.rise,
                });
                let emit = Emit::Factor {
                    base,
                    span,
                    between,
                };
                (Intake::Planes, emit)
            }
        };
        self.builder.set_label("sparse");
        self.builder.take(from, intake, seen.feature);
        let stem = Then::new(Activation::Relu);
        let stem = self.named("rdu.depth.stem", &[seen], stem)?;
        let n_d = self.config.n_d;
        let depth = self.pyramid("rdu.depth", stem, &n_d)?;
        let joined: Vec<Map> = [depth[4]].into_iter().chain(guidance[4].clone()).collect();
        let x = self.conv_bn("rdu.bott", &joined, 1)?;
        let mut x = self.res_d("rdu.bott_rb", self.config.n_b, x)?;
        for level in (0..4).rev() {
            x = self.stage(level, x, depth[level], &guidance[level])?;
        }
        let x = self.named("rdu.head1", &[x], Then::new(Activation::Relu))?;
        let head = self.layer("rdu.head2")?;
        self.builder.set_label("rdu.head2");
        let channel = head.weight.len() / self.config.form.head_channels();
        let gate = Gate {
            inputs: &[x.feature],
            weight: &head.weight[..channel],
            bias: head.bias[0],
            kernel: head.kernel,
            plane: None,
            output: Some((self.slices.depth, emit)),
            kept: None,
        };
        if let Emit::Factor {
            between: Some(between),
            ..
        } = emit
        {
            let pick = Gate {
                weight: &head.weight[channel..],
                bias: head.bias[1],
                plane: Some(between.pick),
                output: None,
                ..gate.clone()
            };
            self.builder.gate(&pick);
        }
        self.builder.gate(&gate);
        Ok(())
    }

    /// Guidance per level (HG).
    fn guidance(&mut self, clear: Map) -> Result<Vec<Guidance>> {
        let stem = self.conv_bn("rdu.guide.stem", &[clear], 1)?;
        let n_g = self.config.n_g;
        let guide = self.pyramid("rdu.guide", stem, &n_g)?;
        let mut guidance: Vec<Guidance> = guide.into_iter().map(|map| vec![map]).collect();
        if self.config.has_event_pyramid() {
            let voxel = self.voxel();
            let stem = self.conv_bn("rdu.event.stem", &[voxel], 1)?;
            let n_e = self.config.n_e;
            let event = self.pyramid("rdu.event", stem, &n_e)?;
            for (level, map) in guidance.iter_mut().zip(event) {
                level.push(map);
            }
        }
        Ok(guidance)
    }

    /// Five levels from the first one's stem.
    fn pyramid(&mut self, path: &str, stem: Map, blocks: &[usize; 5]) -> Result<Vec<Map>> {
        let mut x = self.res_d(&format!("{path}.rb0"), blocks[0], stem)?;
        let mut levels = vec![x];
        for (level, count) in blocks.iter().enumerate().skip(1) {
            x = self.conv_bn(&format!("{path}.down{level}"), &[x], 2)?;
            x = self.res_d(&format!("{path}.rb{level}"), *count, x)?;
            levels.push(x);
        }
        Ok(levels)
    }

    /// One decoder stage: doubled, merged, gated, refined.
    fn stage(&mut self, level: usize, x: Map, skip: Map, guidance: &[Map]) -> Result<Map> {
        let at = |name: &str| format!("rdu.dec{level}.{name}");
        let up = self.up(&at("up"), x, Activation::None)?;
        let merged = self.conv_bn(&at("merge"), &[up, skip], 1)?;
        let depth = self.res_d(&at("rb"), self.config.n_u[level], merged)?;
        let (size, width) = (depth.size, self.config.d[level]);
        let kept = Map {
            feature: self.builder.feature(width, size),
            size,
        };
        let trust = self.builder.plane(size);
        let conf = self.layer(&at("conf"))?;
        let with_guidance = |first: Map| -> Vec<Map> {
            [first]
                .into_iter()
                .chain(guidance.iter().copied())
                .collect()
        };
        let asked: Vec<_> = with_guidance(depth).iter().map(|map| map.feature).collect();
        self.builder.set_label(&at("conf"));
        self.builder.gate(&Gate {
            inputs: &asked,
            weight: &conf.weight,
            bias: conf.bias[0],
            kernel: conf.kernel,
            plane: Some(trust),
            output: (level == 0).then_some((self.slices.confidence, Emit::Scaled(1.0))),
            kept: Some((depth.feature, kept.feature)),
        }); // eq. 5
        let tanh = Then::new(Activation::Tanh);
        let hidden = self.named(&at("garf.coef1"), &with_guidance(kept), tanh)?;
        let (coefficients, mix) = (self.layer(&at("garf.coef2"))?, self.layer(&at("garf.mix"))?);
        let atoms = self.values(&at("garf.atoms"))?;
        let (_, side) = bank_size(level);
        let output = self.builder.feature(width, size);
        self.builder.set_label(&at("garf"));
        self.builder.garf(&Garf {
            x: kept.feature,
            hidden: hidden.feature,
            trust,
            atoms: &atoms,
            side,
            filters: self.config.filters,
            coefficients: (&coefficients.weight, &coefficients.bias),
            mix: (&mix.weight, &mix.bias),
            output,
        }); // eq. 6 and 7
        Ok(Map {
            feature: output,
            size,
        })
    }
}

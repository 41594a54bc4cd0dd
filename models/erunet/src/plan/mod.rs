//! The compiled network: every layer over one arena, fused, for processors.
//!
//! A [`Plan`] gives what [`crate::Sequence`] gives, from the same weights, one exposure at a time
//! and on slices instead of tensors; after it stands, nothing allocates. Candle's network remains
//! the definition: the tests hold the plan to it.

mod draft;
mod efr;
mod profile;
mod rdu;

use noctule_depth::Ground;
use noctule_kernels::{BuildError, Builder, Isa, Options, Passes, Precision, Program, RunError};
use thiserror::Error;

use crate::config::{Config, ConfigError, Form, SIDE_MULTIPLE};
use crate::prefill::{self, Prefill};
use crate::weights::{Weights, WeightsError};
use draft::Draft;

pub use profile::LayerProfile;

/// Runs once, when the plan is built: what depends on the picture's size alone.
const SETUP: usize = 0;
/// Runs once per exposure.
const BEGIN: usize = 1;
/// The first step of an exposure, which has none before it.
const FIRST: usize = 2;
/// Every further step.
const LATER: usize = 3;

/// Places in the lists of slices.
const BLUR: usize = 0;
const VOXEL: usize = 1;
const SPARSE: usize = 2;
const NEAREST: usize = 3;
const DROP: usize = 4;
const RISE: usize = 5;
/// Slices a step or a beginning may read.
const SLICES: usize = 6;

/// Why a plan could not be made or run.
#[derive(Debug, Error)]
pub enum PlanError {
    /// The configuration describes no network.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The weights do not fit the configuration.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The picture's sides are not what the pyramids can halve.
    #[error("picture is {height} x {width} pixels, wanted multiples of {SIDE_MULTIPLE}")]
    Size {
        /// Rows asked for.
        height: usize,
        /// Columns asked for.
        width: usize,
    },
    /// The kernels cannot be built: too many threads, or instructions the processor lacks.
    #[error(transparent)]
    Build(#[from] BuildError),
    /// A slice has the wrong length. Inputs count as blur, voxel, sparse, nearest, drop, rise; outputs
    /// as depth, confidence.
    #[error(transparent)]
    Run(#[from] RunError),
    /// A step was asked for before any picture was handed in.
    #[error("no exposure has begun")]
    NotBegun,
    /// An exposure was stepped beyond its last step.
    #[error("all {steps} steps of the exposure are done")]
    StepsExhausted {
        /// Steps per exposure.
        steps: usize,
    },
    /// A tensor could not be read from its device.
    #[error("tensor operation failed: {0}")]
    Tensor(#[from] candle_core::Error),
}

/// How a plan is compiled.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PlanOptions {
    /// Threads that work together, the caller's among them; the others are bound to a processor
    /// each.
    pub threads: usize,
    /// How features and weights are stored.
    pub precision: Precision,
    /// Which instructions to use.
    pub isa: Isa,
}

impl Default for PlanOptions {
    /// One thread, single precision, the fastest instructions there are.
    fn default() -> Self {
        let Options {
            threads,
            precision,
            isa,
        } = Options::default();
        Self {
            threads,
            precision,
            isa,
        }
    }
}

/// ERU-Net compiled for one size of picture.
pub struct Plan {
    program: Program,
    bins: usize,
    area: usize,
    steps: usize,
    /// Steps done since the last `begin`; `None` before the first.
    done: Option<usize>,
    /// What SETUP takes: the share of the coordinates in the motion feature, empty where the
    /// network restores nothing.
    place: Vec<f32>,
    /// Present where depth leaves as a factor on the nearest return.
    filled: Option<Filled>,
}

/// What the residual forms add to a step's inputs.
struct Filled {
    prefill: Prefill,
    nearest: Vec<f32>,
    seen: Vec<f32>,
}

impl Filled {
    #[allow(
        clippy::cast_possible_truncation,
        reason = "metres in single precision"
    )]
    fn new(config: &Config, height: usize, width: usize) -> candle_core::Result<Self> {
        Ok(Self {
            prefill: Prefill::new(config.form, height, width, config.d_max as f32)?,
            nearest: vec![0.0; height * width],
            seen: vec![0.0; config.form.depth_channels() * height * width],
        })
    }
}

impl Plan {
    /// Compiles the network for pictures of `height` x `width` pixels: folds the norms, packs the
    /// weights, places every feature in one arena and starts the threads.
    pub fn new(
        config: &Config,
        weights: &Weights,
        height: usize,
        width: usize,
        options: PlanOptions,
    ) -> Result<Self, PlanError> {
        config.validate()?;
        weights.check(config)?;
        let is_side = |side: usize| side > 0 && side.is_multiple_of(SIDE_MULTIPLE);
        if !is_side(height) || !is_side(width) {
            return Err(PlanError::Size { height, width });
        }
        let mut draft = Draft::new(config, weights, height, width);
        let (clear, place) = draft.restoration()?;
        draft.completion(clear)?;
        let Draft { builder, .. } = draft;
        let PlanOptions {
            threads,
            precision,
            isa,
        } = options;
        let mut plan = Self {
            program: builder.finish(Options {
                threads,
                precision,
                isa,
            })?,
            bins: config.bins,
            area: height * width,
            steps: config.steps,
            done: None,
            place,
            filled: (config.form != Form::Direct)
                .then(|| Filled::new(config, height, width))
                .transpose()?,
        };
        plan.set_up()?;
        Ok(plan)
    }

    fn set_up(&mut self) -> Result<(), PlanError> {
        Ok(self.program.run(
            SETUP,
            0,
            &[&[], &[], &[], &[], &[], &[], &self.place],
            &mut [],
        )?)
    }

    /// Starts an exposure: `blur` `[3, H, W]`, encoded values over 255; for a network without
    /// restoration, the deblurred picture. Drops the exposure before it, finished or not.
    ///
    /// `ground` says where level ground lies in the picture, where that is known; it holds for the
    /// steps of this exposure.
    pub fn begin(&mut self, blur: &[f32], ground: Option<&Ground>) -> Result<(), PlanError> {
        let mut slices: [&[f32]; SLICES] = [&[]; SLICES];
        slices[BLUR] = blur;
        self.program.run(BEGIN, 0, &slices, &mut [])?;
        if let Some(filled) = &mut self.filled {
            filled.prefill.stand_on(ground);
        }
        self.done = Some(0);
        Ok(())
    }

    /// Works through the next step: `voxel` `[bins, H, W]` in -1 to 1, `sparse` `[H, W]` in
    /// metres with 0 for no return; fills `depth` in metres and `confidence` (C of eq. 5 at level
    /// 0, 0 to 1), each `[H, W]`. A refused call leaves the exposure where it was.
    pub fn step(
        &mut self,
        voxel: &[f32],
        sparse: &[f32],
        depth: &mut [f32],
        confidence: &mut [f32],
    ) -> Result<(), PlanError> {
        let done = self.done.ok_or(PlanError::NotBegun)?;
        if done == self.steps {
            let steps = self.steps;
            return Err(PlanError::StepsExhausted { steps });
        }
        let pass = if done == 0 { FIRST } else { LATER };
        let variant = if self.place.is_empty() { 0 } else { done };
        let mut slices: [&[f32]; SLICES] = [&[]; SLICES];
        slices[VOXEL] = voxel;
        slices[SPARSE] = sparse;
        if let Some(filled) = &mut self.filled {
            let Filled {
                prefill,
                nearest,
                seen,
            } = filled;
            prefill.fill(sparse, nearest, seen)?;
            (slices[SPARSE], slices[NEAREST]) = (&*seen, &*nearest);
            (slices[DROP], slices[RISE]) = limits(seen, self.area);
        }
        self.program
            .run(pass, variant, &slices, &mut [depth, confidence])?;
        self.done = Some(done + 1);
        Ok(())
    }

    /// Steps done of the exposure begun last.
    pub fn done_count(&self) -> usize {
        self.done.unwrap_or(0)
    }

    /// Bytes of the arena, and of the packed weights.
    pub fn memory_bytes(&self) -> (usize, usize) {
        (self.program.arena_bytes(), self.program.weight_bytes())
    }

    /// Fills the arena with what is not a number and drops the exposure. A test shows with it
    /// that nothing is read before it is written.
    pub fn poison(&mut self) -> Result<(), PlanError> {
        self.program.poison();
        self.done = None;
        self.set_up()
    }
}

/// The planes among those seen that limit a choice; empty where none is made.
fn limits(seen: &[f32], area: usize) -> (&[f32], &[f32]) {
    let plane = |index: usize| seen.get(index * area..(index + 1) * area).unwrap_or(&[]);
    (plane(prefill::DROP), plane(prefill::RISE))
}

/// The passes of a step, whichever it is.
fn any_step() -> Passes {
    Passes::of(&[FIRST, LATER])
}

/// A builder with the slices every plan has, in the order of their places.
fn builder_with_slices(config: &Config, area: usize) -> (Builder, Slices) {
    let mut builder = Builder::new();
    let slices = Slices {
        blur: builder.input(3 * area),
        voxel: builder.input(config.bins * area),
        sparse: builder.input(match config.form {
            Form::Direct => area,
            form => form.depth_channels() * area,
        }),
        nearest: builder.input(area),
        drop: builder.input(area),
        rise: builder.input(area),
        depth: builder.output(area),
        confidence: builder.output(area),
    };
    (builder, slices)
}

/// The caller's slices.
#[derive(Clone, Copy)]
struct Slices {
    blur: noctule_kernels::Input,
    voxel: noctule_kernels::Input,
    /// As the depth encoder sees it: metres, or the planes of a residual form.
    sparse: noctule_kernels::Input,
    nearest: noctule_kernels::Input,
    drop: noctule_kernels::Input,
    rise: noctule_kernels::Input,
    depth: noctule_kernels::Output,
    confidence: noctule_kernels::Output,
}

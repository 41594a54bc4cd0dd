//! What a program is made of, as its author describes it.

use thiserror::Error;

use crate::activation::Activation;
use crate::conv::Store;
use crate::isa::Isa;
use crate::layout::Size;
use crate::planar::Intake;

/// Most threads a program may be run by.
pub const THREADS_MAX: usize = 64;

/// How numbers are stored; sums are always kept in single precision.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Precision {
    /// Features and weights in single precision.
    #[default]
    Single,
    /// Features and weights in bfloat16.
    Brain,
}

/// How a program is compiled.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Options {
    /// Threads that work together, the caller's among them.
    pub threads: usize,
    /// How numbers are stored.
    pub precision: Precision,
    /// Which instructions to use.
    pub isa: Isa,
}

impl Default for Options {
    /// One thread, single precision, the fastest instructions there are.
    fn default() -> Self {
        Self {
            threads: 1,
            precision: Precision::Single,
            isa: Isa::detect(),
        }
    }
}

/// A slice the caller hands in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Input(pub(crate) usize);

/// A slice the caller has filled.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Output(pub(crate) usize);

/// A feature in the arena: channels of one size.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Feature(pub(crate) usize);

/// A single-precision plane in the arena.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Plane(pub(crate) usize);

/// A set of passes an operation takes part in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Passes(pub(crate) u8);

impl Passes {
    /// The passes listed, each below 8; others are not counted.
    pub fn of(passes: &[usize]) -> Self {
        Self(
            passes
                .iter()
                .filter(|p| **p < 8)
                .fold(0, |set, p| set | 1 << p),
        )
    }

    pub(crate) fn has(self, pass: usize) -> bool {
        self.0 >> pass & 1 == 1
    }
}

/// `activation(convolution(inputs) * gain + residual)`, zero-padded by half the kernel.
#[derive(Debug, Clone)]
pub struct Conv<'a> {
    /// Read as if concatenated along the channels.
    pub inputs: &'a [Feature],
    /// `[O, I, kernel, kernel]`.
    pub weight: &'a [f32],
    /// `[O]`, or `[variants, O]` where the bias depends on the run.
    pub bias: &'a [f32],
    /// Side of the window: 1, 3, 5 or 7.
    pub kernel: usize,
    /// 1 or 2.
    pub stride: usize,
    /// Factor on the sum, value by value.
    pub gain: Option<Feature>,
    /// Added after the gain.
    pub residual: Option<Feature>,
    /// Applied last.
    pub activation: Activation,
    /// Where results go; stride 1 where they spread.
    pub store: Store,
    /// The target; none of the features read.
    pub output: Feature,
}

/// What a gate writes to the caller.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Emit {
    /// `c` times this.
    Scaled(f32),
    /// `base * exp(span * tanh(z / span))` of the gate's sum `z`, base and target being slices of
    /// the caller; such a gate has neither plane nor kept feature. The span is above 0, at most 4.
    Factor {
        /// What the factor applies to.
        base: Input,
        /// Largest logarithm of the factor.
        span: f32,
        /// What the base is moved by first.
        between: Option<Between>,
    },
}

/// Moves a base between two limits: by `exp(t * rise)` where `t = 2 pick - 1` is above 0, else by
/// `exp(t * drop)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Between {
    /// 0 to 1, from an earlier gate.
    pub pick: Plane,
    /// Logarithm of the base over its lower limit, 0 to 7.
    pub drop: Input,
    /// Logarithm of the upper limit over the base, 0 to 7.
    pub rise: Input,
}

impl Emit {
    /// The limits a factor's base is moved between.
    pub(crate) fn between(&self) -> Option<Between> {
        match self {
            Self::Factor { between, .. } => *between,
            Self::Scaled(_) => None,
        }
    }
}

/// `c = sigmoid(convolution(inputs))`, one channel.
#[derive(Debug, Clone)]
pub struct Gate<'a> {
    /// Read as if concatenated along the channels.
    pub inputs: &'a [Feature],
    /// `[1, I, kernel, kernel]`.
    pub weight: &'a [f32],
    /// Of the one channel.
    pub bias: f32,
    /// Side of the window: 1, 3, 5 or 7.
    pub kernel: usize,
    /// Receives `c`.
    pub plane: Option<Plane>,
    /// Receives what [`Emit`] says.
    pub output: Option<(Output, Emit)>,
    /// `(from, to)`: `to = c * from`.
    pub kept: Option<(Feature, Feature)>,
}

/// Guided adaptive receptive fields and their gate (paper, eq. 6 and 7):
/// `output = x + (1 - doubt) * mix(filtered x)`, where every pixel filters `x` with `filters`
/// kernels, combined from the atoms by `tanh(coefficients(hidden))`.
#[derive(Debug, Clone)]
pub struct Garf<'a> {
    /// What is filtered, and added: `C * F_dep`.
    pub x: Feature,
    /// What the coefficients come from.
    pub hidden: Feature,
    /// C.
    pub trust: Plane,
    /// `[K, side, side]`.
    pub atoms: &'a [f32],
    /// Odd, up to 7.
    pub side: usize,
    /// Filters per pixel, M.
    pub filters: usize,
    /// `[M * K, hidden]` and `[M * K]`; channel m * K + k.
    pub coefficients: (&'a [f32], &'a [f32]),
    /// `[d, d * M]` and `[d]`; input channel c * M + m.
    pub mix: (&'a [f32], &'a [f32]),
    /// The target; neither `x` nor `hidden`.
    pub output: Feature,
}

/// Why a description makes no program.
#[derive(Debug, Error, PartialEq)]
pub enum BuildError {
    /// A count or a length is not what the rest of the operation asks for.
    #[error("operation {operation}: {what} is {actual}, wanted {wanted}")]
    Count {
        /// Place in the program.
        operation: usize,
        /// What was counted.
        what: &'static str,
        /// What it is.
        actual: usize,
        /// What would have fitted.
        wanted: usize,
    },
    /// A feature has another size than the operation needs.
    #[error("operation {operation}: {what} is {actual:?}, wanted {wanted:?}")]
    Size {
        /// Place in the program.
        operation: usize,
        /// Which feature.
        what: &'static str,
        /// Its size.
        actual: Size,
        /// The size wanted.
        wanted: Size,
    },
    /// A value is not among those the kernels are written for.
    #[error("operation {operation}: {what} is {actual}, allowed {allowed}")]
    Unsupported {
        /// Place in the program.
        operation: usize,
        /// What it is.
        what: &'static str,
        /// Its value.
        actual: usize,
        /// The values allowed.
        allowed: &'static str,
    },
    /// An operation would overwrite what it reads.
    #[error("operation {operation} reads and writes the same feature")]
    Aliased {
        /// Place in the program.
        operation: usize,
    },
    /// An operation reads what no earlier one of the same pass has written.
    #[error("operation {operation} reads {what} {index} before it is written")]
    Unwritten {
        /// Place in the program.
        operation: usize,
        /// Feature or plane.
        what: &'static str,
        /// Its place among them.
        index: usize,
    },
    /// A size, a number of channels, of slices or of threads is out of range.
    #[error("{what} is {actual}, allowed {allowed}")]
    Range {
        /// What it is.
        what: &'static str,
        /// Its value.
        actual: usize,
        /// The range allowed.
        allowed: &'static str,
    },
    /// The processor lacks the instructions asked for.
    #[error("this processor has no {0} instructions")]
    Instructions(Isa),
    /// A thread could not be started.
    #[error("thread did not start: {0}")]
    Thread(String),
}

/// An operation that owns what it was described with.
pub(crate) enum Spec {
    Take {
        from: Input,
        intake: Intake,
        to: Feature,
    },
    Give {
        from: Feature,
        to: Output,
    },
    Conv {
        inputs: Vec<Feature>,
        weight: Vec<f32>,
        bias: Vec<f32>,
        kernel: usize,
        stride: usize,
        gain: Option<Feature>,
        residual: Option<Feature>,
        activation: Activation,
        store: Store,
        output: Feature,
    },
    Gate {
        inputs: Vec<Feature>,
        weight: Vec<f32>,
        bias: f32,
        kernel: usize,
        plane: Option<Plane>,
        output: Option<(Output, Emit)>,
        kept: Option<(Feature, Feature)>,
    },
    Garf {
        x: Feature,
        hidden: Feature,
        trust: Plane,
        atoms: Vec<f32>,
        side: usize,
        filters: usize,
        coefficients: (Vec<f32>, Vec<f32>),
        mix: (Vec<f32>, Vec<f32>),
        output: Feature,
    },
}

/// A feature or a plane, as the arena sees them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Buffer {
    Feature(usize),
    Plane(usize),
}

impl Spec {
    /// The buffers read, each with the reach of the window that reads it.
    pub(crate) fn reads(&self) -> Vec<(Buffer, usize)> {
        let feature = |f: &Feature, reach| (Buffer::Feature(f.0), reach);
        match self {
            Self::Take { .. } => Vec::new(),
            Self::Give { from, .. } => vec![feature(from, 0)],
            Self::Conv {
                inputs,
                kernel,
                gain,
                residual,
                ..
            } => {
                let windows = inputs.iter().map(|f| feature(f, kernel / 2));
                let others = gain.iter().chain(residual).map(|f| feature(f, 0));
                windows.chain(others).collect()
            }
            Self::Gate {
                inputs,
                kernel,
                kept,
                output,
                ..
            } => {
                let windows = inputs.iter().map(|f| feature(f, kernel / 2));
                let kept = kept.iter().map(|(from, _)| feature(from, 0));
                let pick = output.iter().filter_map(|(_, emit)| emit.between());
                let pick = pick.map(|between| (Buffer::Plane(between.pick.0), 0));
                windows.chain(kept).chain(pick).collect()
            }
            Self::Garf {
                x,
                hidden,
                trust,
                side,
                ..
            } => vec![
                feature(x, side / 2),
                feature(hidden, 0),
                (Buffer::Plane(trust.0), 0),
            ],
        }
    }

    /// The buffers written.
    pub(crate) fn writes(&self) -> Vec<Buffer> {
        match self {
            Self::Take { to, .. } => vec![Buffer::Feature(to.0)],
            Self::Give { .. } => Vec::new(),
            Self::Conv { output, .. } | Self::Garf { output, .. } => {
                vec![Buffer::Feature(output.0)]
            }
            Self::Gate { plane, kept, .. } => {
                let plane = plane.iter().map(|p| Buffer::Plane(p.0));
                plane
                    .chain(kept.iter().map(|(_, to)| Buffer::Feature(to.0)))
                    .collect()
            }
        }
    }
}

//! From descriptions to operations: places in the arena, packed weights, compiled tiles.

use std::ops::Range;

use super::arena::{Demand, place};
use super::builder::{Builder, Described};
use super::costs::costs;
use super::crew::{Barrier, Claims, Crew};
use super::executable::Executable;
use super::profile::Watch;
use super::run::Program;
use crate::activation::Activation;
use crate::conv::{ConvOp, Dense, Finish, Gain, Store};
use crate::element::{Brain, Element, Single};
use crate::garf::{GarfOp, GarfWeights, Taps};
use crate::gate::{GateOp, GateTargets};
use crate::isa::Isa;
use crate::layout::{Frame, Place};
use crate::memory::Memory;
use crate::planar::{GiveOp, TakeOp};
#[cfg(target_arch = "x86_64")]
use crate::simd::{Avx2, Avx512};
use crate::simd::{Portable, Simd};
use crate::spec::{Buffer, BuildError, Feature, Options, Precision, Spec};

enum Operation<E: Element> {
    Take(TakeOp),
    Give(GiveOp),
    Conv(ConvOp<E>),
    Gate(GateOp<E>),
    Garf(Box<GarfOp<E>>),
}

impl<E: Element> Operation<E> {
    /// What threads may share: rows, or groups of outputs.
    fn units(&self) -> usize {
        match self {
            Self::Take(op) => op.to.size.height,
            Self::Give(op) => op.from.size.height,
            Self::Conv(op) => op.units(),
            Self::Gate(op) => op.height,
            Self::Garf(op) => op.rows(),
        }
    }

    fn scratch_bytes(&self) -> usize {
        match self {
            Self::Take(_) | Self::Give(_) | Self::Conv(_) => 0,
            Self::Gate(op) => op.scratch_bytes(),
            Self::Garf(op) => op.scratch_bytes(),
        }
    }

    fn weight_bytes(&self) -> usize {
        match self {
            Self::Take(_) | Self::Give(_) => 0,
            Self::Conv(op) => op.weight_bytes(),
            Self::Gate(op) => op.weight_bytes(),
            Self::Garf(op) => op.weight_bytes(),
        }
    }

    /// # Safety
    /// As for [`Executable::run`]; no other thread works on the same units.
    unsafe fn run<S: Simd>(&self, frame: &Frame, units: Range<usize>) {
        // SAFETY: passed on from the caller.
        unsafe {
            match self {
                Self::Take(op) => op.run::<S, E>(frame, units),
                Self::Give(op) => op.run::<S, E>(frame, units),
                Self::Conv(op) => op.run::<S>(frame, units),
                Self::Gate(op) => op.run::<S>(frame, units),
                Self::Garf(op) => op.run::<S>(frame, units),
            }
        }
    }
}

/// One operation of one pass.
struct Turn {
    operation: usize,
    /// Whether it must wait for those before it.
    waits: bool,
    claims: Claims,
}

struct Compiled<S: Simd, E: Element> {
    operations: Vec<Operation<E>>,
    passes: Vec<Vec<Turn>>,
    variants: usize,
    instructions: std::marker::PhantomData<S>,
}

impl<S: Simd, E: Element> Compiled<S, E> {
    /// Works on one operation until all of it is claimed.
    ///
    /// # Safety
    /// As for [`Executable::run`], and what the operation depends on is done.
    unsafe fn work(&self, turn: &Turn, frame: &Frame, thread: usize) {
        let operation = &self.operations[turn.operation];
        // SAFETY: passed on from the caller; no unit is handed out twice.
        let some = |units| unsafe { operation.run::<S>(frame, units) };
        turn.claims.each(thread, some);
    }
}

impl<S: Simd, E: Element> Executable for Compiled<S, E> {
    unsafe fn run(&self, pass: usize, frame: &Frame, thread: usize, barrier: &Barrier) {
        for turn in &self.passes[pass] {
            if turn.waits {
                barrier.wait();
            }
            // SAFETY: what an operation depends on lies before the barrier.
            unsafe { self.work(turn, frame, thread) };
        }
    }

    unsafe fn run_watched(&self, pass: usize, frame: &Frame, thread: usize, watch: &Watch<'_>) {
        for (turn, place) in self.passes[pass].iter().zip(0..) {
            watch.around(thread, place, || {
                // SAFETY: passed on from the caller; a barrier lies on both sides.
                unsafe { self.work(turn, frame, thread) };
            });
        }
    }

    fn reset(&self, pass: usize) {
        for turn in &self.passes[pass] {
            turn.claims.reset();
        }
    }

    fn operations(&self, pass: usize) -> Vec<usize> {
        self.passes[pass].iter().map(|t| t.operation).collect()
    }

    fn variant_count(&self) -> usize {
        self.variants
    }

    fn weight_bytes(&self) -> usize {
        self.operations.iter().map(Operation::weight_bytes).sum()
    }
}

/// Where everything lies.
struct Places {
    features: Vec<Place>,
    /// In single-precision numbers from the arena's start.
    planes: Vec<usize>,
    /// In bytes, features first.
    ranges: Vec<Range<usize>>,
    bytes: usize,
}

impl Places {
    fn range(&self, buffer: Buffer) -> &Range<usize> {
        match buffer {
            Buffer::Feature(index) => &self.ranges[index],
            Buffer::Plane(index) => &self.ranges[self.features.len() + index],
        }
    }

    fn all(&self, features: &[Feature]) -> Vec<Place> {
        features.iter().map(|f| self.features[f.0]).collect()
    }
}

impl Builder {
    /// Places everything, packs the weights and starts the threads.
    pub fn finish(self, options: Options) -> Result<Program, BuildError> {
        program(&self.checked(options)?, options)
    }
}

/// Compiles a checked description.
fn program(builder: &Builder, options: Options) -> Result<Program, BuildError> {
    match (options.precision, options.isa) {
        (Precision::Single, Isa::Portable) => compile::<Portable, Single>(builder, options),
        (Precision::Brain, Isa::Portable) => compile::<Portable, Brain>(builder, options),
        #[cfg(target_arch = "x86_64")]
        (Precision::Single, Isa::Avx2) => compile::<Avx2, Single>(builder, options),
        #[cfg(target_arch = "x86_64")]
        (Precision::Brain, Isa::Avx2) => compile::<Avx2, Brain>(builder, options),
        #[cfg(target_arch = "x86_64")]
        (Precision::Single, Isa::Avx512 | Isa::Avx512Bf16) => {
            compile::<Avx512<false>, Single>(builder, options)
        }
        #[cfg(target_arch = "x86_64")]
        (Precision::Brain, Isa::Avx512) => compile::<Avx512<false>, Brain>(builder, options),
        #[cfg(target_arch = "x86_64")]
        (Precision::Brain, Isa::Avx512Bf16) => compile::<Avx512<true>, Brain>(builder, options),
        #[cfg(not(target_arch = "x86_64"))]
        (_, isa) => Err(BuildError::Instructions(isa)),
    }
}

fn compile<S: Simd, E: Element>(
    builder: &Builder,
    options: Options,
) -> Result<Program, BuildError> {
    let places = places::<E>(builder);
    let operations: Vec<Operation<E>> = builder
        .operations
        .iter()
        .map(|op| operation::<S, E>(&op.spec, &places))
        .collect();
    let needs = builder.needs();
    let passes = (0..needs.len())
        .map(|pass| {
            let turn = |(operation, waits): (usize, bool)| Turn {
                operation,
                waits,
                claims: Claims::new(operations[operation].units(), options.threads),
            };
            let turns = turns(builder, &places, pass);
            turns.into_iter().map(turn).collect()
        })
        .collect();
    let scratch = operations.iter().map(Operation::scratch_bytes).max();
    // A cache line between threads, so that none slows another down.
    let scratch_bytes = scratch.unwrap_or(0).next_multiple_of(64) + 64;
    let executable = Compiled::<S, E> {
        operations,
        passes,
        variants: variants(builder),
        instructions: std::marker::PhantomData,
    };
    let crew = Crew::new(options.threads).map_err(|e| BuildError::Thread(e.to_string()))?;
    Ok(Program {
        executable: Box::new(executable),
        arena: Memory::zeroed(places.bytes + options.threads * scratch_bytes),
        scratch_start: places.bytes,
        scratch_bytes,
        crew,
        isa: options.isa,
        needs,
        costs: costs(builder, size_of::<E::T>()),
    })
}

/// The most biases any convolution has that has several; a run may ask for no more.
fn variants(builder: &Builder) -> usize {
    let several = builder.operations.iter().filter_map(|op| match &op.spec {
        Spec::Conv {
            bias,
            output,
            store,
            ..
        } => {
            let phases = if *store == Store::Shuffle { 4 } else { 1 };
            let count = bias.len() / (builder.features[output.0].channels * phases);
            (count > 1).then_some(count)
        }
        _ => None,
    });
    several.min().unwrap_or(1)
}

fn places<E: Element>(builder: &Builder) -> Places {
    let count = builder.features.len();
    let last = builder.operations.len();
    let mut halos = vec![0; count];
    let mut lives: Vec<Option<(usize, usize)>> = vec![None; count + builder.planes.len()];
    let slot = |buffer| match buffer {
        Buffer::Feature(index) => index,
        Buffer::Plane(index) => count + index,
    };
    for (index, Described { spec, .. }) in builder.operations.iter().enumerate() {
        let reads = spec.reads();
        for (buffer, reach) in &reads {
            if let Buffer::Feature(feature) = buffer {
                halos[*feature] = halos[*feature].max(*reach);
            }
        }
        for buffer in reads.into_iter().map(|(b, _)| b).chain(spec.writes()) {
            let life = lives[slot(buffer)].get_or_insert((index, index));
            life.1 = index;
        }
    }
    let layouts: Vec<Place> = builder
        .features
        .iter()
        .zip(&halos)
        .map(|(feature, halo)| Place::new(0, feature.channels, feature.size, *halo))
        .collect();
    let sizes = layouts
        .iter()
        .map(|place| place.len() * size_of::<E::T>())
        .chain(
            builder
                .planes
                .iter()
                .map(|size| size.area() * size_of::<f32>()),
        );
    let demands: Vec<Demand> = sizes
        .enumerate()
        .map(|(index, bytes)| {
            let is_state = builder.features.get(index).is_some_and(|f| f.is_state);
            let (from, to) = lives[index].unwrap_or((0, 0));
            let alive = if is_state { 0..=last } else { from..=to };
            Demand { bytes, alive }
        })
        .collect();
    let (ranges, bytes) = place(&demands);
    let placed = layouts.iter().zip(&ranges).map(|(layout, range)| {
        let start = range.start / size_of::<E::T>();
        Place::new(start, layout.channels, layout.size, layout.halo)
    });
    Places {
        features: placed.collect(),
        planes: ranges[count..]
            .iter()
            .map(|r| r.start / size_of::<f32>())
            .collect(),
        ranges,
        bytes,
    }
}

fn operation<S: Simd, E: Element>(spec: &Spec, places: &Places) -> Operation<E> {
    match spec {
        Spec::Take { from, intake, to } => Operation::Take(TakeOp {
            slot: from.0,
            intake: *intake,
            to: places.features[to.0],
        }),
        Spec::Give { from, to } => Operation::Give(GiveOp {
            from: places.features[from.0],
            slot: to.0,
        }),
        Spec::Conv {
            inputs,
            weight,
            bias,
            kernel,
            stride,
            gain,
            residual,
            activation,
            store,
            output,
        } => {
            let inputs = places.all(inputs);
            let dense = Dense {
                weight,
                inputs: inputs.iter().map(|place| place.channels).sum(),
                kernel: *kernel,
            };
            let finish = Finish {
                out: places.features[output.0],
                store: *store,
                gain: gain.map_or(Gain::None, |g| Gain::Feature(places.features[g.0])),
                residual: residual.map(|r| places.features[r.0]),
                activation: *activation,
            };
            Operation::Conv(ConvOp::new::<S>(&inputs, dense, bias, *stride, finish))
        }
        Spec::Gate {
            inputs,
            weight,
            bias,
            kernel,
            plane,
            output,
            kept,
        } => {
            let targets = GateTargets {
                plane: plane.map(|plane| places.planes[plane.0]),
                output: output.map(|(output, emit)| (output.0, emit)),
                pick: output
                    .and_then(|(_, emit)| emit.between())
                    .map(|b| places.planes[b.pick.0]),
                kept: kept.map(|(a, b)| (places.features[a.0], places.features[b.0])),
            };
            let inputs = places.all(inputs);
            Operation::Gate(GateOp::new(&inputs, weight, *bias, *kernel, targets))
        }
        Spec::Garf {
            x,
            hidden,
            trust,
            atoms,
            side,
            filters,
            coefficients,
            mix,
            output,
        } => {
            let x = places.features[x.0];
            let weights = GarfWeights {
                coefficients: (&coefficients.0, &coefficients.1),
                mix: (&mix.0, &mix.1),
                filters: *filters,
            };
            let finish = Finish {
                out: places.features[output.0],
                store: Store::Direct,
                gain: Gain::Doubt {
                    plane: places.planes[trust.0],
                    width: x.size.width,
                },
                residual: Some(x),
                activation: Activation::None,
            };
            let taps = Taps::new(atoms, *side);
            let hidden = places.features[hidden.0];
            let op = GarfOp::new::<S>(x, hidden, &taps, &weights, finish);
            Operation::Garf(Box::new(op))
        }
    }
}

/// The operations of `pass`; each waits if it touches what one since the last wait wrote, or
/// writes what one read.
fn turns(builder: &Builder, places: &Places, pass: usize) -> Vec<(usize, bool)> {
    let mut turns = Vec::new();
    let mut read: Vec<Range<usize>> = Vec::new();
    let mut written: Vec<Range<usize>> = Vec::new();
    let chosen = |(_, op): &(usize, &Described)| op.passes.has(pass);
    for (operation, Described { spec, .. }) in builder.operations.iter().enumerate().filter(chosen)
    {
        let reads: Vec<_> = spec
            .reads()
            .iter()
            .map(|(b, _)| places.range(*b).clone())
            .collect();
        let writes: Vec<_> = spec
            .writes()
            .iter()
            .map(|b| places.range(*b).clone())
            .collect();
        let waits = meet(&reads, &written) || meet(&writes, &written) || meet(&writes, &read);
        if waits {
            read.clear();
            written.clear();
        }
        read.extend(reads);
        written.extend(writes);
        turns.push((operation, waits));
    }
    turns
}

fn meet(a: &[Range<usize>], b: &[Range<usize>]) -> bool {
    a.iter()
        .any(|a| b.iter().any(|b| a.start < b.end && b.start < a.end))
}

//! What every operation costs.
//!
//! Work is counted as the network defines it, not as the kernels pad it, so that a time beside it
//! says how far a layer is from the machine's limits.

use super::builder::{Builder, Described};
use super::profile::OpProfile;
use crate::garf::Taps;
use crate::spec::{Emit, Feature, Output, Spec};

/// The profiles of all operations, without times; `number` is the bytes of a stored one.
pub(super) fn costs(builder: &Builder, number: usize) -> Vec<OpProfile> {
    let cost = |op: &Described| cost(builder, op, number);
    builder.operations.iter().map(cost).collect()
}

/// Work of one operation, in numbers still to be widened.
struct Work {
    kind: String,
    /// What it computes.
    at: Feature,
    /// Divides the side of `at` where a store enlarges it.
    scale: usize,
    /// Per pixel.
    macs: usize,
    weights: usize,
    /// Bytes beside those of the features.
    others: usize,
}

fn cost(builder: &Builder, described: &Described, number: usize) -> OpProfile {
    let spec = &described.spec;
    let work = work(builder, spec);
    let numbers = |f: &Feature| {
        let feature = builder.features[f.0];
        feature.channels * feature.size.area()
    };
    let size = builder.features[work.at.0].size;
    let size = [size.height / work.scale, size.width / work.scale];
    let moved: usize = features(spec).iter().map(numbers).sum();
    OpProfile {
        name: described.label.clone(),
        kind: work.kind,
        pass: 0,
        size,
        macs: (size[0] * size[1] * work.macs) as u64,
        feature_bytes: (moved * number + work.others) as u64,
        weight_bytes: (work.weights * number) as u64,
        seconds: 0.0,
    }
}

/// The features read and written.
fn features(spec: &Spec) -> Vec<Feature> {
    match spec {
        Spec::Take { to, .. } => vec![*to],
        Spec::Give { from, .. } => vec![*from],
        Spec::Conv {
            inputs,
            gain,
            residual,
            output,
            ..
        } => {
            let others = gain.iter().chain(residual).chain([output]);
            inputs.iter().chain(others).copied().collect()
        }
        Spec::Gate { inputs, kept, .. } => {
            let kept = kept.iter().flat_map(|(_, to)| [to]);
            inputs.iter().chain(kept).copied().collect()
        }
        Spec::Garf {
            x, hidden, output, ..
        } => vec![*x, *hidden, *output],
    }
}

fn work(builder: &Builder, spec: &Spec) -> Work {
    let float = size_of::<f32>();
    let channels = |f: &Feature| builder.features[f.0].channels;
    let area = |f: &Feature| builder.features[f.0].size.area();
    let sum = |inputs: &[Feature]| -> usize { inputs.iter().map(channels).sum() };
    match spec {
        Spec::Take { intake, to, .. } => Work {
            kind: format!("take {}", channels(to)),
            at: *to,
            scale: 1,
            macs: 0,
            weights: 0,
            others: intake.planes(channels(to)) * area(to) * float,
        },
        Spec::Give { from, .. } => Work {
            kind: format!("give {}", channels(from)),
            at: *from,
            scale: 1,
            macs: 0,
            weights: 0,
            others: channels(from) * area(from) * float,
        },
        Spec::Conv {
            inputs,
            weight,
            kernel,
            stride,
            store,
            output,
            ..
        } => {
            let inputs = sum(inputs);
            let outputs = weight.len() / (inputs * kernel * kernel);
            let halving = if *stride == 1 { "" } else { "/2" };
            Work {
                kind: format!("conv {kernel}x{kernel}{halving} {inputs}-{outputs}"),
                at: *output,
                scale: store.scale(),
                macs: weight.len(),
                weights: weight.len(),
                others: 0,
            }
        }
        Spec::Gate {
            inputs,
            weight,
            kernel,
            plane,
            output,
            ..
        } => Work {
            kind: format!("gate {kernel}x{kernel} {}-1", sum(inputs)),
            at: inputs[0],
            scale: 1,
            macs: weight.len(),
            weights: weight.len(),
            others: (usize::from(plane.is_some()) + emitted(output)) * area(&inputs[0]) * float,
        },
        Spec::Garf {
            x,
            atoms,
            side,
            filters,
            coefficients,
            mix,
            ..
        } => {
            let taps = Taps::new(atoms, *side);
            let kernels = filters * taps.atom_count * taps.offsets.len();
            let windows = filters * channels(x) * taps.offsets.len();
            let dense = coefficients.0.len() + mix.0.len();
            Work {
                kind: format!("garf {side}x{side} {}x{filters}", channels(x)),
                at: *x,
                scale: 1,
                macs: dense + kernels + windows,
                weights: dense + taps.atoms.len(),
                others: area(x) * float,
            }
        }
    }
}

/// Planes of the caller's that a gate's output reads and writes.
fn emitted(output: &Option<(Output, Emit)>) -> usize {
    match output {
        None => 0,
        Some((_, Emit::Scaled(_))) => 1,
        Some((_, Emit::Factor { between, .. })) => 2 + 3 * usize::from(between.is_some()),
    }
}

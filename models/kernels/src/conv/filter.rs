//! Weights of a convolution in the order its kernel reads them.

use crate::element::{Element, Product};
use crate::memory::Memory;
use crate::simd::LANES;

/// Channels in the lanes of one block: lane l holds channel `self[l]`.
pub(crate) type Lanes = Vec<usize>;

/// Consecutive channels, block by block, for each of several features in turn.
pub(crate) fn consecutive(features: impl IntoIterator<Item = usize>) -> Vec<Lanes> {
    let mut first = 0;
    let mut blocks = Vec::new();
    for channels in features {
        let all: Vec<usize> = (first..first + channels).collect();
        blocks.extend(all.chunks(LANES).map(<[usize]>::to_vec));
        first += channels;
    }
    blocks
}

/// Blocks of the four phases of a pixel shuffle in turn: lane o of phase q is channel `4 o + q`.
pub(crate) fn shuffled(channels: usize) -> Vec<Lanes> {
    (0..4)
        .flat_map(|phase| {
            let all: Vec<usize> = (0..channels).map(|o| 4 * o + phase).collect();
            all.chunks(LANES).map(<[usize]>::to_vec).collect::<Vec<_>>()
        })
        .collect()
}

/// Output blocks computed together.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Group {
    pub(crate) first: usize,
    pub(crate) count: usize,
    /// Where its weights start, in stored numbers.
    pub(crate) offset: usize,
}

/// Weights `[group][input block][ky][kx][step][block of group][outputs x step]`, and biases
/// `[variant][output block][16]`; both padded with zeros.
pub(crate) struct Filter {
    weights: Memory,
    bias: Memory,
    pub(crate) groups: Vec<Group>,
    out_blocks: usize,
    variants: usize,
}

/// A convolution's weights as the network has them, `[outputs, inputs, kernel, kernel]`.
#[derive(Clone, Copy)]
pub(crate) struct Dense<'a> {
    pub(crate) weight: &'a [f32],
    pub(crate) inputs: usize,
    pub(crate) kernel: usize,
}

impl Dense<'_> {
    fn at(&self, output: usize, input: usize, tap: usize) -> f32 {
        self.weight[(output * self.inputs + input) * self.kernel * self.kernel + tap]
    }
}

impl Filter {
    /// `bias` holds one value per output channel, once per variant.
    pub(crate) fn pack<E: Element, P: Product<T = E::T>>(
        dense: Dense<'_>,
        bias: &[f32],
        inputs: &[Lanes],
        outputs: &[Lanes],
        group_sizes: &[usize],
    ) -> Self {
        let mut values: Vec<E::T> = Vec::new();
        let mut groups = Vec::new();
        let mut first = 0;
        for &count in group_sizes {
            let offset = values.len();
            groups.push(Group {
                first,
                count,
                offset,
            });
            let outputs = &outputs[first..first + count];
            for lanes in inputs {
                for tap in 0..dense.kernel * dense.kernel {
                    for step in lanes.chunks(P::STEP) {
                        for output in outputs {
                            pack_step::<E, P>(dense, step, output, tap, &mut values);
                        }
                    }
                }
            }
            first += count;
        }
        let channels: usize = outputs.iter().map(Vec::len).sum();
        let mut biases = Vec::new();
        for bias in bias.chunks(channels) {
            for lanes in outputs {
                biases.extend((0..LANES).map(|l| lanes.get(l).map_or(0.0, |&o| bias[o])));
            }
        }
        Self {
            weights: Memory::from_values(&values),
            bias: Memory::from_values(&biases),
            groups,
            out_blocks: outputs.len(),
            variants: bias.len() / channels,
        }
    }

    /// The first weight of `group`.
    pub(crate) fn weights<P: Product>(&self, group: &Group) -> *const P::T {
        self.weights
            .as_ptr()
            .cast::<P::T>()
            .wrapping_add(group.offset)
    }

    /// The first bias of `group` in `variant`; a filter with one set of biases has it in all.
    pub(crate) fn bias(&self, group: &Group, variant: usize) -> *const f32 {
        let variant = if self.variants == 1 { 0 } else { variant };
        let blocks = variant * self.out_blocks + group.first;
        self.bias
            .as_ptr()
            .cast::<f32>()
            .wrapping_add(blocks * LANES)
    }

    pub(crate) fn weight_bytes(&self) -> usize {
        self.weights.len()
    }
}

/// One multiplication's outputs by one step of inputs, a step's inputs beside each other.
fn pack_step<E: Element, P: Product<T = E::T>>(
    dense: Dense<'_>,
    step: &[usize],
    outputs: &[usize],
    tap: usize,
    values: &mut Vec<E::T>,
) {
    for lane in 0..P::OUTPUTS {
        for input in 0..P::STEP {
            let value = match (outputs.get(lane), step.get(input)) {
                (Some(&output), Some(&input)) => dense.at(output, input, tap),
                _ => 0.0,
            };
            values.push(E::from_f32(value));
        }
    }
}

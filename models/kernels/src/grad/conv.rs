//! Convolution with bias, residual and activation, and its gradients.
//!
//! Pictures are cut into stretches of rows, which are units of work on rayon's pool. How they are
//! cut, and the order in which their weight gradients are added, depends on sizes alone: results
//! do not depend on the number of threads.

use super::geometry::{Geometry, GradPhase, Stretch};
use super::rows::{activate, unactivate};
use super::sums::{Products, WeightedSums, pack, sums_row};
use super::work::{Fresh, each, run, with_scratch};
use crate::activation::Activation;
use crate::isa::Isa;
use crate::simd::{Kernel, LANES, Simd};

/// Operands of a convolution on plain planes.
#[derive(Debug, Clone, Copy)]
pub struct PlaneConv<'a> {
    /// Sizes.
    pub geometry: Geometry,
    /// What enters, one or more sources whose channels follow one another: values
    /// `[B, channels, H, W]` and the number of channels.
    pub sources: &'a [(&'a [f32], usize)],
    /// `[O, I, k, k]`.
    pub weight: &'a [f32],
    /// `[O]`; none is zero.
    pub bias: Option<&'a [f32]>,
    /// Added before the activation, shaped as the output.
    pub residual: Option<&'a [f32]>,
    /// Applied last.
    pub activation: Activation,
    /// Instructions to use.
    pub isa: Isa,
}

/// Which gradients are asked for.
#[derive(Debug, Clone, Copy)]
pub struct Wanted {
    /// Of the sources.
    pub sources: bool,
    /// Of the weight, and of the bias with it.
    pub weight: bool,
    /// Of the residual.
    pub residual: bool,
}

/// Gradients of a convolution's operands; empty where not asked for.
#[derive(Debug, Default)]
pub struct ConvGrads {
    /// One per source, shaped as it is.
    pub sources: Vec<Vec<f32>>,
    /// `[O, I, k, k]`.
    pub weight: Vec<f32>,
    /// `[O]`.
    pub bias: Vec<f32>,
    /// Shaped as the output.
    pub residual: Vec<f32>,
}

impl PlaneConv<'_> {
    /// # Panics
    /// If an operand's length is not what the sizes say.
    fn check(&self) {
        let g = &self.geometry;
        g.check();
        let plane = g.height * g.width;
        let channels: usize = self.sources.iter().map(|(_, channels)| channels).sum();
        assert_eq!(channels, g.inputs, "channels of all sources");
        for (values, channels) in self.sources {
            assert_eq!(values.len(), g.batch * channels * plane, "a source");
        }
        assert_eq!(self.weight.len(), g.outputs * g.taps(), "weights");
        assert!(self.bias.is_none_or(|bias| bias.len() == g.outputs), "bias");
        let out = g.batch * g.out_len();
        assert!(self.residual.is_none_or(|r| r.len() == out), "residual");
    }

    /// Source and channel in it of each input.
    fn channels(&self) -> impl Iterator<Item = (usize, usize)> {
        let counts = self.sources.iter().map(|(_, channels)| *channels);
        counts
            .enumerate()
            .flat_map(|(source, channels)| (0..channels).map(move |channel| (source, channel)))
    }

    /// Copies what a stretch sees, all inputs, to `to`.
    #[inline(always)]
    fn copy_inputs(&self, stretch: Stretch, to: &mut [f32]) {
        let g = &self.geometry;
        let plane = g.height * g.width;
        let (channels, slack) = to.split_at_mut(g.inputs * g.channel_len());
        slack.fill(0.0);
        let places = channels.chunks_exact_mut(g.channel_len());
        for ((source, channel), to) in self.channels().zip(places) {
            let (values, count) = self.sources[source];
            let values = &values[(stretch.picture * count + channel) * plane..][..plane];
            g.copy_input(stretch.first, values, to);
        }
    }

    /// `[B, O, H/stride, W/stride]`, rounded up.
    ///
    /// # Panics
    /// If an operand's length is not what the sizes say, or the processor lacks the instructions.
    pub fn forward(&self) -> Vec<f32> {
        self.check();
        let g = &self.geometry;
        let (offsets, weights) = (g.tap_offsets(), pack(self.weight, g.outputs));
        let out = Fresh::new(g.batch * g.out_len());
        let stretches = g.stretches();
        each(stretches.len(), |i| {
            with_scratch(Forward::scratch_len(g), |scratch| {
                let unit = Forward {
                    conv: self,
                    offsets: &offsets,
                    weights: &weights,
                    stretch: stretches[i],
                    out: &out,
                    scratch,
                };
                run(self.isa, unit);
            });
        });
        // SAFETY: the stretches cover every row of every output.
        unsafe { out.into_values() }
    }

    /// Gradients from that of the output, `grad`, and the output itself, `out`.
    ///
    /// # Panics
    /// As [`Self::forward`].
    pub fn backward(&self, out: &[f32], grad: &[f32], wanted: Wanted) -> ConvGrads {
        self.check();
        let g = &self.geometry;
        assert!(out.len() == g.batch * g.out_len() && grad.len() == out.len());
        let plane = g.height * g.width;
        let fresh = |len: usize, wanted: bool| Fresh::new(if wanted { len } else { 0 });
        let sources: Vec<Fresh> = self
            .sources
            .iter()
            .map(|(_, channels)| fresh(g.batch * channels * plane, wanted.sources))
            .collect();
        let residual = fresh(out.len(), wanted.residual);
        let phases = g.grad_phases();
        let shared = Shared {
            conv: self,
            out,
            grad,
            wanted,
            offsets: g.tap_offsets(),
            weights: phases.iter().map(|phase| self.turned(phase)).collect(),
            phases,
            sources,
            residual,
        };
        let stretches = g.stretches();
        let parts = each(stretches.len(), |i| {
            let mut part = if wanted.weight {
                vec![0.0; g.outputs * (g.taps() + 1)]
            } else {
                Vec::new()
            };
            with_scratch(Backward::scratch_len(g, wanted), |scratch| {
                let unit = Backward {
                    shared: &shared,
                    stretch: stretches[i],
                    part: &mut part,
                    scratch,
                };
                run(self.isa, unit);
            });
            part
        });
        let mut grads = ConvGrads::default();
        if wanted.weight {
            grads.weight = sum(parts);
            grads.bias = grads.weight.split_off(g.outputs * g.taps());
        }
        // SAFETY: the stretches cover every row of what is wanted; the rest is empty.
        unsafe {
            if wanted.sources {
                let sources = shared.sources.into_iter();
                grads.sources = sources.map(|fresh| fresh.into_values()).collect();
            }
            grads.residual = shared.residual.into_values();
        }
        grads
    }

    /// The weights that make a part of the input gradient, packed: per input, per output and tap.
    fn turned(&self, phase: &GradPhase) -> Vec<f32> {
        let Geometry {
            inputs,
            outputs,
            kernel,
            ..
        } = self.geometry;
        let mut turned = Vec::with_capacity(inputs * outputs * phase.taps.len());
        for input in 0..inputs {
            for output in 0..outputs {
                let window = &self.weight[(output * inputs + input) * kernel * kernel..];
                turned.extend(phase.taps.iter().map(|(ky, kx)| window[ky * kernel + kx]));
            }
        }
        pack(&turned, inputs)
    }
}

/// Adds parts up in order.
fn sum(parts: Vec<Vec<f32>>) -> Vec<f32> {
    let mut parts = parts.into_iter();
    let mut total = parts.next().unwrap_or_default();
    for part in parts {
        for (total, part) in total.iter_mut().zip(part) {
            *total += part;
        }
    }
    total
}

struct Forward<'a> {
    conv: &'a PlaneConv<'a>,
    offsets: &'a [usize],
    weights: &'a [f32],
    stretch: Stretch,
    out: &'a Fresh,
    scratch: &'a mut [f32],
}

impl Kernel for Forward<'_> {
    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let Self {
            conv,
            stretch,
            offsets,
            weights,
            out,
            scratch,
        } = self;
        let g = &conv.geometry;
        let (source, sums) = scratch.split_at_mut(seen_len(g));
        conv.copy_inputs(stretch, source);
        let product = WeightedSums {
            source,
            offsets,
            weights,
            outputs: g.outputs,
            len: g.span(stretch.count),
        };
        // SAFETY: the caller vouches for the instructions.
        unsafe {
            product.run::<S>(sums);
            conv.finish::<S>(stretch, sums, out);
        }
    }
}

impl Forward<'_> {
    fn scratch_len(g: &Geometry) -> usize {
        seen_len(g) + g.outputs * sums_row(g.span(g.stretch_rows()))
    }
}

/// Room for what a stretch sees, with a vector to read beyond it.
fn seen_len(g: &Geometry) -> usize {
    g.inputs * g.channel_len() + LANES
}

impl PlaneConv<'_> {
    /// Adds bias and residual, applies the activation and puts the rows where they belong.
    ///
    /// # Safety
    /// The processor has the instructions of `S`.
    #[inline(always)]
    unsafe fn finish<S: Simd>(&self, stretch: Stretch, sums: &[f32], to: &Fresh) {
        let g = &self.geometry;
        let (height, width) = (g.out_height(), g.out_width());
        let channels = sums.chunks_exact(sums_row(g.span(stretch.count)));
        for (output, sums) in channels.enumerate().take(g.outputs) {
            let plane = (stretch.picture * g.outputs + output) * height * width;
            let start = plane + stretch.first * width;
            let bias = self.bias.map_or(0.0, |bias| bias[output]);
            // SAFETY: these rows of this output are the stretch's alone; they are written first.
            unsafe {
                let out = to.part(start, stretch.count * width);
                for (out, sums) in out.chunks_exact_mut(width).zip(sums.chunks(g.row())) {
                    out.copy_from_slice(&sums[..width]);
                }
                if let Some(residual) = self.residual {
                    let residual = &residual[start..][..out.len()];
                    for (out, residual) in out.iter_mut().zip(residual) {
                        *out += bias + residual;
                    }
                } else if self.bias.is_some() {
                    out.iter_mut().for_each(|out| *out += bias);
                }
                activate::<S>(self.activation, out);
            }
        }
    }
}

/// What all units of a backward pass share.
struct Shared<'a> {
    conv: &'a PlaneConv<'a>,
    out: &'a [f32],
    grad: &'a [f32],
    wanted: Wanted,
    offsets: Vec<usize>,
    phases: Vec<GradPhase>,
    /// Per phase.
    weights: Vec<Vec<f32>>,
    sources: Vec<Fresh>,
    residual: Fresh,
}

struct Backward<'a> {
    shared: &'a Shared<'a>,
    stretch: Stretch,
    /// Weight gradients, then bias gradients, of this stretch.
    part: &'a mut [f32],
    scratch: &'a mut [f32],
}

impl Backward<'_> {
    fn scratch_len(g: &Geometry, wanted: Wanted) -> usize {
        let seen = if wanted.weight { seen_len(g) } else { 0 };
        let rows = (g.stretch_rows() + 1) * g.row();
        let summed = if wanted.sources {
            g.inputs * sums_row(rows)
        } else {
            0
        };
        inner_len(g) + seen + summed
    }
}

/// Room for the gradient before the activation, with a vector to read beyond it.
fn inner_len(g: &Geometry) -> usize {
    g.outputs * g.grad_len() + LANES
}

impl Kernel for Backward<'_> {
    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let Self {
            shared,
            stretch,
            part,
            scratch,
        } = self;
        let (g, wanted) = (&shared.conv.geometry, shared.wanted);
        let seen = if wanted.weight { seen_len(g) } else { 0 };
        let (inner, rest) = scratch.split_at_mut(inner_len(g));
        let (source, sums) = rest.split_at_mut(seen);
        shared.copy_grads(stretch, inner);
        if wanted.residual {
            shared.give_residual(stretch, inner);
        }
        // SAFETY: the caller vouches for the instructions.
        unsafe {
            if wanted.weight {
                shared.conv.copy_inputs(stretch, source);
                shared.weight_grads::<S>(stretch, inner, source, part);
            }
            if wanted.sources {
                for (phase, weights) in shared.phases.iter().zip(&shared.weights) {
                    shared.source_grads::<S>(stretch, phase, weights, inner, sums);
                }
            }
        }
    }
}

impl Shared<'_> {
    /// Copies the gradient before the activation, with the rows around the stretch.
    #[inline(always)]
    fn copy_grads(&self, stretch: Stretch, to: &mut [f32]) {
        let g = &self.conv.geometry;
        let (height, width, reach) = (g.out_height(), g.out_width(), g.reach());
        let (channels, slack) = to.split_at_mut(g.outputs * g.grad_len());
        slack.fill(0.0);
        for (output, to) in channels.chunks_exact_mut(g.grad_len()).enumerate() {
            let plane = (stretch.picture * g.outputs + output) * height * width;
            let (before, rows) = to.split_at_mut(reach);
            before.fill(0.0);
            for (i, to) in rows.chunks_exact_mut(g.row()).enumerate() {
                let y = (stretch.first + i).checked_sub(reach);
                match y.filter(|y| *y < height) {
                    None => to.fill(0.0),
                    Some(y) => {
                        let (to, right) = to.split_at_mut(width);
                        let row = plane + y * width..plane + (y + 1) * width;
                        let (out, grad) = (&self.out[row.clone()], &self.grad[row]);
                        unactivate(self.conv.activation, out, grad, to);
                        right.fill(0.0);
                    }
                }
            }
        }
    }

    #[inline(always)]
    fn give_residual(&self, stretch: Stretch, inner: &[f32]) {
        let g = &self.conv.geometry;
        let (height, width) = (g.out_height(), g.out_width());
        for (output, inner) in inner.chunks_exact(g.grad_len()).enumerate().take(g.outputs) {
            let plane = (stretch.picture * g.outputs + output) * height * width;
            let start = plane + stretch.first * width;
            // SAFETY: these rows of this output are the stretch's alone, and only written.
            let out = unsafe { self.residual.part(start, stretch.count * width) };
            let rows = inner[g.grad_origin()..].chunks(g.row());
            for (out, inner) in out.chunks_exact_mut(width).zip(rows) {
                out.copy_from_slice(&inner[..width]);
            }
        }
    }

    /// # Safety
    /// The processor has the instructions of `S`.
    #[inline(always)]
    unsafe fn weight_grads<S: Simd>(
        &self,
        stretch: Stretch,
        inner: &[f32],
        source: &[f32],
        part: &mut [f32],
    ) {
        let g = &self.conv.geometry;
        let len = g.span(stretch.count);
        let (weights, bias) = part.split_at_mut(g.outputs * g.taps());
        let products = Products {
            source,
            offsets: &self.offsets,
            grad: &inner[g.grad_origin()..],
            grad_row: g.grad_len(),
            outputs: g.outputs,
            len,
        };
        // SAFETY: passed on from the caller.
        unsafe { products.run::<S>(weights) };
        for (bias, inner) in bias.iter_mut().zip(inner.chunks_exact(g.grad_len())) {
            let inner = &inner[g.grad_origin()..][..len];
            let mut lanes = [0f32; LANES];
            let blocks = inner.chunks_exact(LANES);
            let rest: f32 = blocks.remainder().iter().sum();
            for block in blocks {
                for (lane, x) in lanes.iter_mut().zip(block) {
                    *lane += x;
                }
            }
            *bias = lanes.iter().sum::<f32>() + rest;
        }
    }

    /// # Safety
    /// The processor has the instructions of `S`.
    #[inline(always)]
    unsafe fn source_grads<S: Simd>(
        &self,
        stretch: Stretch,
        phase: &GradPhase,
        weights: &[f32],
        inner: &[f32],
        sums: &mut [f32],
    ) {
        let g = &self.conv.geometry;
        let (stride, plane) = (g.stride, g.height * g.width);
        let top = stride * stretch.first + phase.row;
        let bottom = (stride * (stretch.first + stretch.count)).min(g.height);
        let rows = bottom.saturating_sub(top).div_ceil(stride);
        if rows == 0 || phase.columns == 0 {
            return;
        }
        let len = (rows - 1) * g.row() + phase.columns;
        let sum = WeightedSums {
            source: inner,
            offsets: &phase.offsets,
            weights,
            outputs: g.inputs,
            len,
        };
        // SAFETY: passed on from the caller.
        unsafe { sum.run::<S>(sums) };
        let channels = self.conv.channels();
        for ((source, channel), sums) in channels.zip(sums.chunks_exact(sums_row(len))) {
            let count = self.conv.sources[source].1;
            let start = (stretch.picture * count + channel) * plane;
            for (i, sums) in sums.chunks(g.row()).take(rows).enumerate() {
                let y = top + i * stride;
                // SAFETY: the row is the stretch's alone, of which each phase writes its columns
                // and reads none.
                let to = unsafe { self.sources[source].part(start + y * g.width, g.width) };
                if stride == 1 {
                    to.copy_from_slice(&sums[..g.width]);
                } else {
                    let to = to[phase.column..].iter_mut().step_by(2);
                    to.zip(sums).for_each(|(to, sum)| *to = *sum);
                }
            }
        }
    }
}

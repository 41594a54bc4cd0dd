//! Convolution to a single channel and a logistic function: confidence planes and depth.
//!
//! With one output the lanes hold input channels; they are summed at the end of each pixel.
//! Weights keep single precision whatever the features are stored as.

use std::ops::Range;

use crate::activation::{bounded, power, sigmoid};
use crate::conv::{InBlock, LINE, TILE_SUMS, consecutive, in_blocks};
use crate::element::Element;
use crate::layout::{Frame, Place};
use crate::memory::Memory;
use crate::simd::{Kernel, LANES, Simd};
use crate::spec::Emit;

/// Pixels summed at once: as many as there are lanes for their results.
const STRIP: usize = LANES;

/// A gate ready to run: `c = sigmoid(conv(inputs))`.
pub(crate) struct GateOp<E: Element> {
    inputs: Vec<InBlock>,
    kernel: usize,
    /// `[block][ky][kx][part][pixel of a step][16]`: parts that add up to the weight, once for
    /// every pixel a multiplication takes.
    weights: Memory,
    bias: f32,
    width: usize,
    pub(crate) height: usize,
    /// Where `c` goes within the arena, in single-precision numbers; rows without padding.
    plane: Option<usize>,
    /// The caller's slice, and what it receives.
    output: Option<(usize, Emit)>,
    /// The plane that says where between its limits a factor's base lies.
    pick: Option<usize>,
    /// `(from, to)`: `to = c * from`, channel by channel.
    kept: Option<(Place, Place)>,
    format: std::marker::PhantomData<E>,
}

/// What a gate does with its plane.
pub(crate) struct GateTargets {
    pub(crate) plane: Option<usize>,
    pub(crate) output: Option<(usize, Emit)>,
    pub(crate) pick: Option<usize>,
    pub(crate) kept: Option<(Place, Place)>,
}

impl<E: Element> GateOp<E> {
    /// `weight` is `[1, I, kernel, kernel]`.
    pub(crate) fn new(
        inputs: &[Place],
        weight: &[f32],
        bias: f32,
        kernel: usize,
        targets: GateTargets,
    ) -> Self {
        let taps = kernel * kernel;
        let mut packed: Vec<E::T> = Vec::new();
        for lanes in consecutive(inputs.iter().map(|place| place.channels)) {
            for tap in 0..taps {
                let value = |l: usize| lanes.get(l).map_or(0.0, |&c| weight[c * taps + tap]);
                let mut rest: [f32; LANES] = std::array::from_fn(value);
                for _ in 0..E::PARTS {
                    let part = rest.map(E::from_f32);
                    for (rest, part) in rest.iter_mut().zip(part) {
                        *rest -= E::to_f32(part);
                    }
                    packed.extend(std::iter::repeat_n(part, E::STEP).flatten());
                }
            }
        }
        let size = inputs[0].size;
        Self {
            inputs: in_blocks::<E>(inputs),
            kernel,
            weights: Memory::from_values(&packed),
            bias,
            width: size.width,
            height: size.height,
            plane: targets.plane,
            output: targets.output,
            pick: targets.pick,
            kept: targets.kept,
            format: std::marker::PhantomData,
        }
    }

    pub(crate) fn weight_bytes(&self) -> usize {
        self.weights.len()
    }

    /// Working memory per thread, in bytes: one row, whole vectors.
    pub(crate) fn scratch_bytes(&self) -> usize {
        self.width.next_multiple_of(LANES) * size_of::<f32>()
    }

    /// # Safety
    /// As for a convolution; `frame.scratch` has the room asked for.
    pub(crate) unsafe fn run<S: Simd>(&self, frame: &Frame, rows: Range<usize>) {
        let kernel = GateRows {
            op: self,
            frame,
            rows,
        };
        // SAFETY: passed on from the caller.
        unsafe { S::vectorize(kernel) }
    }

    /// Where the windows of the pixel at `y`, `x` begin in `block`.
    #[inline(always)]
    fn corner(&self, block: &InBlock, y: usize, x: usize) -> usize {
        let reach = self.kernel / 2;
        block.origin + y * block.row + x * LANES - reach * block.row - reach * LANES
    }

    /// Sums of a strip of pixels from column `x` of row `y`, pixel by pixel in the lanes.
    ///
    /// # Safety
    /// As for `run`; the pixels lie within the row.
    #[inline(always)]
    unsafe fn strip<S: Simd>(&self, frame: &Frame, y: usize, x: usize) -> S::V {
        // SAFETY: passed on from the caller.
        unsafe {
            let mut sums = [S::splat(0.0); LANES];
            for first in (0..STRIP / E::STEP).step_by(4) {
                if S::SUMS >= TILE_SUMS {
                    break;
                }
                self.pixels::<S, 4>(frame, y, x, first, &mut sums);
            }
            if S::SUMS >= TILE_SUMS && E::STEP == 1 {
                self.pixels::<S, STRIP>(frame, y, x, 0, &mut sums);
            }
            if S::SUMS >= TILE_SUMS && E::STEP == 2 {
                self.pixels::<S, { STRIP / 2 }>(frame, y, x, 0, &mut sums);
            }
            S::add(E::gather::<S>(&sums), S::splat(self.bias))
        }
    }

    /// Fills `N` sums from the `first`, each of as many pixels as a multiplication takes.
    ///
    /// # Safety
    /// As for `run`; the pixels lie within the row.
    #[inline(always)]
    unsafe fn pixels<S: Simd, const N: usize>(
        &self,
        frame: &Frame,
        y: usize,
        x: usize,
        first: usize,
        to: &mut [S::V; LANES],
    ) {
        let numbers = LANES * E::STEP;
        // SAFETY: the halo covers the windows; the weights are as many as blocks and taps.
        unsafe {
            let base = frame.arena.cast::<E::T>().cast_const();
            let mut weights = self.weights.as_ptr().cast::<E::T>();
            let mut sums = [S::splat(0.0); N];
            for block in &self.inputs {
                let corner = base.add(self.corner(block, y, x + first * E::STEP));
                let below = corner.wrapping_add(self.kernel * block.row);
                for at in (0..N * numbers).step_by(LINE / size_of::<E::T>()) {
                    S::expect_read(below.wrapping_add(at).cast());
                }
                for ky in 0..self.kernel {
                    for kx in 0..self.kernel {
                        let input = corner.add(ky * block.row + kx * LANES);
                        for _ in 0..E::PARTS {
                            let w = E::weights::<S>(weights);
                            weights = weights.add(numbers);
                            for (index, sum) in sums.iter_mut().enumerate() {
                                let x = E::weights::<S>(input.add(index * numbers));
                                *sum = E::mul_add::<S>(x, w, *sum);
                            }
                        }
                    }
                }
            }
            to[first..first + N].copy_from_slice(&sums);
        }
    }

    /// Writes row `y` of the caller's slice from the sums in `row`, whose padding is zero.
    ///
    /// # Safety
    /// As for `run`; the emission is a factor.
    #[inline(always)]
    unsafe fn emit_factor<S: Simd>(&self, frame: &Frame, row: *mut f32, slot: usize, y: usize) {
        let width = self.width;
        let Some((
            _,
            Emit::Factor {
                base,
                span,
                between,
            },
        )) = self.output
        else {
            return;
        };
        // SAFETY: the caller's slices and the plane hold all rows; `row` is padded to vectors.
        unsafe {
            for x in (0..width).step_by(LANES) {
                S::store(row.add(x), bounded::<S>(S::load(row.add(x)), span));
            }
            if let (Some(between), Some(pick)) = (between, self.pick) {
                let pick = frame.arena.cast::<f32>().add(pick + y * width);
                let drop = frame.inputs[between.drop.0].add(y * width);
                let rise = frame.inputs[between.rise.0].add(y * width);
                for x in 0..width {
                    let t = 2.0 * *pick.add(x) - 1.0;
                    let limit = if t > 0.0 { *rise.add(x) } else { *drop.add(x) };
                    *row.add(x) += t * limit;
                }
            }
            for x in (0..width).step_by(LANES) {
                S::store(row.add(x), power::<S>(S::load(row.add(x))));
            }
            let base = frame.inputs[base.0].add(y * width);
            let to = frame.outputs[slot].add(y * width);
            for x in 0..width {
                to.add(x).write(*row.add(x) * *base.add(x));
            }
        }
    }

    /// The sum of one pixel.
    ///
    /// # Safety
    /// As for `run`; the pixel lies within the row.
    #[inline(always)]
    unsafe fn pixel<S: Simd>(&self, frame: &Frame, y: usize, x: usize) -> f32 {
        // SAFETY: the halo covers the window; the weights are as many as blocks and taps.
        unsafe {
            let base = frame.arena.cast::<E::T>().cast_const();
            let mut weights = self.weights.as_ptr().cast::<E::T>();
            let mut sum = S::splat(0.0);
            for block in &self.inputs {
                let corner = base.add(self.corner(block, y, x));
                for ky in 0..self.kernel {
                    for kx in 0..self.kernel {
                        let x = E::load::<S>(corner.add(ky * block.row + kx * LANES));
                        for _ in 0..E::PARTS {
                            sum = S::mul_add(x, E::load::<S>(weights), sum);
                            weights = weights.add(LANES * E::STEP);
                        }
                    }
                }
            }
            S::sum(sum) + self.bias
        }
    }
}

struct GateRows<'a, E: Element> {
    op: &'a GateOp<E>,
    frame: &'a Frame,
    rows: Range<usize>,
}

impl<E: Element> Kernel for GateRows<'_, E> {
    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let Self { op, frame, rows } = self;
        let row = frame.scratch.cast::<f32>();
        let width = op.width;
        for y in rows.clone() {
            // SAFETY: the scratch holds a padded row; planes and the caller's slices hold all
            // rows; the features of `kept` have the gate's size.
            unsafe {
                // The last strip overlaps the one before it where the width is no multiple.
                for x in (0..width).step_by(STRIP) {
                    if width >= STRIP {
                        let x = x.min(width - STRIP);
                        S::store(row.add(x), op.strip::<S>(frame, y, x));
                    } else {
                        for x in 0..width {
                            row.add(x).write(op.pixel::<S>(frame, y, x));
                        }
                    }
                }
                for x in width..width.next_multiple_of(LANES) {
                    row.add(x).write(0.0);
                }
                if let Some((slot, Emit::Factor { .. })) = op.output {
                    op.emit_factor::<S>(frame, row, slot, y);
                    continue;
                }
                for x in (0..width).step_by(LANES) {
                    S::store(row.add(x), sigmoid::<S>(S::load(row.add(x))));
                }
                if let Some(plane) = op.plane {
                    let to = frame.arena.cast::<f32>().add(plane + y * width);
                    row.copy_to_nonoverlapping(to, width);
                }
                if let Some((from, to)) = &op.kept {
                    keep::<S, E>(frame, row, from, to, y);
                }
                if let Some((slot, Emit::Scaled(scale))) = op.output {
                    let to = frame.outputs[slot].add(y * width);
                    for x in 0..width {
                        to.add(x).write(*row.add(x) * scale);
                    }
                }
            }
        }
        if let Some((_, to)) = &op.kept {
            // SAFETY: as above.
            unsafe { to.clear_halo::<E>(frame.arena, 0..to.block_count(), rows) };
        }
    }
}

/// Scales row `y` of `from` by `row`, pixel by pixel.
///
/// # Safety
/// Both features have the width of `row` and lie in the frame's arena.
#[inline(always)]
unsafe fn keep<S: Simd, E: Element>(
    frame: &Frame,
    row: *const f32,
    from: &Place,
    to: &Place,
    y: usize,
) {
    let arena = frame.arena.cast::<E::T>();
    for block in 0..from.block_count() {
        for x in 0..from.size.width {
            // SAFETY: passed on from the caller.
            unsafe {
                let value = E::load::<S>(arena.add(from.at(block, y, x)));
                S::expect_write(arena.wrapping_add(to.at(block, y + 1, x)).cast());
                let kept = S::mul(value, S::splat(*row.add(x)));
                E::store::<S>(arena.add(to.at(block, y, x)), kept);
            }
        }
    }
}

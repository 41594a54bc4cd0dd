//! Between the caller's planes and blocked features.

use std::ops::Range;

use crate::element::Element;
use crate::layout::{Frame, Place};
use crate::simd::{Kernel, LANES, Simd};

/// How planes become channels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Intake {
    /// Channel by channel.
    Planes,
    /// One plane of depths in metres, 0 for none, becomes two channels: the depth over this
    /// range, and 1 where there is one.
    SparseDepth {
        /// In metres.
        range_m: f32,
    },
}

impl Intake {
    /// Planes that make `channels` channels.
    pub(crate) fn planes(self, channels: usize) -> usize {
        match self {
            Self::Planes => channels,
            Self::SparseDepth { .. } => 1,
        }
    }
}

/// Copies a slice `[planes, H, W]` into a feature.
pub(crate) struct TakeOp {
    pub(crate) slot: usize,
    pub(crate) intake: Intake,
    pub(crate) to: Place,
}

/// Copies a feature into a slice `[channels, H, W]`.
pub(crate) struct GiveOp {
    pub(crate) from: Place,
    pub(crate) slot: usize,
}

struct TakeRows<'a, E> {
    op: &'a TakeOp,
    frame: &'a Frame,
    rows: Range<usize>,
    format: std::marker::PhantomData<E>,
}

impl TakeOp {
    /// # Safety
    /// As for a convolution; the slot's slice is long enough.
    pub(crate) unsafe fn run<S: Simd, E: Element>(&self, frame: &Frame, rows: Range<usize>) {
        let kernel = TakeRows::<E> {
            op: self,
            frame,
            rows,
            format: std::marker::PhantomData,
        };
        // SAFETY: passed on from the caller.
        unsafe { S::vectorize(kernel) }
    }
}

impl<E: Element> Kernel for TakeRows<'_, E> {
    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let Self {
            op, frame, rows, ..
        } = self;
        let to = &op.to;
        let (width, area) = (to.size.width, to.size.area());
        // SAFETY: the slice holds all planes of the feature's size; the feature is the arena's.
        unsafe {
            let arena = frame.arena.cast::<E::T>();
            let planes = frame.inputs[op.slot];
            for y in rows.clone() {
                for block in 0..to.block_count() {
                    let out = arena.add(to.at(block, y, 0));
                    for x in 0..width {
                        E::store::<S>(out.add(x * LANES), S::splat(0.0));
                    }
                    let first = block * LANES;
                    let lanes = (to.channels - first).min(LANES);
                    for lane in 0..lanes {
                        match op.intake {
                            Intake::Planes => {
                                let from = planes.add((first + lane) * area + y * width);
                                for x in 0..width {
                                    out.add(x * LANES + lane).write(E::from_f32(*from.add(x)));
                                }
                            }
                            Intake::SparseDepth { range_m } => {
                                let from = planes.add(y * width);
                                for x in 0..width {
                                    let depth = *from.add(x);
                                    let value = if lane == 0 {
                                        depth / range_m
                                    } else {
                                        f32::from(u8::from(depth > 0.0))
                                    };
                                    out.add(x * LANES + lane).write(E::from_f32(value));
                                }
                            }
                        }
                    }
                }
            }
            to.clear_halo::<E>(frame.arena, 0..to.block_count(), rows);
        }
    }
}

impl GiveOp {
    /// # Safety
    /// As for a convolution; the slot's slice is long enough.
    pub(crate) unsafe fn run<S: Simd, E: Element>(&self, frame: &Frame, rows: Range<usize>) {
        let kernel = GiveRows::<E> {
            op: self,
            frame,
            rows,
            format: std::marker::PhantomData,
        };
        // SAFETY: passed on from the caller.
        unsafe { S::vectorize(kernel) }
    }
}

struct GiveRows<'a, E> {
    op: &'a GiveOp,
    frame: &'a Frame,
    rows: Range<usize>,
    format: std::marker::PhantomData<E>,
}

impl<E: Element> Kernel for GiveRows<'_, E> {
    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let Self {
            op, frame, rows, ..
        } = self;
        let from = &op.from;
        let (width, area) = (from.size.width, from.size.area());
        for y in rows {
            for channel in 0..from.channels {
                for x in 0..width {
                    // SAFETY: the slice holds all planes of the feature, which is the arena's.
                    unsafe {
                        let mut lanes = [0.0; LANES];
                        let at = from.at(channel / LANES, y, x);
                        let pixel = E::load::<S>(frame.arena.cast::<E::T>().add(at));
                        S::store(lanes.as_mut_ptr(), pixel);
                        let to = frame.outputs[op.slot].add(channel * area + y * width + x);
                        to.write(lanes[channel % LANES]);
                    }
                }
            }
        }
    }
}

//! What happens to a tile's sums: gain, residual, activation, and where they go.

use crate::activation::Activation;
use crate::element::Element;
use crate::layout::{Frame, Place};
use crate::simd::{LANES, Simd};

/// Where the results of one pixel are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Store {
    /// At the same pixel.
    Direct,
    /// Pixel shuffle: output channel `4 o + 2 a + b` of pixel (y, x) becomes channel o of pixel
    /// (2 y + a, 2 x + b).
    Shuffle,
    /// All channels at each of the pixels (2 y + a, 2 x + b), a and b in 0..2.
    Nearest,
}

impl Store {
    /// How much larger the stored feature is.
    pub fn scale(self) -> usize {
        if self == Self::Direct { 1 } else { 2 }
    }
}

/// A factor on the sum, before the residual is added.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Gain {
    None,
    /// Value by value.
    Feature(Place),
    /// One minus the plane's value at the pixel; offset in numbers, and width.
    Doubt {
        plane: usize,
        width: usize,
    },
}

/// Everything after the sum: `activation(sum * gain + residual)`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Finish {
    pub(crate) out: Place,
    pub(crate) store: Store,
    pub(crate) gain: Gain,
    pub(crate) residual: Option<Place>,
    pub(crate) activation: Activation,
}

/// The tile the sums are of.
#[derive(Clone, Copy)]
pub(crate) struct Spot {
    pub(crate) first_block: usize,
    pub(crate) blocks: usize,
    pub(crate) pixels: usize,
    pub(crate) y: usize,
    pub(crate) x: usize,
}

impl Finish {
    /// # Safety
    /// `sums` is `[blocks][pixels][16]`; the spot lies within the features, whose places are of
    /// the arena of `frame`; no other thread writes these pixels.
    #[inline(always)]
    pub(crate) unsafe fn run<S: Simd, E: Element>(
        &self,
        frame: &Frame,
        spot: Spot,
        sums: *const f32,
    ) {
        // One loop per activation, so that none asks which it is for every value.
        macro_rules! each {
            ($($variant:ident)*) => {
                match self.activation {
                    $(Activation::$variant => {
                        // SAFETY: passed on from the caller.
                        unsafe { self.store::<S, E>(frame, spot, sums, Activation::$variant) }
                    })*
                }
            };
        }
        each!(None Relu LeakyRelu Tanh Sigmoid);
    }

    /// # Safety
    /// As for `run`.
    #[inline(always)]
    unsafe fn store<S: Simd, E: Element>(
        &self,
        frame: &Frame,
        spot: Spot,
        sums: *const f32,
        activation: Activation,
    ) {
        let arena = frame.arena.cast::<E::T>();
        let scale = self.store.scale();
        let out_blocks = self.out.block_count();
        for index in 0..spot.blocks {
            let block = spot.first_block + index;
            let (phase, block) = match self.store {
                Store::Shuffle => (block / out_blocks, block % out_blocks),
                Store::Direct | Store::Nearest => (0, block),
            };
            let copies = if self.store == Store::Nearest { 4 } else { 1 };
            for phase in phase..phase + copies {
                let (y, x) = (spot.y * scale + phase / 2, spot.x * scale + phase % 2);
                for pixel in 0..spot.pixels {
                    let column = x + pixel * scale;
                    // SAFETY: the caller vouches for the spot, and phases stay within a doubled
                    // feature.
                    unsafe {
                        let sum = S::load(sums.add((index * spot.pixels + pixel) * LANES));
                        let mut value = self.scaled::<S, E>(frame, sum, block, y, column);
                        if let Some(residual) = &self.residual {
                            let at = arena.add(residual.at(block, y, column));
                            value = S::add(value, E::load::<S>(at));
                        }
                        let at = arena.add(self.out.at(block, y, column));
                        E::store::<S>(at, activation.apply::<S>(value));
                    }
                }
            }
        }
    }

    /// # Safety
    /// As for `run`.
    #[inline(always)]
    unsafe fn scaled<S: Simd, E: Element>(
        &self,
        frame: &Frame,
        sum: S::V,
        block: usize,
        y: usize,
        x: usize,
    ) -> S::V {
        // SAFETY: passed on from the caller.
        unsafe {
            match self.gain {
                Gain::None => sum,
                Gain::Feature(place) => {
                    let at = frame.arena.cast::<E::T>().add(place.at(block, y, x));
                    S::mul(sum, E::load::<S>(at))
                }
                Gain::Doubt { plane, width } => {
                    let trust = *frame.arena.cast::<f32>().add(plane + y * width + x);
                    S::mul(sum, S::splat(1.0 - trust))
                }
            }
        }
    }
}

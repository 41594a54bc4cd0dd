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
        let scale = self.store.scale();
        let copies = if self.store == Store::Nearest { 4 } else { 1 };
        for index in 0..spot.blocks {
            let (phase, block) = self.target(spot.first_block + index);
            for phase in phase..phase + copies {
                let strip = Strip {
                    block,
                    y: spot.y * scale + phase / 2,
                    x: spot.x * scale + phase % 2,
                    step: scale,
                    pixels: spot.pixels,
                };
                let none = Extras::<E> {
                    feature: std::ptr::null(),
                    plane: std::ptr::null(),
                    residual: std::ptr::null(),
                };
                let residual = self.residual.map(|r| r.from::<E>(frame, &strip));
                let extras = match self.gain {
                    Gain::None => none,
                    Gain::Feature(place) => Extras {
                        feature: place.from::<E>(frame, &strip),
                        ..none
                    },
                    Gain::Doubt { plane, width } => Extras {
                        plane: frame
                            .arena
                            .cast::<f32>()
                            .wrapping_add(plane + strip.y * width + strip.x)
                            .cast_const(),
                        ..none
                    },
                };
                let extras = Extras {
                    residual: residual.unwrap_or(extras.residual),
                    ..extras
                };
                // SAFETY: the caller vouches for the spot, and phases stay within a doubled
                // feature; an extra is null only where it is not asked for.
                unsafe {
                    let sums = sums.add(index * spot.pixels * LANES);
                    let out = self.out.from::<E>(frame, &strip).cast_mut();
                    macro_rules! each {
                        ($gain:expr, $residual:expr) => {
                            each::<S, E, { $gain }, $residual>(out, strip, sums, extras, activation)
                        };
                    }
                    // One loop per combination, so that none asks for every value.
                    match (self.gain, residual.is_some()) {
                        (Gain::None, false) => each!(NO_GAIN, false),
                        (Gain::None, true) => each!(NO_GAIN, true),
                        (Gain::Feature(_), false) => each!(BY_FEATURE, false),
                        (Gain::Feature(_), true) => each!(BY_FEATURE, true),
                        (Gain::Doubt { .. }, false) => each!(BY_DOUBT, false),
                        (Gain::Doubt { .. }, true) => each!(BY_DOUBT, true),
                    }
                }
            }
        }
    }

    /// Phase and block of the target that the `block`-th block of sums goes to.
    pub(crate) fn target(&self, block: usize) -> (usize, usize) {
        match self.store {
            Store::Shuffle => (
                block / self.out.block_count(),
                block % self.out.block_count(),
            ),
            Store::Direct | Store::Nearest => (0, block),
        }
    }

    /// Asks for what storing a spot will touch.
    ///
    /// # Safety
    /// As for `run`, but for the sums.
    #[inline(always)]
    pub(crate) unsafe fn expect<S: Simd, E: Element>(&self, frame: &Frame, spot: Spot) {
        let scale = self.store.scale();
        let line = LINE / size_of::<E::T>();
        let copies = if self.store == Store::Nearest { 4 } else { 1 };
        for index in 0..spot.blocks {
            let (phase, block) = self.target(spot.first_block + index);
            for phase in (phase..phase + copies).step_by(2) {
                let strip = Strip {
                    block,
                    y: spot.y * scale + phase / 2,
                    x: spot.x * scale,
                    step: 1,
                    pixels: 0,
                };
                let numbers = spot.pixels * scale * LANES;
                let out = self.out.from::<E>(frame, &strip);
                for at in (0..numbers).step_by(line) {
                    // SAFETY: an expectation may name any address.
                    unsafe { S::expect_write(out.wrapping_add(at).cast()) };
                }
                if let Some(residual) = &self.residual {
                    let from = residual.from::<E>(frame, &strip);
                    for at in (0..numbers).step_by(line) {
                        // SAFETY: as above.
                        unsafe { S::expect_read(from.wrapping_add(at).cast()) };
                    }
                }
            }
        }
    }
}

/// Bytes of a cache line.
pub(crate) const LINE: usize = 64;

/// Pixels of one block of one row, `step` columns apart.
#[derive(Clone, Copy)]
struct Strip {
    block: usize,
    y: usize,
    x: usize,
    step: usize,
    pixels: usize,
}

impl Place {
    /// The first lane of the strip's first pixel.
    #[inline(always)]
    fn from<E: Element>(&self, frame: &Frame, strip: &Strip) -> *const E::T {
        let at = self.at(strip.block, strip.y, strip.x);
        frame.arena.cast::<E::T>().wrapping_add(at)
    }
}

/// What is multiplied with or added to a strip's sums: where its first pixel lies, or null.
#[derive(Clone, Copy)]
struct Extras<E: Element> {
    feature: *const E::T,
    plane: *const f32,
    residual: *const E::T,
}

const NO_GAIN: u8 = 0;
const BY_FEATURE: u8 = 1;
const BY_DOUBT: u8 = 2;

/// Finishes and stores the sums of one strip.
///
/// # Safety
/// As for [`Finish::run`]; `out` is the strip's first pixel, and so are the extras that `GAIN`
/// and `RESIDUAL` ask for.
#[inline(always)]
unsafe fn each<S: Simd, E: Element, const GAIN: u8, const RESIDUAL: bool>(
    out: *mut E::T,
    strip: Strip,
    sums: *const f32,
    extras: Extras<E>,
    activation: Activation,
) {
    for pixel in 0..strip.pixels {
        let at = pixel * strip.step * LANES;
        // SAFETY: passed on from the caller.
        unsafe {
            let mut value = S::load(sums.add(pixel * LANES));
            if GAIN == BY_FEATURE {
                value = S::mul(value, E::load::<S>(extras.feature.add(at)));
            }
            if GAIN == BY_DOUBT {
                let trust = *extras.plane.add(pixel * strip.step);
                value = S::mul(value, S::splat(1.0 - trust));
            }
            if RESIDUAL {
                value = S::add(value, E::load::<S>(extras.residual.add(at)));
            }
            E::store::<S>(out.add(at), activation.apply::<S>(value));
        }
    }
}

//! The two number formats features and weights are stored in.

use crate::simd::{LANES, Simd, bf16_from_f32, f32_from_bf16};

/// How one multiplication takes inputs and weights.
///
/// # Safety of the functions
/// As in [`Simd`]; `weights` reads [`Product::STEP`] times [`Product::OUTPUTS`] values, `spread`
/// as many as the step.
pub(crate) trait Product: Copy + Send + Sync + 'static {
    /// One stored number.
    type T: Copy + Default + Send + Sync + 'static;
    /// One multiplication's weights, and its inputs in every lane.
    type W<S: Simd>: Copy;
    /// Input channels one multiplication takes.
    const STEP: usize;
    /// Outputs one multiplication adds to.
    const OUTPUTS: usize;

    unsafe fn weights<S: Simd>(from: *const Self::T) -> Self::W<S>;
    /// The inputs of pixel `PIXEL` of a strip whose pixels lie `STRIDE` apart, `from` its first.
    unsafe fn spread<S: Simd, const PIXEL: usize, const STRIDE: usize>(
        from: *const Self::T,
    ) -> Self::W<S>;
    unsafe fn mul_add<S: Simd>(x: Self::W<S>, w: Self::W<S>, sum: S::V) -> S::V;
    /// The outputs, lane by lane, from what the multiplications added up.
    unsafe fn close<S: Simd>(sum: S::V) -> S::V;
}

/// A storage format. Sums are always kept in single precision.
///
/// # Safety of the functions
/// As in [`Simd`]; they read or write sixteen values.
pub(crate) trait Element: Product {
    /// The multiplication for layers of at most eight outputs.
    type Narrow: Product<T = Self::T>;
    /// Stored numbers that together hold one of single precision, or nearly.
    const PARTS: usize;

    fn from_f32(x: f32) -> Self::T;
    fn to_f32(x: Self::T) -> f32;
    /// Per pixel the sum of its lanes, of sums that hold as many pixels as a multiplication takes
    /// channels: the first sixteen over that many are used.
    unsafe fn gather<S: Simd>(sums: &[S::V; LANES]) -> S::V;
    unsafe fn load<S: Simd>(from: *const Self::T) -> S::V;
    unsafe fn store<S: Simd>(to: *mut Self::T, x: S::V);
}

/// Single precision.
#[derive(Clone, Copy)]
pub(crate) struct Single;

/// Single precision, two channels into eight outputs: even lanes take one, odd lanes the other.
#[derive(Clone, Copy)]
pub(crate) struct NarrowSingle;

/// bfloat16, two channels per multiplication.
#[derive(Clone, Copy)]
pub(crate) struct Brain;

/// bfloat16, four channels into eight outputs, two of them by the even lanes.
#[derive(Clone, Copy)]
pub(crate) struct NarrowBrain;

#[allow(
    unsafe_op_in_unsafe_fn,
    reason = "each function passes its caller's promise on to one of Simd"
)]
impl Product for Single {
    type T = f32;
    type W<S: Simd> = S::V;
    const STEP: usize = 1;
    const OUTPUTS: usize = LANES;

    #[inline(always)]
    unsafe fn weights<S: Simd>(from: *const f32) -> S::V {
        S::load(from)
    }
    #[inline(always)]
    unsafe fn spread<S: Simd, const PIXEL: usize, const STRIDE: usize>(from: *const f32) -> S::V {
        S::splat(*from.add(PIXEL * STRIDE * LANES))
    }
    #[inline(always)]
    unsafe fn mul_add<S: Simd>(x: S::V, w: S::V, sum: S::V) -> S::V {
        S::mul_add(x, w, sum)
    }
    #[inline(always)]
    unsafe fn close<S: Simd>(sum: S::V) -> S::V {
        sum
    }
}

#[allow(
    unsafe_op_in_unsafe_fn,
    reason = "each function passes its caller's promise on to one of Simd"
)]
impl Element for Single {
    type Narrow = NarrowSingle;
    const PARTS: usize = 1;

    fn from_f32(x: f32) -> f32 {
        x
    }
    fn to_f32(x: f32) -> f32 {
        x
    }
    #[inline(always)]
    unsafe fn gather<S: Simd>(sums: &[S::V; LANES]) -> S::V {
        S::sum_each(sums)
    }
    #[inline(always)]
    unsafe fn load<S: Simd>(from: *const f32) -> S::V {
        S::load(from)
    }
    #[inline(always)]
    unsafe fn store<S: Simd>(to: *mut f32, x: S::V) {
        S::store(to, x);
    }
}

#[allow(
    unsafe_op_in_unsafe_fn,
    reason = "each function passes its caller's promise on to one of Simd"
)]
impl Product for NarrowSingle {
    type T = f32;
    type W<S: Simd> = S::V;
    const STEP: usize = 2;
    const OUTPUTS: usize = LANES / 2;

    #[inline(always)]
    unsafe fn weights<S: Simd>(from: *const f32) -> S::V {
        S::load(from)
    }
    #[inline(always)]
    unsafe fn spread<S: Simd, const PIXEL: usize, const STRIDE: usize>(from: *const f32) -> S::V {
        S::spread_two::<PIXEL, STRIDE>(from)
    }
    #[inline(always)]
    unsafe fn mul_add<S: Simd>(x: S::V, w: S::V, sum: S::V) -> S::V {
        S::mul_add(x, w, sum)
    }
    #[inline(always)]
    unsafe fn close<S: Simd>(sum: S::V) -> S::V {
        S::fold(sum)
    }
}

#[allow(
    unsafe_op_in_unsafe_fn,
    reason = "each function passes its caller's promise on to one of Simd"
)]
impl Product for Brain {
    type T = u16;
    type W<S: Simd> = S::Pairs;
    const STEP: usize = 2;
    const OUTPUTS: usize = LANES;

    #[inline(always)]
    unsafe fn weights<S: Simd>(from: *const u16) -> S::Pairs {
        S::load_pairs(from)
    }
    #[inline(always)]
    unsafe fn spread<S: Simd, const PIXEL: usize, const STRIDE: usize>(
        from: *const u16,
    ) -> S::Pairs {
        S::spread_pair::<PIXEL, STRIDE>(from)
    }
    #[inline(always)]
    unsafe fn mul_add<S: Simd>(x: S::Pairs, w: S::Pairs, sum: S::V) -> S::V {
        S::dot_add(sum, x, w)
    }
    #[inline(always)]
    unsafe fn close<S: Simd>(sum: S::V) -> S::V {
        sum
    }
}

#[allow(
    unsafe_op_in_unsafe_fn,
    reason = "each function passes its caller's promise on to one of Simd"
)]
impl Element for Brain {
    type Narrow = NarrowBrain;
    const PARTS: usize = 2;

    fn from_f32(x: f32) -> u16 {
        bf16_from_f32(x)
    }
    fn to_f32(x: u16) -> f32 {
        f32_from_bf16(x)
    }
    #[inline(always)]
    unsafe fn gather<S: Simd>(sums: &[S::V; LANES]) -> S::V {
        let [a, b, c, d, e, f, g, h, ..] = *sums;
        S::sum_halves(&[a, b, c, d, e, f, g, h])
    }
    #[inline(always)]
    unsafe fn load<S: Simd>(from: *const u16) -> S::V {
        S::widen(from)
    }
    #[inline(always)]
    unsafe fn store<S: Simd>(to: *mut u16, x: S::V) {
        S::narrow(to, x);
    }
}

#[allow(
    unsafe_op_in_unsafe_fn,
    reason = "each function passes its caller's promise on to one of Simd"
)]
impl Product for NarrowBrain {
    type T = u16;
    type W<S: Simd> = S::Pairs;
    const STEP: usize = 4;
    const OUTPUTS: usize = LANES / 2;

    #[inline(always)]
    unsafe fn weights<S: Simd>(from: *const u16) -> S::Pairs {
        S::load_pairs(from)
    }
    #[inline(always)]
    unsafe fn spread<S: Simd, const PIXEL: usize, const STRIDE: usize>(
        from: *const u16,
    ) -> S::Pairs {
        S::spread_two_pairs::<PIXEL, STRIDE>(from)
    }
    #[inline(always)]
    unsafe fn mul_add<S: Simd>(x: S::Pairs, w: S::Pairs, sum: S::V) -> S::V {
        S::dot_add(sum, x, w)
    }
    #[inline(always)]
    unsafe fn close<S: Simd>(sum: S::V) -> S::V {
        S::fold(sum)
    }
}

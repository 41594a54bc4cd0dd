//! The two number formats features and weights are stored in.

use crate::simd::{LANES, Simd, bf16_from_f32};

/// A storage format. Sums are always kept in single precision.
///
/// # Safety of the functions
/// As in [`Simd`]; `spread` reads [`Element::STEP`] values, the others sixteen times that.
pub(crate) trait Element: Copy + Send + Sync + 'static {
    /// One stored number.
    type T: Copy + Default + Send + Sync + 'static;
    /// One multiplication's weights, and its inputs in every lane.
    type W<S: Simd>: Copy;
    /// Input channels one multiplication takes.
    const STEP: usize;

    fn from_f32(x: f32) -> Self::T;
    unsafe fn weights<S: Simd>(from: *const Self::T) -> Self::W<S>;
    /// The inputs of pixel `PIXEL` of a strip whose pixels lie `STRIDE` apart, `from` its first.
    unsafe fn spread<S: Simd, const PIXEL: usize, const STRIDE: usize>(
        from: *const Self::T,
    ) -> Self::W<S>;
    unsafe fn mul_add<S: Simd>(x: Self::W<S>, w: Self::W<S>, sum: S::V) -> S::V;
    unsafe fn load<S: Simd>(from: *const Self::T) -> S::V;
    unsafe fn store<S: Simd>(to: *mut Self::T, x: S::V);
}

/// Single precision.
#[derive(Clone, Copy)]
pub(crate) struct Single;

/// bfloat16, two channels per multiplication.
#[derive(Clone, Copy)]
pub(crate) struct Brain;

#[allow(
    unsafe_op_in_unsafe_fn,
    reason = "each function passes its caller's promise on to one of Simd"
)]
impl Element for Single {
    type T = f32;
    type W<S: Simd> = S::V;
    const STEP: usize = 1;

    fn from_f32(x: f32) -> f32 {
        x
    }
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
impl Element for Brain {
    type T = u16;
    type W<S: Simd> = S::Pairs;
    const STEP: usize = 2;

    fn from_f32(x: f32) -> u16 {
        bf16_from_f32(x)
    }
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
    unsafe fn load<S: Simd>(from: *const u16) -> S::V {
        S::widen(from)
    }
    #[inline(always)]
    unsafe fn store<S: Simd>(to: *mut u16, x: S::V) {
        S::narrow(to, x);
    }
}

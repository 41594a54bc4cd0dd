//! Plain Rust: the reference for the other instruction sets and the fallback on any processor.
#![allow(
    unsafe_op_in_unsafe_fn,
    reason = "every function is a loop over sixteen values under the conditions of the trait"
)]

use super::{Kernel, LANES, Simd, bf16_from_f32, f32_from_bf16};

/// Loops over arrays, which the compiler turns into whatever vectors it may assume.
#[derive(Clone, Copy)]
pub(crate) struct Portable;

type V = [f32; LANES];

#[inline(always)]
fn zip(a: V, b: V, f: impl Fn(f32, f32) -> f32) -> V {
    std::array::from_fn(|i| f(a[i], b[i]))
}

impl Simd for Portable {
    type V = V;
    type Pairs = [(f32, f32); LANES];
    const SUMS: usize = 4;

    #[inline(always)]
    unsafe fn vectorize<K: Kernel>(kernel: K) {
        kernel.run::<Self>();
    }
    #[inline(always)]
    unsafe fn splat(x: f32) -> V {
        [x; LANES]
    }
    #[inline(always)]
    unsafe fn load(from: *const f32) -> V {
        from.cast::<V>().read_unaligned()
    }
    #[inline(always)]
    unsafe fn store(to: *mut f32, x: V) {
        to.cast::<V>().write_unaligned(x);
    }
    #[inline(always)]
    unsafe fn add(a: V, b: V) -> V {
        zip(a, b, |a, b| a + b)
    }
    #[inline(always)]
    unsafe fn mul(a: V, b: V) -> V {
        zip(a, b, |a, b| a * b)
    }
    #[inline(always)]
    unsafe fn div(a: V, b: V) -> V {
        zip(a, b, |a, b| a / b)
    }
    #[inline(always)]
    unsafe fn mul_add(a: V, b: V, c: V) -> V {
        // Two roundings: the fused form is a library call on a processor without it.
        std::array::from_fn(|i| a[i] * b[i] + c[i])
    }
    #[inline(always)]
    unsafe fn max(a: V, b: V) -> V {
        zip(a, b, |a, b| if a > b { a } else { b })
    }
    #[inline(always)]
    unsafe fn min(a: V, b: V) -> V {
        zip(a, b, |a, b| if a < b { a } else { b })
    }
    #[inline(always)]
    unsafe fn sum(x: V) -> f32 {
        x.iter().sum()
    }
    #[inline(always)]
    unsafe fn widen(from: *const u16) -> V {
        from.cast::<[u16; LANES]>()
            .read_unaligned()
            .map(f32_from_bf16)
    }
    #[inline(always)]
    unsafe fn narrow(to: *mut u16, x: V) {
        to.cast::<[u16; LANES]>()
            .write_unaligned(x.map(bf16_from_f32));
    }
    #[inline(always)]
    unsafe fn load_pairs(from: *const u16) -> Self::Pairs {
        let pairs = from.cast::<[[u16; 2]; LANES]>().read_unaligned();
        pairs.map(|[a, b]| (f32_from_bf16(a), f32_from_bf16(b)))
    }
    #[inline(always)]
    unsafe fn spread_pair<const PIXEL: usize, const STRIDE: usize>(
        from: *const u16,
    ) -> Self::Pairs {
        let from = from.add(PIXEL * STRIDE * LANES);
        let [a, b] = from.cast::<[u16; 2]>().read_unaligned();
        [(f32_from_bf16(a), f32_from_bf16(b)); LANES]
    }
    #[inline(always)]
    unsafe fn dot_add(sum: V, a: Self::Pairs, b: Self::Pairs) -> V {
        std::array::from_fn(|i| sum[i] + a[i].0 * b[i].0 + a[i].1 * b[i].1)
    }
}

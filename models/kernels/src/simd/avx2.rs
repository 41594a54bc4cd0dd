//! AVX2 with fused multiply-add: two registers per sixteen values.
#![allow(
    unsafe_op_in_unsafe_fn,
    reason = "every function is one instruction per half, under the conditions of the trait"
)]

use std::arch::x86_64::*;

use super::{Kernel, LANES, Simd};

/// Two registers of eight.
#[derive(Clone, Copy)]
pub(crate) struct Avx2;

type V = (__m256, __m256);

#[target_feature(enable = "avx2,fma")]
unsafe fn entry<K: Kernel>(kernel: K) {
    kernel.run::<Avx2>();
}

#[inline(always)]
unsafe fn halves(pairs: __m256i) -> (__m256, __m256) {
    let upper = _mm256_and_si256(pairs, _mm256_set1_epi32(-0x1_0000));
    (
        _mm256_castsi256_ps(_mm256_slli_epi32::<16>(pairs)),
        _mm256_castsi256_ps(upper),
    )
}

/// Bits of the nearest bfloat16 in the lower half of each word.
#[inline(always)]
unsafe fn rounded(x: __m256) -> __m256i {
    let bits = _mm256_castps_si256(x);
    let odd = _mm256_and_si256(_mm256_srli_epi32::<16>(bits), _mm256_set1_epi32(1));
    let nearest = _mm256_add_epi32(bits, _mm256_add_epi32(odd, _mm256_set1_epi32(0x7fff)));
    let quiet = _mm256_or_si256(bits, _mm256_set1_epi32(0x0040_0000));
    let is_nan = _mm256_castps_si256(_mm256_cmp_ps::<_CMP_UNORD_Q>(x, x));
    _mm256_srli_epi32::<16>(_mm256_blendv_epi8(nearest, quiet, is_nan))
}

#[inline(always)]
unsafe fn dot(sum: __m256, a: __m256i, b: __m256i) -> __m256 {
    let ((a0, a1), (b0, b1)) = (halves(a), halves(b));
    _mm256_fmadd_ps(a1, b1, _mm256_fmadd_ps(a0, b0, sum))
}

impl Simd for Avx2 {
    type V = V;
    type Pairs = (__m256i, __m256i);
    const SUMS: usize = 6;

    #[inline(always)]
    unsafe fn vectorize<K: Kernel>(kernel: K) {
        entry(kernel);
    }
    #[inline(always)]
    unsafe fn splat(x: f32) -> V {
        (_mm256_set1_ps(x), _mm256_set1_ps(x))
    }
    #[inline(always)]
    unsafe fn load(from: *const f32) -> V {
        (_mm256_loadu_ps(from), _mm256_loadu_ps(from.add(8)))
    }
    #[inline(always)]
    unsafe fn store(to: *mut f32, x: V) {
        _mm256_storeu_ps(to, x.0);
        _mm256_storeu_ps(to.add(8), x.1);
    }
    #[inline(always)]
    unsafe fn add(a: V, b: V) -> V {
        (_mm256_add_ps(a.0, b.0), _mm256_add_ps(a.1, b.1))
    }
    #[inline(always)]
    unsafe fn mul(a: V, b: V) -> V {
        (_mm256_mul_ps(a.0, b.0), _mm256_mul_ps(a.1, b.1))
    }
    #[inline(always)]
    unsafe fn div(a: V, b: V) -> V {
        (_mm256_div_ps(a.0, b.0), _mm256_div_ps(a.1, b.1))
    }
    #[inline(always)]
    unsafe fn mul_add(a: V, b: V, c: V) -> V {
        (
            _mm256_fmadd_ps(a.0, b.0, c.0),
            _mm256_fmadd_ps(a.1, b.1, c.1),
        )
    }
    #[inline(always)]
    unsafe fn max(a: V, b: V) -> V {
        (_mm256_max_ps(a.0, b.0), _mm256_max_ps(a.1, b.1))
    }
    #[inline(always)]
    unsafe fn min(a: V, b: V) -> V {
        (_mm256_min_ps(a.0, b.0), _mm256_min_ps(a.1, b.1))
    }
    #[inline(always)]
    unsafe fn sum(x: V) -> f32 {
        let eight = _mm256_add_ps(x.0, x.1);
        let four = _mm_add_ps(
            _mm256_castps256_ps128(eight),
            _mm256_extractf128_ps::<1>(eight),
        );
        let two = _mm_add_ps(four, _mm_movehl_ps(four, four));
        _mm_cvtss_f32(_mm_add_ss(two, _mm_movehdup_ps(two)))
    }
    #[inline(always)]
    unsafe fn widen(from: *const u16) -> V {
        let words = |from: *const u16| {
            let words = _mm256_cvtepu16_epi32(_mm_loadu_si128(from.cast()));
            _mm256_castsi256_ps(_mm256_slli_epi32::<16>(words))
        };
        (words(from), words(from.add(8)))
    }
    #[inline(always)]
    unsafe fn narrow(to: *mut u16, x: V) {
        // The packing works within halves of a register; the permutation restores the order.
        let packed = _mm256_packus_epi32(rounded(x.0), rounded(x.1));
        _mm256_storeu_si256(to.cast(), _mm256_permute4x64_epi64::<0b11_01_10_00>(packed));
    }
    #[inline(always)]
    unsafe fn load_pairs(from: *const u16) -> Self::Pairs {
        (
            _mm256_loadu_si256(from.cast()),
            _mm256_loadu_si256(from.add(16).cast()),
        )
    }
    #[inline(always)]
    unsafe fn spread_pair<const PIXEL: usize, const STRIDE: usize>(
        from: *const u16,
    ) -> Self::Pairs {
        let from = from.add(PIXEL * STRIDE * LANES);
        let pair = _mm256_set1_epi32(from.cast::<i32>().read_unaligned());
        (pair, pair)
    }
    #[inline(always)]
    unsafe fn expect_read(at: *const u8) {
        _mm_prefetch::<_MM_HINT_T0>(at.cast());
    }
    #[inline(always)]
    unsafe fn dot_add(sum: V, a: Self::Pairs, b: Self::Pairs) -> V {
        (dot(sum.0, a.0, b.0), dot(sum.1, a.1, b.1))
    }
}

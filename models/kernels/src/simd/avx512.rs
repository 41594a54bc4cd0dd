//! AVX-512, with or without its bfloat16 instructions.
#![allow(
    unsafe_op_in_unsafe_fn,
    reason = "every function is one instruction or a few, under the conditions of the trait"
)]

use std::arch::x86_64::*;

use super::{Kernel, LANES, Simd};

/// One register per sixteen values; `BF16` says whether pairs are multiplied in one instruction.
#[derive(Clone, Copy)]
pub(crate) struct Avx512<const BF16: bool>;

#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512dq")]
unsafe fn plain<K: Kernel>(kernel: K) {
    kernel.run::<Avx512<false>>();
}

#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512dq,avx512bf16")]
unsafe fn with_bf16<K: Kernel>(kernel: K) {
    kernel.run::<Avx512<true>>();
}

/// The lower and the upper halves of sixteen pairs, widened.
#[inline(always)]
unsafe fn halves(pairs: __m512i) -> (__m512, __m512) {
    let upper = _mm512_and_si512(pairs, _mm512_set1_epi32(-0x1_0000));
    (
        _mm512_castsi512_ps(_mm512_slli_epi32::<16>(pairs)),
        _mm512_castsi512_ps(upper),
    )
}

/// [`Simd::spread_pair`] by the load unit alone. For a product the compiler would broadcast with
/// an instruction of the floating-point domain, which takes a turn of the units that multiply
/// (Zen 4: a strip of sixteen takes 21 cycles instead of 16).
#[inline]
#[target_feature(enable = "avx512f")]
unsafe fn broadcast_pair<const PIXEL: usize, const STRIDE: usize>(from: *const u16) -> __m512i {
    let pairs: __m512i;
    std::arch::asm!(
        "vpbroadcastd {pairs}, dword ptr [{from} + {offset}]",
        pairs = lateout(zmm_reg) pairs,
        from = in(reg) from,
        offset = const PIXEL * STRIDE * LANES * size_of::<u16>(),
        options(pure, readonly, nostack, preserves_flags),
    );
    pairs
}

/// Eight bytes into every lane, by the load unit alone; `NUMBER` is the bytes of a stored number.
#[inline]
#[target_feature(enable = "avx512f")]
unsafe fn broadcast_eight<const NUMBER: usize, const PIXEL: usize, const STRIDE: usize>(
    from: *const u8,
) -> __m512i {
    let lanes: __m512i;
    std::arch::asm!(
        "vpbroadcastq {lanes}, qword ptr [{from} + {offset}]",
        lanes = lateout(zmm_reg) lanes,
        from = in(reg) from,
        offset = const PIXEL * STRIDE * LANES * NUMBER,
        options(pure, readonly, nostack, preserves_flags),
    );
    lanes
}

/// Per 128 bits: the sums of the four lanes of four vectors from the `first`.
#[inline(always)]
unsafe fn quarter_sums(x: &[__m512], first: usize) -> __m512 {
    let (a, b, c, d) = (x[first], x[first + 1], x[first + 2], x[first + 3]);
    let ab = _mm512_add_ps(_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b));
    let cd = _mm512_add_ps(_mm512_unpacklo_ps(c, d), _mm512_unpackhi_ps(c, d));
    let (ab, cd) = (_mm512_castps_pd(ab), _mm512_castps_pd(cd));
    let (low, high) = (_mm512_unpacklo_pd(ab, cd), _mm512_unpackhi_pd(ab, cd));
    _mm512_add_ps(_mm512_castpd_ps(low), _mm512_castpd_ps(high))
}

/// The sums of the lower and of the upper two 128 bits of `a`, then of `b`.
#[inline(always)]
unsafe fn half_sums(a: __m512, b: __m512) -> __m512 {
    _mm512_add_ps(
        _mm512_shuffle_f32x4::<0b10_00_10_00>(a, b),
        _mm512_shuffle_f32x4::<0b11_01_11_01>(a, b),
    )
}

impl<const BF16: bool> Simd for Avx512<BF16> {
    type V = __m512;
    type Pairs = __m512i;
    const SUMS: usize = 28;

    #[inline(always)]
    unsafe fn vectorize<K: Kernel>(kernel: K) {
        if BF16 {
            with_bf16(kernel);
        } else {
            plain(kernel);
        }
    }
    #[inline(always)]
    unsafe fn splat(x: f32) -> __m512 {
        _mm512_set1_ps(x)
    }
    #[inline(always)]
    unsafe fn load(from: *const f32) -> __m512 {
        _mm512_loadu_ps(from)
    }
    #[inline(always)]
    unsafe fn store(to: *mut f32, x: __m512) {
        _mm512_storeu_ps(to, x);
    }
    #[inline(always)]
    unsafe fn add(a: __m512, b: __m512) -> __m512 {
        _mm512_add_ps(a, b)
    }
    #[inline(always)]
    unsafe fn mul(a: __m512, b: __m512) -> __m512 {
        _mm512_mul_ps(a, b)
    }
    #[inline(always)]
    unsafe fn div(a: __m512, b: __m512) -> __m512 {
        _mm512_div_ps(a, b)
    }
    #[inline(always)]
    unsafe fn mul_add(a: __m512, b: __m512, c: __m512) -> __m512 {
        _mm512_fmadd_ps(a, b, c)
    }
    #[inline(always)]
    unsafe fn max(a: __m512, b: __m512) -> __m512 {
        _mm512_max_ps(a, b)
    }
    #[inline(always)]
    unsafe fn min(a: __m512, b: __m512) -> __m512 {
        _mm512_min_ps(a, b)
    }
    #[inline(always)]
    unsafe fn sum(x: __m512) -> f32 {
        _mm512_reduce_add_ps(x)
    }
    #[inline(always)]
    unsafe fn widen(from: *const u16) -> __m512 {
        let words = _mm512_cvtepu16_epi32(_mm256_loadu_si256(from.cast()));
        _mm512_castsi512_ps(_mm512_slli_epi32::<16>(words))
    }
    #[inline(always)]
    unsafe fn narrow(to: *mut u16, x: __m512) {
        let words: __m256i = if BF16 {
            std::mem::transmute::<__m256bh, __m256i>(_mm512_cvtneps_pbh(x))
        } else {
            let bits = _mm512_castps_si512(x);
            let odd = _mm512_and_si512(_mm512_srli_epi32::<16>(bits), _mm512_set1_epi32(1));
            let rounding = _mm512_add_epi32(odd, _mm512_set1_epi32(0x7fff));
            let quiet = _mm512_or_si512(bits, _mm512_set1_epi32(0x0040_0000));
            let is_nan = _mm512_cmp_ps_mask::<_CMP_UNORD_Q>(x, x);
            let rounded = _mm512_mask_mov_epi32(_mm512_add_epi32(bits, rounding), is_nan, quiet);
            _mm512_cvtepi32_epi16(_mm512_srli_epi32::<16>(rounded))
        };
        _mm256_storeu_si256(to.cast(), words);
    }
    #[inline(always)]
    unsafe fn load_pairs(from: *const u16) -> __m512i {
        _mm512_loadu_si512(from.cast())
    }
    #[inline(always)]
    unsafe fn spread_pair<const PIXEL: usize, const STRIDE: usize>(from: *const u16) -> __m512i {
        if BF16 {
            broadcast_pair::<PIXEL, STRIDE>(from)
        } else {
            let from = from.add(PIXEL * STRIDE * LANES);
            _mm512_set1_epi32(from.cast::<i32>().read_unaligned())
        }
    }
    #[inline(always)]
    unsafe fn spread_two<const PIXEL: usize, const STRIDE: usize>(from: *const f32) -> __m512 {
        _mm512_castsi512_ps(broadcast_eight::<4, PIXEL, STRIDE>(from.cast()))
    }
    #[inline(always)]
    unsafe fn spread_two_pairs<const PIXEL: usize, const STRIDE: usize>(
        from: *const u16,
    ) -> __m512i {
        broadcast_eight::<2, PIXEL, STRIDE>(from.cast())
    }
    #[inline(always)]
    unsafe fn fold(x: __m512) -> __m512 {
        let swapped = _mm512_permute_ps::<0b10_11_00_01>(x);
        let even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 0, 0, 0, 0, 0, 0, 0, 0);
        _mm512_maskz_permutexvar_ps(0xff, even, _mm512_add_ps(x, swapped))
    }
    #[inline(always)]
    unsafe fn sum_each(x: &[__m512; LANES]) -> __m512 {
        let (a, b) = (quarter_sums(x, 0), quarter_sums(x, 4));
        let (c, d) = (quarter_sums(x, 8), quarter_sums(x, 12));
        half_sums(half_sums(a, b), half_sums(c, d))
    }
    #[inline(always)]
    unsafe fn sum_halves(x: &[__m512; LANES / 2]) -> __m512 {
        // Lower halves of 0 to 3, upper ones of 0 to 3, then of 4 to 7.
        let halves = half_sums(quarter_sums(x, 0), quarter_sums(x, 4));
        let order = _mm512_setr_epi32(0, 4, 1, 5, 2, 6, 3, 7, 8, 12, 9, 13, 10, 14, 11, 15);
        _mm512_permutexvar_ps(order, halves)
    }
    #[inline(always)]
    unsafe fn expect_read(at: *const u8) {
        _mm_prefetch::<_MM_HINT_T0>(at.cast());
    }
    #[inline(always)]
    unsafe fn expect_write(at: *const u8) {
        _mm_prefetch::<_MM_HINT_ET0>(at.cast());
    }
    #[inline(always)]
    unsafe fn dot_add(sum: __m512, a: __m512i, b: __m512i) -> __m512 {
        if BF16 {
            let pairs = |x| std::mem::transmute::<__m512i, __m512bh>(x);
            _mm512_dpbf16_ps(sum, pairs(a), pairs(b))
        } else {
            let ((a0, a1), (b0, b1)) = (halves(a), halves(b));
            _mm512_fmadd_ps(a1, b1, _mm512_fmadd_ps(a0, b0, sum))
        }
    }
}

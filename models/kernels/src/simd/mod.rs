//! Sixteen numbers at a time on whatever instructions the processor has.
//!
//! A kernel is written once over [`Simd`] and compiled per instruction set by
//! [`Simd::vectorize`]; every set works on the same sixteen lanes, so data laid out for one is
//! laid out for all. A further set (NEON) is one more file beside these.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod portable;

#[cfg(target_arch = "x86_64")]
pub(crate) use avx2::Avx2;
#[cfg(target_arch = "x86_64")]
pub(crate) use avx512::Avx512;
pub(crate) use portable::Portable;

/// Numbers handled at once, and channels per block of a feature.
pub const LANES: usize = 16;

/// Code that runs on any instruction set.
pub(crate) trait Kernel {
    /// # Safety
    /// The processor has the instructions of `S`; further conditions are the kernel's own.
    unsafe fn run<S: Simd>(self);
}

/// One instruction set.
///
/// # Safety of every function here
/// The caller runs on a processor with these instructions, and every pointer is valid for the
/// sixteen values (two for `spread_pair`) that are read or written. No alignment is asked for.
/// `max` and `min` return their second operand where either is not a number, so that
/// `max(limit, x)` keeps what is not a number visible.
pub(crate) trait Simd: Copy + Send + Sync + 'static {
    /// Sixteen numbers in single precision.
    type V: Copy;
    /// Sixteen pairs of bfloat16.
    type Pairs: Copy;
    /// Sums a kernel can keep in registers beside three weights and one input.
    const SUMS: usize;

    /// Runs `kernel` compiled for these instructions.
    unsafe fn vectorize<K: Kernel>(kernel: K);

    unsafe fn splat(x: f32) -> Self::V;
    unsafe fn load(from: *const f32) -> Self::V;
    unsafe fn store(to: *mut f32, x: Self::V);
    unsafe fn add(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn mul(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn div(a: Self::V, b: Self::V) -> Self::V;
    /// `a * b + c`; rounded once where the processor can.
    unsafe fn mul_add(a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    unsafe fn max(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn min(a: Self::V, b: Self::V) -> Self::V;
    /// Sum of the lanes.
    unsafe fn sum(x: Self::V) -> f32;

    /// The sums of the lanes of each.
    unsafe fn sum_each(x: &[Self::V; LANES]) -> Self::V {
        let mut sums = [0.0; LANES];
        for (sum, x) in sums.iter_mut().zip(x) {
            // SAFETY: passed on from the caller.
            *sum = unsafe { Self::sum(*x) };
        }
        // SAFETY: the array holds as many values as are read.
        unsafe { Self::load(sums.as_ptr()) }
    }
    /// The sums of the lower eight lanes of each, and of the upper eight, in turn.
    unsafe fn sum_halves(x: &[Self::V; LANES / 2]) -> Self::V {
        let mut sums = [0.0; LANES];
        for (pair, x) in sums.chunks_exact_mut(2).zip(x) {
            let mut lanes = [0.0; LANES];
            // SAFETY: the array holds as many values as are written.
            unsafe { Self::store(lanes.as_mut_ptr(), *x) };
            let (lower, upper) = lanes.split_at(LANES / 2);
            pair[0] = lower.iter().sum();
            pair[1] = upper.iter().sum();
        }
        // SAFETY: the array holds as many values as are read.
        unsafe { Self::load(sums.as_ptr()) }
    }

    /// The first of two numbers into even lanes, the second into odd ones; placed as in
    /// [`Simd::spread_pair`].
    unsafe fn spread_two<const PIXEL: usize, const STRIDE: usize>(from: *const f32) -> Self::V {
        // SAFETY: passed on from the caller.
        unsafe {
            let two = from.add(PIXEL * STRIDE * LANES).cast::<[f32; 2]>();
            let two = two.read_unaligned();
            let lanes: [f32; LANES] = std::array::from_fn(|lane| two[lane % 2]);
            Self::load(lanes.as_ptr())
        }
    }
    /// The first of two pairs into even lanes, the second into odd ones; placed as in
    /// [`Simd::spread_pair`].
    unsafe fn spread_two_pairs<const PIXEL: usize, const STRIDE: usize>(
        from: *const u16,
    ) -> Self::Pairs {
        // SAFETY: passed on from the caller.
        unsafe {
            let four = from.add(PIXEL * STRIDE * LANES).cast::<[u16; 4]>();
            let four = four.read_unaligned();
            let all: [u16; 2 * LANES] = std::array::from_fn(|i| four[i % 4]);
            Self::load_pairs(all.as_ptr())
        }
    }
    /// Sums of neighbouring lanes in the lower eight; zeros in the upper.
    unsafe fn fold(x: Self::V) -> Self::V {
        let (mut lanes, mut sums) = ([0.0; LANES], [0.0; LANES]);
        // SAFETY: the arrays hold as many values as are written and read.
        unsafe { Self::store(lanes.as_mut_ptr(), x) };
        for (sum, pair) in sums.iter_mut().zip(lanes.chunks_exact(2)) {
            *sum = pair[0] + pair[1];
        }
        // SAFETY: as above.
        unsafe { Self::load(sums.as_ptr()) }
    }

    /// Asks for a cache line that will be read; any address is allowed.
    unsafe fn expect_read(_at: *const u8) {}
    /// Asks for a cache line that will be written; any address is allowed.
    unsafe fn expect_write(_at: *const u8) {}

    /// Widens sixteen bfloat16.
    unsafe fn widen(from: *const u16) -> Self::V;
    /// Rounds to bfloat16, to nearest, ties to even.
    unsafe fn narrow(to: *mut u16, x: Self::V);
    /// Thirty-two bfloat16 as sixteen pairs.
    unsafe fn load_pairs(from: *const u16) -> Self::Pairs;
    /// Two bfloat16 into every lane: those `PIXEL * STRIDE` times sixteen numbers from `from`.
    unsafe fn spread_pair<const PIXEL: usize, const STRIDE: usize>(from: *const u16)
    -> Self::Pairs;
    /// `sum + a.0 * b.0 + a.1 * b.1` per lane in single precision.
    unsafe fn dot_add(sum: Self::V, a: Self::Pairs, b: Self::Pairs) -> Self::V;
}

/// Nearest bfloat16, ties to even; what is not a number stays so.
pub(crate) fn bf16_from_f32(x: f32) -> u16 {
    let bits = x.to_bits();
    let [_, _, low, high] = if x.is_nan() {
        (bits | 0x0040_0000).to_le_bytes()
    } else {
        let odd = bits >> 16 & 1;
        bits.wrapping_add(0x7fff + odd).to_le_bytes()
    };
    u16::from_le_bytes([low, high])
}

/// Exact.
pub(crate) fn f32_from_bf16(x: u16) -> f32 {
    f32::from_bits(u32::from(x) << 16)
}

#[cfg(test)]
mod tests;

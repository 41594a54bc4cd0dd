//! The machine's own limits, to set measured times beside: multiply-adds on registers alone, and
//! memory read and written by nothing but loads and stores.

use std::hint::black_box;

use crate::isa::Isa;
#[cfg(target_arch = "x86_64")]
use crate::simd::{Avx2, Avx512};
use crate::simd::{Kernel, LANES, Portable, Simd};
use crate::spec::Precision;

/// Independent sums that hide the latency of a multiply-add and fit the registers of `S`.
const fn sum_count<S: Simd>() -> usize {
    if S::SUMS < 12 { 6 } else { 12 }
}

struct Spin {
    precision: Precision,
    rounds: u64,
}

impl Kernel for Spin {
    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        // SAFETY: passed on from the caller.
        unsafe {
            if sum_count::<S>() == 6 {
                self.sums::<S, 6>();
            } else {
                self.sums::<S, 12>();
            }
        }
    }
}

impl Spin {
    /// # Safety
    /// The processor has the instructions of `S`.
    #[inline(always)]
    unsafe fn sums<S: Simd, const N: usize>(self) {
        let (factors, words) = ([0.5f32; LANES], [0x3f00u16; 2 * LANES]);
        // SAFETY: both arrays are as long as what is loaded from them.
        unsafe {
            let x = S::load(black_box(factors.as_ptr()));
            let pairs = S::load_pairs(black_box(words.as_ptr()));
            let mut sums = [S::splat(1.0); N];
            match self.precision {
                Precision::Single => {
                    for _ in 0..self.rounds {
                        for sum in &mut sums {
                            *sum = S::mul_add(*sum, x, x);
                        }
                    }
                }
                Precision::Brain => {
                    for _ in 0..self.rounds {
                        for sum in &mut sums {
                            *sum = S::dot_add(*sum, pairs, pairs);
                        }
                    }
                }
            }
            black_box(sums.map(|sum| S::sum(sum)));
        }
    }
}

/// Keeps one core at multiply-adds for `rounds` and returns the floating-point operations done,
/// two per multiply-add; the caller holds the clock. `None` where the processor lacks `isa`.
pub fn spin(isa: Isa, precision: Precision, rounds: u64) -> Option<u64> {
    if !isa.is_available() {
        return None;
    }
    let kernel = Spin { precision, rounds };
    // SAFETY: the processor has the instructions.
    let sums = unsafe {
        match (isa, precision) {
            #[cfg(target_arch = "x86_64")]
            (Isa::Avx512Bf16, Precision::Brain) => spin_on::<Avx512<true>>(kernel),
            #[cfg(target_arch = "x86_64")]
            (Isa::Avx512 | Isa::Avx512Bf16, _) => spin_on::<Avx512<false>>(kernel),
            #[cfg(target_arch = "x86_64")]
            (Isa::Avx2, _) => spin_on::<Avx2>(kernel),
            _ => spin_on::<Portable>(kernel),
        }
    };
    let products = match precision {
        Precision::Single => LANES,
        Precision::Brain => 2 * LANES,
    };
    Some(2 * rounds * (sums * products) as u64)
}

/// Returns the number of sums kept.
///
/// # Safety
/// The processor has the instructions of `S`.
unsafe fn spin_on<S: Simd>(kernel: Spin) -> usize {
    // SAFETY: passed on from the caller.
    unsafe { S::vectorize(kernel) };
    sum_count::<S>()
}

/// Doubles the second half of `memory` into the first and back, `rounds` times over, and returns
/// the bytes read and written; the caller holds the clock. How large `memory` is decides which
/// cache is measured. `None` where the processor lacks `isa`.
pub fn stream(isa: Isa, memory: &mut [f32], rounds: u64) -> Option<u64> {
    if !isa.is_available() {
        return None;
    }
    let half = memory.len() / 2 / LANES * LANES;
    let (a, b) = memory.split_at_mut(half);
    let b = &mut b[..half];
    for round in 0..rounds {
        let (from, to) = if round % 2 == 0 {
            (&*b, &mut *a)
        } else {
            (&*a, &mut *b)
        };
        let kernel = Stream { from, to };
        // SAFETY: the processor has the instructions.
        unsafe {
            match isa {
                #[cfg(target_arch = "x86_64")]
                Isa::Avx512 | Isa::Avx512Bf16 => Avx512::<false>::vectorize(kernel),
                #[cfg(target_arch = "x86_64")]
                Isa::Avx2 => Avx2::vectorize(kernel),
                _ => Portable::vectorize(kernel),
            }
        }
    }
    black_box(&*a);
    Some(2 * rounds * size_of_val(&*a) as u64)
}

/// One pass of [`stream`]; both slices are as long, a multiple of the lanes.
struct Stream<'a> {
    from: &'a [f32],
    to: &'a mut [f32],
}

impl Kernel for Stream<'_> {
    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        for (from, to) in self
            .from
            .chunks_exact(LANES)
            .zip(self.to.chunks_exact_mut(LANES))
        {
            // SAFETY: both chunks hold as many values as there are lanes.
            unsafe {
                let x = S::load(from.as_ptr());
                S::store(to.as_mut_ptr(), S::add(x, x));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stream_touches_every_value_and_counts_its_bytes() {
        for isa in Isa::ALL.into_iter().filter(|isa| isa.is_available()) {
            let mut memory = vec![1.0; 2 * 48 + 5];
            assert_eq!(stream(isa, &mut memory, 3), Some(3 * 2 * 4 * 48));
            assert!(memory[..48].iter().all(|v| *v == 8.0), "{isa}");
            assert!(memory[48..96].iter().all(|v| *v == 4.0), "{isa}");
            assert_eq!(memory[96..], [1.0; 5]);
        }
    }

    #[test]
    fn operations_are_counted() {
        assert_eq!(spin(Isa::Portable, Precision::Single, 10), Some(1920));
        assert_eq!(spin(Isa::Portable, Precision::Brain, 10), Some(3840));
    }
}

//! Every instruction set against plain arithmetic.

use super::*;
use crate::activation::{Activation, sigmoid, tanh};

/// Runs `check` compiled for every instruction set this processor has.
fn on_all(check: impl Kernel + Copy) {
    // SAFETY: each set is asked for only where the processor has it.
    unsafe {
        Portable::vectorize(check);
        #[cfg(target_arch = "x86_64")]
        {
            use crate::isa::Isa;
            if Isa::Avx2.is_available() {
                Avx2::vectorize(check);
            }
            if Isa::Avx512.is_available() {
                Avx512::<false>::vectorize(check);
            }
            if Isa::Avx512Bf16.is_available() {
                Avx512::<true>::vectorize(check);
            }
        }
    }
}

fn values() -> [f32; LANES] {
    std::array::from_fn(|i| (i as f32 - 7.3) * 1.7)
}

#[derive(Clone, Copy)]
struct Arithmetic;

impl Kernel for Arithmetic {
    unsafe fn run<S: Simd>(self) {
        let (a, b) = (values(), values().map(|x| 0.5 - x * x));
        let check = |got: S::V, wanted: fn(f32, f32) -> f32| {
            let mut lanes = [0.0; LANES];
            // SAFETY: sixteen values are written.
            unsafe { S::store(lanes.as_mut_ptr(), got) };
            assert_eq!(lanes, std::array::from_fn(|i| wanted(a[i], b[i])));
        };
        // SAFETY: both arrays hold sixteen values.
        unsafe {
            let (x, y) = (S::load(a.as_ptr()), S::load(b.as_ptr()));
            check(S::add(x, y), |a, b| a + b);
            check(S::mul(x, y), |a, b| a * b);
            check(S::div(x, y), |a, b| a / b);
            check(S::max(x, y), f32::max);
            check(S::min(x, y), f32::min);
            check(S::splat(2.5), |_, _| 2.5);
            let sum: f64 = a.iter().copied().map(f64::from).sum();
            assert!((f64::from(S::sum(x)) - sum).abs() < 1e-4);
            let many: [f32; LANES] = std::array::from_fn(|i| (i * i) as f32);
            // Vector i holds lane numbers times i squared; sums of integers are exact.
            let lanes: [f32; LANES] = std::array::from_fn(|l| l as f32);
            let each = many.map(|m| S::mul(S::splat(m), S::load(lanes.as_ptr())));
            let mut sums = [0.0; LANES];
            S::store(sums.as_mut_ptr(), S::sum_each(&each));
            assert_eq!(sums, many.map(|m| 120.0 * m));
            let eight: [S::V; LANES / 2] = std::array::from_fn(|i| each[i]);
            S::store(sums.as_mut_ptr(), S::sum_halves(&eight));
            let half = |i: usize| many[i / 2] * if i.is_multiple_of(2) { 28.0 } else { 92.0 };
            assert_eq!(sums, std::array::from_fn(half));
            let nan = S::splat(f32::NAN);
            check(S::max(nan, x), |a, _| a);
            check(S::min(nan, x), |a, _| a);
            assert!(S::sum(S::max(x, nan)).is_nan());
        }
    }
}

#[test]
fn arithmetic_is_exact_on_every_set() {
    on_all(Arithmetic);
}

#[derive(Clone, Copy)]
struct BrainFloats;

impl Kernel for BrainFloats {
    unsafe fn run<S: Simd>(self) {
        let special = [
            1.0,
            1.003_906_2,
            1.011_718_8,
            -0.0,
            65_504.0,
            f32::MAX,
            1e-30,
        ];
        let more = [
            f32::INFINITY,
            f32::NEG_INFINITY,
            f32::NAN,
            -2.7,
            0.1,
            3.3e38,
        ];
        let mut x = values();
        x[..7].copy_from_slice(&special);
        x[7..13].copy_from_slice(&more);
        let (mut words, mut back) = ([0; LANES], [0.0; LANES]);
        // SAFETY: the arrays hold sixteen values each.
        unsafe {
            S::narrow(words.as_mut_ptr(), S::load(x.as_ptr()));
            S::store(back.as_mut_ptr(), S::widen(words.as_ptr()));
        }
        for (i, value) in x.iter().enumerate() {
            if value.is_nan() {
                assert!(back[i].is_nan());
            } else {
                assert_eq!(words[i], bf16_from_f32(*value), "{value}");
                assert_eq!(back[i], f32_from_bf16(words[i]));
            }
        }
        let pairs: [u16; 2 * LANES] = std::array::from_fn(|i| bf16_from_f32(i as f32 * 0.37 - 5.0));
        let mut sums = [0.0; LANES];
        // SAFETY: thirty-two numbers are read, sixteen written; the pair read is the fourth.
        unsafe {
            let (a, b) = (
                S::load_pairs(pairs.as_ptr()),
                S::spread_pair::<0, 1>(pairs.as_ptr().add(6)),
            );
            S::store(sums.as_mut_ptr(), S::dot_add(S::splat(0.25), a, b));
        }
        let at = |i: usize| f64::from(f32_from_bf16(pairs[i]));
        for (i, sum) in sums.iter().enumerate() {
            let wanted = 0.25 + at(2 * i) * at(6) + at(2 * i + 1) * at(7);
            assert!((f64::from(*sum) - wanted).abs() < 1e-4, "{sum} {wanted}");
        }
    }
}

#[test]
fn brain_floats_round_to_nearest_even_on_every_set() {
    assert_eq!(bf16_from_f32(1.003_906_2), 0x3f80); // a tie, to even: down
    assert_eq!(bf16_from_f32(1.011_718_8), 0x3f82); // a tie, to even: up
    on_all(BrainFloats);
}

#[derive(Clone, Copy)]
struct Curves;

impl Kernel for Curves {
    unsafe fn run<S: Simd>(self) {
        let mut worst = (0f64, 0f64);
        for step in 0..20_000u16 {
            let start = (f32::from(step) - 10_000.0) * 1.1e-3;
            let x: [f32; LANES] = std::array::from_fn(|i| start + i as f32 * 6.1e-5);
            let (mut t, mut s) = ([0.0; LANES], [0.0; LANES]);
            // SAFETY: all three arrays hold sixteen values.
            unsafe {
                S::store(t.as_mut_ptr(), tanh::<S>(S::load(x.as_ptr())));
                S::store(s.as_mut_ptr(), sigmoid::<S>(S::load(x.as_ptr())));
            }
            for i in 0..LANES {
                let exact = f64::from(x[i]).tanh();
                if exact != 0.0 {
                    worst.0 = worst.0.max((f64::from(t[i]) / exact - 1.0).abs());
                }
                let exact = Activation::Sigmoid.exact(f64::from(x[i]));
                worst.1 = worst.1.max((f64::from(s[i]) - exact).abs());
                assert!((-1.0..=1.0).contains(&t[i]) && (0.0..=1.0).contains(&s[i]));
            }
        }
        assert!(worst.0 < 4e-7 && worst.1 < 2e-7, "{worst:?}");
        for x in [f32::INFINITY, 1e30, 40.0] {
            // SAFETY: registers only.
            unsafe {
                assert_eq!(S::sum(tanh::<S>(S::splat(x))), 16.0);
                assert_eq!(S::sum(tanh::<S>(S::splat(-x))), -16.0);
                assert_eq!(S::sum(sigmoid::<S>(S::splat(-x))), 0.0);
            }
        }
        // SAFETY: registers only.
        assert!(unsafe { S::sum(sigmoid::<S>(S::splat(f32::NAN))) }.is_nan());
    }
}

#[test]
fn curves_keep_their_stated_accuracy_on_every_set() {
    on_all(Curves);
}

//! Inputs for the kernel tests, and the comparison with the double-precision references.
#![allow(dead_code, reason = "every test file uses a part")]

use noctule_kernels::{Isa, Options, Precision, Size};

/// Values from -1 to 1 without pattern.
pub fn noise(len: usize, seed: u64) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let step = |_| {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 40) as f32 / 8_388_608.0 - 1.0
    };
    (0..len).map(step).collect()
}

pub fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().map(|v| f64::from(*v)).collect()
}

pub const fn size(height: usize, width: usize) -> Size {
    Size { height, width }
}

/// One thread on every instruction set this processor has, in both precisions.
pub fn every_way() -> Vec<Options> {
    let isas = Isa::ALL.into_iter().filter(|isa| isa.is_available());
    isas.flat_map(|isa| {
        [Precision::Single, Precision::Brain].map(|precision| Options {
            threads: 1,
            precision,
            isa,
        })
    })
    .collect()
}

/// Single precision must stay within 1e-5 of the largest value, bfloat16 within 1e-2 times
/// `roundings`, the number of times values pass through storage.
pub fn assert_close(got: &[f32], wanted: &[f64], options: Options, roundings: f64, case: &str) {
    assert_eq!(got.len(), wanted.len(), "{case}");
    let scale = wanted.iter().fold(1e-3f64, |max, w| max.max(w.abs()));
    let gate = match options.precision {
        Precision::Single => 1e-5 * scale,
        Precision::Brain => 1e-2 * roundings * scale,
    };
    for (index, (g, w)) in got.iter().zip(wanted).enumerate() {
        let error = (f64::from(*g) - w).abs();
        assert!(
            error <= gate,
            "{case}, {options:?}, value {index}: {g} instead of {w}"
        );
    }
}

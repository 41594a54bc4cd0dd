//! What is done value by value: activations and their slopes, along stretches of a plane.

use crate::activation::{Activation, SLOPE, sigmoid, tanh};
use crate::simd::{LANES, Simd};

/// Applies `activation` in place.
///
/// # Safety
/// The processor has the instructions of `S`.
#[inline(always)]
pub(super) unsafe fn activate<S: Simd>(activation: Activation, values: &mut [f32]) {
    match activation {
        Activation::None => {}
        // Comparisons this way round keep what is not a number visible.
        Activation::Relu => values
            .iter_mut()
            .for_each(|x| *x = if *x < 0.0 { 0.0 } else { *x }),
        Activation::LeakyRelu => values
            .iter_mut()
            .for_each(|x| *x = if *x < 0.0 { SLOPE * *x } else { *x }),
        // SAFETY: passed on from the caller.
        Activation::Tanh => unsafe { curve::<S, true>(values) },
        // SAFETY: passed on from the caller.
        Activation::Sigmoid => unsafe { curve::<S, false>(values) },
    }
}

/// # Safety
/// As [`activate`].
#[inline(always)]
unsafe fn curve<S: Simd, const TANH: bool>(values: &mut [f32]) {
    let mut blocks = values.chunks_exact_mut(LANES);
    for block in &mut blocks {
        // SAFETY: a block holds sixteen values.
        unsafe { curve_of::<S, TANH>(block) };
    }
    let rest = blocks.into_remainder();
    if !rest.is_empty() {
        let mut block = [0f32; LANES];
        block[..rest.len()].copy_from_slice(rest);
        // SAFETY: a block holds sixteen values.
        unsafe { curve_of::<S, TANH>(&mut block) };
        rest.copy_from_slice(&block[..rest.len()]);
    }
}

/// # Safety
/// As [`activate`], and `block` holds sixteen values.
#[inline(always)]
unsafe fn curve_of<S: Simd, const TANH: bool>(block: &mut [f32]) {
    // SAFETY: passed on from the caller.
    unsafe {
        let x = S::load(block.as_ptr());
        let y = if TANH { tanh::<S>(x) } else { sigmoid::<S>(x) };
        S::store(block.as_mut_ptr(), y);
    }
}

/// `to = grad * slope of the activation` where it returned `out`.
///
/// Rectifiers take the left slope at zero: sparse inputs put many pixels there.
#[inline(always)]
pub(super) fn unactivate(activation: Activation, out: &[f32], grad: &[f32], to: &mut [f32]) {
    let pairs = to.iter_mut().zip(grad.iter().zip(out));
    match activation {
        Activation::None => to.copy_from_slice(grad),
        Activation::Relu => {
            pairs.for_each(|(to, (g, y))| *to = g * if *y > 0.0 { 1.0 } else { 0.0 })
        }
        Activation::LeakyRelu => {
            pairs.for_each(|(to, (g, y))| *to = g * if *y > 0.0 { 1.0 } else { SLOPE });
        }
        Activation::Tanh => pairs.for_each(|(to, (g, y))| *to = g * (1.0 - y * y)),
        Activation::Sigmoid => pairs.for_each(|(to, (g, y))| *to = g * (y * (1.0 - y))),
    }
}

//! What follows a convolution's sum: rectifiers, hyperbolic tangent, logistic function.

use crate::simd::Simd;

/// A function applied to every value before it is stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Activation {
    /// The value itself.
    None,
    /// `max(x, 0)`.
    Relu,
    /// `max(x, 0.1 x)`.
    LeakyRelu,
    /// Hyperbolic tangent, within 4e-7 of the value relatively.
    Tanh,
    /// Logistic function, within 2e-7.
    Sigmoid,
}

/// Slope of the leaky rectifier left of zero.
pub(crate) const SLOPE: f32 = 0.1;

/// `tanh x = x P(x^2) / Q(x^2)` for |x| up to [`TANH_LIMIT`]: a rational fit of our own by
/// reweighted least squares on Chebyshev nodes; its own error is 2.1e-8 relatively.
const TANH_P: [f32; 5] = [
    1.0,
    0.133_797_18,
    3.494_035_3e-3,
    2.058_349_3e-5,
    1.331_908_7e-8,
];
const TANH_Q: [f32; 5] = [
    1.0,
    0.467_130_33,
    2.587_107_6e-2,
    3.283_094e-4,
    7.762_025_7e-7,
];
/// Beyond this the tangent is one in single precision.
const TANH_LIMIT: f32 = 9.01;

/// # Safety
/// As in [`Simd`].
#[inline(always)]
pub(crate) unsafe fn tanh<S: Simd>(x: S::V) -> S::V {
    // SAFETY: arithmetic on registers; the caller vouches for the instructions.
    unsafe {
        let (low, high) = (S::splat(-TANH_LIMIT), S::splat(TANH_LIMIT));
        let x = S::max(low, S::min(high, x));
        let square = S::mul(x, x);
        let polynomial = |terms: &[f32; 5]| {
            let [a, b, c, d, e] = *terms;
            let mut sum = S::splat(e);
            for term in [d, c, b, a] {
                sum = S::mul_add(sum, square, S::splat(term));
            }
            sum
        };
        let ratio = S::div(S::mul(x, polynomial(&TANH_P)), polynomial(&TANH_Q));
        S::max(S::splat(-1.0), S::min(S::splat(1.0), ratio))
    }
}

/// `1 / (1 + e^-x)` through the tangent of half of x, as the candle network has it.
///
/// # Safety
/// As in [`Simd`].
#[inline(always)]
pub(crate) unsafe fn sigmoid<S: Simd>(x: S::V) -> S::V {
    // SAFETY: arithmetic on registers; the caller vouches for the instructions.
    unsafe {
        let half = S::splat(0.5);
        S::mul_add(tanh::<S>(S::mul(x, half)), half, half)
    }
}

/// `span * tanh(z / span)`.
///
/// # Safety
/// As in [`Simd`].
#[inline(always)]
pub(crate) unsafe fn bounded<S: Simd>(z: S::V, span: f32) -> S::V {
    // SAFETY: arithmetic on registers; the caller vouches for the instructions.
    unsafe { S::mul(tanh::<S>(S::mul(z, S::splat(1.0 / span))), S::splat(span)) }
}

/// `e^x`, within 1e-5 of the value relatively for x between -11 and 11.
///
/// # Safety
/// As in [`Simd`].
#[inline(always)]
pub(crate) unsafe fn power<S: Simd>(x: S::V) -> S::V {
    // SAFETY: arithmetic on registers; the caller vouches for the instructions.
    unsafe {
        // e^x = (1 + t) / (1 - t) with t the tangent of half of x; in quarters, t stays small.
        let t = tanh::<S>(S::mul(x, S::splat(0.125)));
        let one = S::splat(1.0);
        let root = S::div(S::add(one, t), S::mul_add(t, S::splat(-1.0), one));
        let square = S::mul(root, root);
        S::mul(square, square)
    }
}

impl Activation {
    /// # Safety
    /// As in [`Simd`].
    #[inline(always)]
    pub(crate) unsafe fn apply<S: Simd>(self, x: S::V) -> S::V {
        // SAFETY: arithmetic on registers; the caller vouches for the instructions.
        unsafe {
            match self {
                Self::None => x,
                Self::Relu => S::max(S::splat(0.0), x),
                Self::LeakyRelu => S::max(S::mul(x, S::splat(SLOPE)), x),
                Self::Tanh => tanh::<S>(x),
                Self::Sigmoid => sigmoid::<S>(x),
            }
        }
    }

    /// The function itself, for references.
    pub fn exact(self, x: f64) -> f64 {
        match self {
            Self::None => x,
            Self::Relu => x.max(0.0),
            Self::LeakyRelu => x.max(f64::from(SLOPE) * x),
            Self::Tanh => x.tanh(),
            Self::Sigmoid => 1.0 / (1.0 + (-x).exp()),
        }
    }
}

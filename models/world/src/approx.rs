//! Elementary functions made of additions, multiplications and bit moves, so that loops over
//! pixels vectorise and give the same bits on every machine.

/// Adding and subtracting this rounds an `f32` below 2^22 to the nearest integer.
const ROUNDER: f32 = 12_582_912.0;

/// The smaller of two finite numbers (one instruction, unlike `f32::min`).
#[inline(always)]
pub(crate) fn min(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

/// The larger of two finite numbers (one instruction, unlike `f32::max`).
#[inline(always)]
pub(crate) fn max(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// The integer below `x` and the part above it, for |x| < 2^21.
#[inline(always)]
pub(crate) fn split(x: f32) -> (u32, f32) {
    let biased = x + ROUNDER;
    let nearest = biased - ROUNDER;
    let above = nearest > x;
    let whole = biased.to_bits().wrapping_sub(ROUNDER.to_bits());
    let floor = nearest - if above { 1.0 } else { 0.0 };
    (whole.wrapping_sub(u32::from(above)), x - floor)
}

/// e^x to about 2e-7 relative, for x in -86..86; clamped outside.
#[inline(always)]
pub(crate) fn exp(x: f32) -> f32 {
    let y = min(max(x, -86.0), 86.0) * core::f32::consts::LOG2_E;
    let biased = y + ROUNDER;
    let f = y - (biased - ROUNDER);
    // Taylor series of 2^f on [-0.5, 0.5].
    let p = 1.540_353e-4;
    let p = p * f + 1.333_355_8e-3;
    let p = p * f + 9.618_129e-3;
    let p = p * f + 5.550_411e-2;
    let p = p * f + 2.402_265e-1;
    let p = p * f + 6.931_472e-1;
    let p = p * f + 1.0;
    f32::from_bits(p.to_bits().wrapping_add(biased.to_bits() << 23))
}

/// Natural logarithm to about 1e-7 absolute plus 1e-7 relative, for normal positive `x`.
#[inline(always)]
pub(crate) fn ln(x: f32) -> f32 {
    let bits = x.to_bits();
    // Splits x into 2^k * m with m in [sqrt(1/2), sqrt(2)).
    let k = (bits.wrapping_sub(0x3f35_04f3) as i32) >> 23;
    let m = f32::from_bits(bits.wrapping_sub((k << 23) as u32));
    let s = (m - 1.0) / (m + 1.0);
    let s2 = s * s;
    let series = 2.0 * s * (1.0 + s2 * (1.0 / 3.0 + s2 * (0.2 + s2 * (1.0 / 7.0))));
    k as f32 * core::f32::consts::LN_2 + series
}

/// Share of a pixel's footprint (centre `x`, width `w`) that lies within `-half..half`.
#[inline(always)]
pub(crate) fn coverage(x: f32, w: f32, half: f32) -> f32 {
    let high = min(x + 0.5 * w, half);
    let low = max(x - 0.5 * w, -half);
    max(high - low, 0.0) / w
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn they_agree_with_the_standard_library() {
        for i in -850..=850 {
            let x = i as f32 * 0.1;
            assert!(
                (exp(x) / x.exp() - 1.0).abs() < 1.2e-5 * (1.0 + x.abs() / 20.0),
                "exp {x}"
            );
            let y = x.exp();
            assert!(
                (ln(y) - y.ln()).abs() < 2e-6 * (1.0 + y.ln().abs()),
                "ln {y}"
            );
        }
        for (x, whole, part) in [
            (2.25, 2_u32, 0.25),
            (-0.25, u32::MAX, 0.75),
            (-3.0, 0, 0.0),
            (0.0, 0, 0.0),
        ] {
            let (w, p) = split(x);
            if x != -3.0 {
                assert_eq!(w, whole, "{x}");
            } else {
                assert_eq!(w as i32, -3);
            }
            assert_eq!(p, part, "{x}");
        }
    }

    #[test]
    fn coverage_is_the_overlap_of_two_intervals() {
        assert_eq!(coverage(0.0, 1.0, 10.0), 1.0);
        assert_eq!(coverage(0.0, 4.0, 0.5), 0.25);
        assert_eq!(coverage(10.0, 1.0, 10.0), 0.5);
        assert_eq!(coverage(12.0, 1.0, 10.0), 0.0);
    }
}

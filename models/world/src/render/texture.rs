//! Hashed value noise in surface coordinates, faded where a pixel spans its cells.

use super::surface::Surface;
use super::{Lanes, TILE};
use crate::approx::{max, split};

/// How strongly an octave fades once a pixel's footprint reaches its cell size.
const FADE: f32 = 2.0;

/// One octave at `(a, b)` in cells: smooth, in -1..1.
#[inline(always)]
fn octave(a: f32, b: f32, seed: u32) -> f32 {
    let (ia, fa) = split(a);
    let (ib, fb) = split(b);
    let (ha, hb) = (
        ia.wrapping_mul(0x9e37_79b1),
        ib.wrapping_mul(0x85eb_ca77).wrapping_add(seed),
    );
    let (ha1, hb1) = (ha.wrapping_add(0x9e37_79b1), hb.wrapping_add(0x85eb_ca77));
    let (sa, sb) = (fa * fa * (3.0 - 2.0 * fa), fb * fb * (3.0 - 2.0 * fb));
    let upper = corner(ha, hb) + sa * (corner(ha1, hb) - corner(ha, hb));
    let lower = corner(ha, hb1) + sa * (corner(ha1, hb1) - corner(ha, hb1));
    upper + sb * (lower - upper)
}

#[inline(always)]
fn corner(a: u32, b: u32) -> f32 {
    let h = a ^ b;
    let h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
    (h >> 8) as i32 as f32 * (2.0 / 16_777_216.0) - 1.0
}

/// Albedo of a row: the mean modulated by two octaves.
pub(crate) fn albedo(surface: &Surface) -> Lanes {
    let mut out = [0.0; TILE];
    for i in 0..TILE {
        let (f0, f1) = (surface.coarse[i], surface.fine[i]);
        let (w0, w1) = (
            FADE * surface.footprint[i] * f0,
            FADE * surface.footprint[i] * f1,
        );
        let n0 = octave(surface.a[i] * f0, surface.b[i] * f0, surface.seed[i]);
        let n1 = octave(
            surface.a[i] * f1,
            surface.b[i] * f1,
            surface.seed[i] ^ 0x5bd1_e995,
        );
        let noise = 0.7 * n0 / (1.0 + w0 * w0) + 0.5 * n1 / (1.0 + w1 * w1);
        out[i] = surface.albedo[i] * max(1.0 + surface.contrast[i] * noise, 0.1);
    }
    out
}

//! Light arriving at a surface: ambient, the ego vehicle's two head lamps, street lamps.
//!
//! No shadows and no light from one surface to the next: head-lamp shadows nearly coincide with
//! the view ray.

use super::surface::Surface;
use super::{Lanes, TILE, texture};
use crate::approx::{exp, max};
use crate::scene::Scene;
use crate::snapshot::{PlacedLamp, Snapshot};

/// Head lamps in the camera's frame: left and right, below and a little ahead of it.
const HEAD_LAMPS: [[f32; 3]; 2] = [[-0.65, 0.85, 0.6], [0.65, 0.85, 0.6]];
/// Colour of the street lamps, luminance about 1.
const STREET_LAMP_COLOUR: [f32; 3] = [1.35, 0.95, 0.5];
/// Colour of the head lamps, luminance about 1.
const HEAD_LAMP_COLOUR: [f32; 3] = [1.0, 1.0, 1.05];
/// The sky's radiance relative to the ambient light on surfaces.
const SKY_SHARE: f32 = 0.04;

/// The lights of one frame.
pub(crate) struct Lights<'a> {
    ambient: f32,
    head_lamp: f32,
    lamps: &'a [PlacedLamp],
}

impl<'a> Lights<'a> {
    pub(crate) fn new(scene: &Scene, snapshot: &'a Snapshot) -> Self {
        Self {
            ambient: scene.ambient,
            head_lamp: scene.head_lamp,
            lamps: &snapshot.lamps,
        }
    }

    /// Radiance of a row: albedo * light / pi + own glow; sky where there is no surface.
    pub(crate) fn shade(&self, surface: &Surface) -> [Lanes; 3] {
        let sky = self.ambient * SKY_SHARE;
        if !surface.any {
            return [[sky; TILE]; 3];
        }
        let mut white = [self.ambient; TILE];
        for lamp in HEAD_LAMPS {
            self.add_head_lamp(lamp, surface, &mut white);
        }
        let mut warm = [0.0; TILE];
        for lamp in self.lamps {
            add_street_lamp(lamp, surface, &mut warm);
        }
        let albedo = texture::albedo(surface);
        let mut out = [[0.0; TILE]; 3];
        for c in 0..3 {
            for i in 0..TILE {
                let light = HEAD_LAMP_COLOUR[c] * white[i] + STREET_LAMP_COLOUR[c] * warm[i];
                let own = surface.glow[c][i];
                let lit =
                    surface.tint[c][i] * albedo[i] * light * core::f32::consts::FRAC_1_PI + own;
                out[c][i] = if surface.seen[i] { lit } else { sky };
            }
        }
        out
    }

    /// h cos(i) exp(-(lat/0.35)^2) exp(-((up+0.03)/0.16)^2) cutoff(up) / d^2: a low beam whose
    /// cutoff is a logistic just below the horizon with 3 % leaking above it.
    fn add_head_lamp(&self, lamp: [f32; 3], s: &Surface, light: &mut Lanes) {
        for i in 0..TILE {
            let (x, y, z) = (s.x[i] - lamp[0], s.y[i] - lamp[1], s.z[i] - lamp[2]);
            let ahead = max(z, 0.05);
            let (lateral, up) = (x / ahead, -y / ahead);
            let d2 = x * x + y * y + z * z;
            let facing = max(-(s.nx[i] * x + s.ny[i] * y + s.nz[i] * z), 0.0);
            let (l, u) = (lateral * (1.0 / 0.35), (up + 0.03) * (1.0 / 0.16));
            let beam = exp(-(l * l + u * u));
            let cutoff = 0.03 + 0.97 / (1.0 + exp(80.0 * (up + 0.01)));
            let e = self.head_lamp * facing * beam * cutoff / (d2 * d2.sqrt());
            light[i] += if z > 0.05 { e } else { 0.0 };
        }
    }
}

/// L cos(i) max(down, 0) / d^2.
fn add_street_lamp(lamp: &PlacedLamp, s: &Surface, light: &mut Lanes) {
    for i in 0..TILE {
        let (x, y, z) = (
            s.x[i] - lamp.position[0],
            s.y[i] - lamp.position[1],
            s.z[i] - lamp.position[2],
        );
        let inverse = 1.0 / max(x * x + y * y + z * z, 0.05);
        let facing = max(-(s.nx[i] * x + s.ny[i] * y + s.nz[i] * z), 0.0);
        light[i] += lamp.intensity * facing * max(y, 0.0) * inverse * inverse;
    }
}

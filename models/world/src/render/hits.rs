//! The first hit of every ray of a tile.

use super::bounds::Bounds;
use super::{Lanes, TILE};
use crate::approx::{max, min};
use crate::object::CAMERA_HEIGHT_M;
use crate::optics::Optics;
use crate::snapshot::{GROUND, GROUND_END_M, NEAR_M, Placed, Placement, SKY, away_from_zero};

/// Depth and identifier of a tile's pixels so far.
pub(crate) struct Hits {
    pub z: [Lanes; TILE],
    pub id: [[u32; TILE]; TILE],
    slopes: Lanes,
    slopes_y: [f32; TILE],
}

impl Hits {
    /// Ground and sky alone. Rays have unit z, so the hit parameter is the depth.
    pub(crate) fn new(top: usize, slopes: Lanes, optics: &Optics) -> Self {
        let slopes_y: Lanes = core::array::from_fn(|row| optics.slope((top + row) as f32));
        let mut hits = Self {
            z: [[f32::INFINITY; TILE]; TILE],
            id: [[u32::from(SKY); TILE]; TILE],
            slopes,
            slopes_y,
        };
        for row in 0..TILE {
            if slopes_y[row] > 0.0 {
                let z = CAMERA_HEIGHT_M / slopes_y[row];
                if z > NEAR_M && z < GROUND_END_M {
                    hits.z[row] = [z; TILE];
                    hits.id[row] = [u32::from(GROUND); TILE];
                }
            }
        }
        hits
    }

    /// Puts one object in, in the rows of its bounds.
    pub(crate) fn add(&mut self, object: &Placed, bounds: &Bounds, top: usize) {
        let first = (bounds.top - top as i32).max(0) as usize;
        let last = (bounds.bottom - top as i32).min(TILE as i32 - 1) as usize;
        let id = u32::from(object.id);
        match object.shape {
            Placement::Box {
                centre,
                cos,
                sin,
                half,
            } => {
                for row in first..=last {
                    self.add_box(row, id, centre, [cos, sin], half);
                }
            }
            Placement::Capsule {
                x,
                z,
                radius,
                top_y,
                bottom_y,
            } => {
                for row in first..=last {
                    self.add_capsule(row, id, [x, z, radius], [top_y, bottom_y]);
                }
            }
        }
    }

    fn add_box(&mut self, row: usize, id: u32, c: [f32; 3], [cos, sin]: [f32; 2], h: [f32; 3]) {
        let (ox, oz) = (sin * c[2] - cos * c[0], -(sin * c[0] + cos * c[2]));
        let inverse_y = 1.0 / away_from_zero(self.slopes_y[row]);
        let (ya, yb) = ((c[1] - h[1]) * inverse_y, (c[1] + h[1]) * inverse_y);
        let (y_enter, y_leave) = (max(min(ya, yb), NEAR_M), max(ya, yb));
        let (zs, ids) = (&mut self.z[row], &mut self.id[row]);
        for i in 0..TILE {
            let u = self.slopes[i];
            let inverse_x = 1.0 / away_from_zero(cos * u - sin);
            let inverse_z = 1.0 / away_from_zero(sin * u + cos);
            let (xa, xb) = ((-h[0] - ox) * inverse_x, (h[0] - ox) * inverse_x);
            let (za, zb) = ((-h[2] - oz) * inverse_z, (h[2] - oz) * inverse_z);
            let enter = max(max(min(xa, xb), min(za, zb)), y_enter);
            let leave = min(min(max(xa, xb), max(za, zb)), y_leave);
            // Starting inside means entering at the near limit: not seen.
            let hit = (enter <= leave) & (enter < zs[i]) & (enter > NEAR_M);
            zs[i] = if hit { enter } else { zs[i] };
            ids[i] = if hit { id } else { ids[i] };
        }
    }

    fn add_capsule(&mut self, row: usize, id: u32, [cx, cz, r]: [f32; 3], [top, bottom]: [f32; 2]) {
        let v = self.slopes_y[row];
        let (zs, ids) = (&mut self.z[row], &mut self.id[row]);
        let r2 = r * r;
        for i in 0..TILE {
            let u = self.slopes[i];
            let flat = u * u + 1.0;
            let cross = u * cz - cx;
            let disc = flat * r2 - cross * cross;
            let side = ((u * cx + cz) - max(disc, 0.0).sqrt()) / flat;
            let y = side * v;
            // The sphere at the nearer end, used where the cylinder is passed above or below.
            let end = if y < top { top } else { bottom };
            let full = flat + v * v;
            let (kx, ky, kz) = (v * cz - end, cx - u * cz, u * end - v * cx);
            let disc_end = full * r2 - (kx * kx + ky * ky + kz * kz);
            let round = (u * cx + v * end + cz - max(disc_end, 0.0).sqrt()) / full;
            let on_side = (y >= top) & (y <= bottom);
            let k = if on_side { side } else { round };
            let hit = (disc >= 0.0) & (on_side | (disc_end >= 0.0)) & (k > NEAR_M) & (k < zs[i]);
            zs[i] = if hit { k } else { zs[i] };
            ids[i] = if hit { id } else { ids[i] };
        }
    }
}

//! What a row of pixels hits: place, normal, surface coordinates, material and own light.

use super::{Lanes, Picture, TILE};
use crate::approx::{coverage, max, min};
use crate::chance::{hash32, unit32};
use crate::object::{CAMERA_HEIGHT_M, Glow, Material};
use crate::optics::Optics;
use crate::snapshot::{FIRST_OBJECT, GROUND, PlacedPaint, Placement, SKY, Snapshot};

/// Radiance of tail lamps, head lamps and lamp heads.
const TAIL_LAMP: [f32; 3] = [60.0, 3.0, 2.0];
const FRONT_LAMP: [f32; 3] = [400.0, 380.0, 330.0];
const BULB: [f32; 3] = [90.0, 65.0, 36.0];
/// Window pitch across and down, and half sizes, metres.
const WINDOW_PITCH: [f32; 2] = [2.6, 2.9];
const WINDOW_HALF: [f32; 2] = [0.55, 0.75];
/// Share of windows with light.
const WINDOW_LIT: f32 = 0.1;

const ASPHALT: Material = Material {
    albedo: 0.2,
    contrast: 0.7,
    tint: [1.0, 1.0, 1.0],
    frequency: [0.75, 5.0],
    seed: 0x51ed_270b,
    glow: Glow::Dark,
};

/// Turns and shifts the observer's frame into ground coordinates that stay with the ground.
pub(crate) struct GroundFrame {
    cos: f32,
    sin: f32,
    x: f32,
    z: f32,
    seed: u32,
}

impl GroundFrame {
    /// Single precision suffices: a kilometre away it still resolves a tenth of a millimetre.
    pub(crate) fn new(snapshot: &Snapshot) -> Self {
        let pose = snapshot.observer;
        let (sin, cos) = pose.heading_rad.sin_cos();
        Self {
            cos: cos as f32,
            sin: sin as f32,
            x: pose.x_m as f32,
            z: pose.z_m as f32,
            seed: ASPHALT.seed,
        }
    }
}

/// One row of surface points in the observer's frame.
#[derive(Default)]
pub(crate) struct Surface {
    /// Whether any pixel of the row hits something.
    pub any: bool,
    pub seen: [bool; TILE],
    id: [u32; TILE],
    pub x: Lanes,
    pub y: Lanes,
    pub z: Lanes,
    pub nx: Lanes,
    pub ny: Lanes,
    pub nz: Lanes,
    /// Surface coordinates, metres, and how much of them one pixel spans.
    pub a: Lanes,
    pub b: Lanes,
    pub footprint: Lanes,
    /// Span of a pixel seen head on.
    pixel: Lanes,
    pub albedo: Lanes,
    pub contrast: Lanes,
    pub coarse: Lanes,
    pub fine: Lanes,
    pub seed: [u32; TILE],
    pub tint: [Lanes; 3],
    pub glow: [Lanes; 3],
    /// 1 / length of the ray with unit z.
    shortening: Lanes,
}

impl Surface {
    /// Starts a row: points on the rays, nothing known of the surfaces yet.
    pub(crate) fn set_out(
        &mut self,
        z: &Lanes,
        id: &[u32; TILE],
        slopes: &Lanes,
        slope_y: f32,
        optics: &Optics,
    ) {
        self.id = *id;
        self.any = false;
        self.glow = [[0.0; TILE]; 3];
        let per_metre = 1.0 / optics.focal_px;
        for i in 0..TILE {
            self.seen[i] = id[i] != u32::from(SKY);
            self.any |= self.seen[i];
            // Sky pixels get harmless numbers; their result is replaced.
            let depth = if self.seen[i] { z[i] } else { 1.0 };
            self.x[i] = slopes[i] * depth;
            self.y[i] = slope_y * depth;
            self.z[i] = depth;
            self.pixel[i] = depth * per_metre;
            self.shortening[i] = 1.0 / (1.0 + slopes[i] * slopes[i] + slope_y * slope_y).sqrt();
        }
    }

    /// Fills in the pixels that show `which`.
    pub(crate) fn fill(&mut self, picture: &Picture<'_>, which: u32, paint: &[PlacedPaint]) {
        if which == u32::from(SKY) {
            self.dress(which, &ASPHALT);
        } else if which == u32::from(GROUND) {
            self.fill_ground(&picture.ground, paint);
        } else {
            let index = (which - u32::from(FIRST_OBJECT)) as usize;
            let material = &picture.scene.objects[index].material;
            self.dress(which, material);
            let placed = picture
                .snapshot
                .objects
                .iter()
                .find(|o| u32::from(o.id) == which);
            match placed.map(|o| &o.shape) {
                Some(&Placement::Box {
                    centre,
                    cos,
                    sin,
                    half,
                }) => {
                    self.fill_box(which, centre, [cos, sin], half);
                    match material.glow {
                        Glow::CarLamps => self.glow_car(which, centre, [cos, sin], half),
                        Glow::Windows => self.glow_windows(which, centre, half),
                        Glow::Dark | Glow::Bulb => {}
                    }
                }
                Some(&Placement::Capsule {
                    x,
                    z,
                    radius,
                    top_y,
                    bottom_y,
                }) => {
                    self.fill_capsule(
                        which,
                        &picture.ground,
                        [x, z, 1.0 / radius],
                        [top_y, bottom_y],
                    );
                    if material.glow == Glow::Bulb {
                        self.glow_bulb(which);
                    }
                }
                None => {}
            }
        }
        self.foreshorten(which);
    }

    /// The constants of a material.
    fn dress(&mut self, which: u32, material: &Material) {
        for i in 0..TILE {
            let m = self.id[i] == which;
            self.albedo[i] = if m { material.albedo } else { self.albedo[i] };
            self.contrast[i] = if m {
                material.contrast
            } else {
                self.contrast[i]
            };
            self.coarse[i] = if m {
                material.frequency[0]
            } else {
                self.coarse[i]
            };
            self.fine[i] = if m {
                material.frequency[1]
            } else {
                self.fine[i]
            };
            self.seed[i] = if m { material.seed } else { self.seed[i] };
            for c in 0..3 {
                self.tint[c][i] = if m { material.tint[c] } else { self.tint[c][i] };
            }
        }
    }

    fn fill_ground(&mut self, frame: &GroundFrame, paint: &[PlacedPaint]) {
        let which = u32::from(GROUND);
        self.dress(
            which,
            &Material {
                seed: frame.seed,
                ..ASPHALT
            },
        );
        for i in 0..TILE {
            let m = self.id[i] == which;
            let a = frame.x + frame.cos * self.x[i] + frame.sin * self.z[i];
            let b = frame.z - frame.sin * self.x[i] + frame.cos * self.z[i];
            self.a[i] = if m { a } else { self.a[i] };
            self.b[i] = if m { b } else { self.b[i] };
            self.nx[i] = if m { 0.0 } else { self.nx[i] };
            self.ny[i] = if m { -1.0 } else { self.ny[i] };
            self.nz[i] = if m { 0.0 } else { self.nz[i] };
        }
        for p in paint {
            for i in 0..TILE {
                let (dx, dz) = (self.x[i] - p.x, self.z[i] - p.z);
                let (across, along) = (p.cos * dx - p.sin * dz, p.sin * dx + p.cos * dz);
                let stretched = self.pixel[i] * self.z[i] * (1.0 / CAMERA_HEIGHT_M);
                let cover = coverage(across, self.pixel[i], p.half[0])
                    * coverage(along, stretched, p.half[1]);
                let cover = if self.id[i] == which { cover } else { 0.0 };
                self.albedo[i] += cover * (0.7 - self.albedo[i]);
                self.contrast[i] *= 1.0 - 0.7 * cover;
            }
        }
    }

    fn fill_box(&mut self, which: u32, c: [f32; 3], [cos, sin]: [f32; 2], h: [f32; 3]) {
        for i in 0..TILE {
            let m = self.id[i] == which;
            let (rx, py, rz) = (self.x[i] - c[0], self.y[i] - c[1], self.z[i] - c[2]);
            let (px, pz) = (cos * rx - sin * rz, sin * rx + cos * rz);
            let (qx, qy, qz) = (px.abs() - h[0], py.abs() - h[1], pz.abs() - h[2]);
            let on_x = (qx >= qy) & (qx >= qz);
            let on_y = !on_x & (qy >= qz);
            let lx = if on_x { px.signum() } else { 0.0 };
            let ly = if on_y { py.signum() } else { 0.0 };
            let lz = if on_x | on_y { 0.0 } else { pz.signum() };
            let a = if on_x { pz } else { px };
            let b = if on_y { pz } else { py };
            self.a[i] = if m { a } else { self.a[i] };
            self.b[i] = if m { b } else { self.b[i] };
            self.nx[i] = if m { cos * lx + sin * lz } else { self.nx[i] };
            self.ny[i] = if m { ly } else { self.ny[i] };
            self.nz[i] = if m { cos * lz - sin * lx } else { self.nz[i] };
        }
    }

    fn fill_capsule(
        &mut self,
        which: u32,
        frame: &GroundFrame,
        [cx, cz, per_radius]: [f32; 3],
        [top, bottom]: [f32; 2],
    ) {
        for i in 0..TILE {
            let m = self.id[i] == which;
            let axis_y = min(max(self.y[i], top), bottom);
            let (dx, dy, dz) = (self.x[i] - cx, self.y[i] - axis_y, self.z[i] - cz);
            // Fixed to the world's directions, so that the pattern does not turn with the viewer.
            let (wx, wz) = (
                frame.cos * dx + frame.sin * dz,
                frame.cos * dz - frame.sin * dx,
            );
            self.a[i] = if m { wx + 1.7 * wz } else { self.a[i] };
            self.b[i] = if m { self.y[i] } else { self.b[i] };
            self.nx[i] = if m { dx * per_radius } else { self.nx[i] };
            self.ny[i] = if m { dy * per_radius } else { self.ny[i] };
            self.nz[i] = if m { dz * per_radius } else { self.nz[i] };
        }
    }

    /// A pixel spans more of a surface seen at a slant.
    fn foreshorten(&mut self, which: u32) {
        for i in 0..TILE {
            let towards =
                -(self.nx[i] * self.x[i] + self.ny[i] * self.y[i] + self.nz[i] * self.z[i]);
            let cos = max(towards * self.shortening[i] / self.z[i], 0.05);
            let footprint = self.pixel[i] / cos;
            self.footprint[i] = if self.id[i] == which {
                footprint
            } else {
                self.footprint[i]
            };
        }
    }

    fn glow_car(&mut self, which: u32, c: [f32; 3], [cos, sin]: [f32; 2], h: [f32; 3]) {
        for i in 0..TILE {
            let (rx, rz) = (self.x[i] - c[0], self.z[i] - c[2]);
            let (px, pz) = (cos * rx - sin * rz, sin * rx + cos * rz);
            // On the front or rear face, not on a flank.
            let end_face = self.id[i] == which && pz.abs() - h[2] > px.abs() - h[0];
            let across = coverage(px.abs() - (h[0] - 0.28), self.pixel[i], 0.13);
            let down = coverage(self.b[i] + 0.08, self.pixel[i], 0.07);
            let cover = if end_face { across * down } else { 0.0 };
            for k in 0..3 {
                let lamp = if pz > 0.0 {
                    FRONT_LAMP[k]
                } else {
                    TAIL_LAMP[k]
                };
                self.glow[k][i] += cover * lamp;
            }
        }
    }

    fn glow_windows(&mut self, which: u32, c: [f32; 3], h: [f32; 3]) {
        for i in 0..TILE {
            let vertical = self.id[i] == which && self.ny[i] == 0.0;
            let (column, across) = crate::approx::split(self.a[i] / WINDOW_PITCH[0]);
            let (floor, down) = crate::approx::split((self.y[i] - c[1] + h[1]) / WINDOW_PITCH[1]);
            let chance = hash32(column ^ (floor << 8), self.seed[i]);
            let slanted = self.pixel[i] * 2.0;
            let cover = coverage((across - 0.5) * WINDOW_PITCH[0], slanted, WINDOW_HALF[0])
                * coverage(
                    (down - 0.45) * WINDOW_PITCH[1],
                    self.pixel[i],
                    WINDOW_HALF[1],
                );
            let cover = if vertical { cover } else { 0.0 };
            let lit = unit32(chance);
            let strength = if lit < WINDOW_LIT {
                0.1 + lit * (0.6 / WINDOW_LIT)
            } else {
                0.0
            };
            self.albedo[i] *= 1.0 - 0.7 * cover;
            self.glow[0][i] += cover * strength;
            self.glow[1][i] += cover * strength * 0.8;
            self.glow[2][i] += cover * strength * 0.5;
        }
    }

    fn glow_bulb(&mut self, which: u32) {
        for i in 0..TILE {
            let m = self.id[i] == which;
            for c in 0..3 {
                self.glow[c][i] = if m { BULB[c] } else { self.glow[c][i] };
            }
        }
    }
}

//! What is exactly true at an instant: masks and the motion of every pixel to a later instant.

use rayon::prelude::*;

use crate::optics::Optics;
use crate::render::Frame;
use crate::road::Pose;
use crate::scene::Scene;
use crate::snapshot::{FIRST_OBJECT, SKY};

/// Turn about the vertical and shift that take a point from one camera frame to another.
#[derive(Debug, Clone, Copy)]
struct Rigid {
    cos: f32,
    sin: f32,
    x: f32,
    z: f32,
}

impl Rigid {
    /// From camera `from` to camera `to` for points that stay with a body that was at `body`
    /// then and is at `moved` now.
    fn carried(from: Pose, body: Pose, moved: Pose, to: Pose) -> Self {
        // The image of the first camera's origin, and the total turn.
        let (right, ahead) = body.local(from.x_m, from.z_m);
        let (x, z) = moved.world(right, ahead);
        let (x, z) = to.local(x, z);
        let turn = (from.heading_rad - body.heading_rad) + (moved.heading_rad - to.heading_rad);
        let (sin, cos) = turn.sin_cos();
        Self {
            cos: cos as f32,
            sin: sin as f32,
            x: x as f32,
            z: z as f32,
        }
    }

    fn apply(&self, p: [f32; 3]) -> [f32; 3] {
        [
            self.cos * p[0] + self.sin * p[2] + self.x,
            p[1],
            self.cos * p[2] - self.sin * p[0] + self.z,
        ]
    }
}

/// Optical flow of a frame rendered at `from_s` to `to_s`: `[2, H, W]`, pixels right and down.
///
/// From rigid motion alone: each pixel's point is carried along with its object (the sky only
/// turns), whether or not it is still visible then. A point that ends up behind the camera keeps
/// a flow of NaN.
#[must_use]
pub fn flow(scene: &Scene, frame: &Frame, optics: &Optics, from_s: f64, to_s: f64) -> Vec<f32> {
    let (from, to) = (scene.ego_pose(from_s), scene.ego_pose(to_s));
    let ground = Rigid::carried(from, from, from, to);
    let sky = Rigid {
        x: 0.0,
        z: 0.0,
        ..ground
    };
    let objects: Vec<Rigid> = scene
        .objects
        .iter()
        .map(|object| {
            if !object.course.is_moving() {
                return ground;
            }
            let body = object.centre(&scene.road, &scene.ego, from_s);
            let moved = object.centre(&scene.road, &scene.ego, to_s);
            Rigid::carried(from, body, moved, to)
        })
        .collect();
    let size = frame.size;
    let mut out = vec![0.0; 2 * size * size];
    let (right, down) = out.split_at_mut(size * size);
    let rows = right
        .par_chunks_mut(size)
        .zip_eq(down.par_chunks_mut(size))
        .enumerate();
    rows.for_each(|(y, (right, down))| {
        let slope_y = optics.slope(y as f32);
        for x in 0..size {
            let i = y * size + x;
            let id = frame.id[i];
            let depth = if id == SKY { 1.0 } else { frame.depth[i] };
            let rigid = match id {
                SKY => &sky,
                id if id < FIRST_OBJECT => &ground,
                id => &objects[usize::from(id - FIRST_OBJECT)],
            };
            let p = rigid.apply([optics.slope(x as f32) * depth, slope_y * depth, depth]);
            let inverse = if p[2] > 0.0 { 1.0 / p[2] } else { f32::NAN };
            right[x] = optics.pixel(p[0] * inverse) - x as f32;
            down[x] = optics.pixel(p[1] * inverse) - y as f32;
        }
    });
    out
}

/// 1 where the pixel shows an object for which `holds`, else 0: `[H, W]`.
pub(crate) fn mask(scene: &Scene, frame: &Frame, holds: impl Fn(&Scene, u16) -> bool) -> Vec<u8> {
    let known: Vec<u8> = (0..scene.objects.len())
        .map(|i| u8::from(holds(scene, FIRST_OBJECT + i as u16)))
        .collect();
    let lookup = |id: &u16| {
        id.checked_sub(FIRST_OBJECT)
            .map_or(0, |i| known[usize::from(i)])
    };
    frame.id.iter().map(lookup).collect()
}

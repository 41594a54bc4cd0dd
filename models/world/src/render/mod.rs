//! The tiled renderer: exact depth and the light of every pixel, 16 by 16 pixels at a time.
//!
//! A tile looks only at the objects whose projected bounds touch it, and works on rows of 16
//! pixels without branches, so that the compiler turns them into vector instructions. Tiles are
//! independent: the picture is the same, bit for bit, with any number of threads.

mod bounds;
mod hits;
mod light;
mod surface;
mod texture;

use rayon::prelude::*;

use crate::optics::Optics;
use crate::scene::Scene;
use crate::snapshot::{PlacedPaint, SKY, Snapshot};
use bounds::Bounds;
use hits::Hits;
use light::Lights;
use surface::Surface;

/// Width and height of a tile, pixels.
pub(crate) const TILE: usize = 16;
/// One value per pixel of a tile's row.
pub(crate) type Lanes = [f32; TILE];

/// Weights of red, green and blue in luminance (ITU-R BT.709).
pub const LUMA: [f32; 3] = [0.2126, 0.7152, 0.0722];

/// A rendered instant: linear light, depth and what each pixel shows, all row-major `size²`.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// Width and height, pixels.
    pub size: usize,
    /// Radiance per channel, in the scene's unit.
    pub rgb: [Vec<f32>; 3],
    /// Luminance, the same unit.
    pub luma: Vec<f32>,
    /// Depth along the optical axis, metres; 0 where there is only sky.
    pub depth: Vec<f32>,
    /// Identifier of what is seen: sky, ground or an object.
    pub id: Vec<u16>,
}

impl Frame {
    /// A black frame of `size` by `size` pixels.
    #[must_use]
    pub fn new(size: usize) -> Self {
        let plane = vec![0.0; size * size];
        Self {
            size,
            rgb: [plane.clone(), plane.clone(), plane.clone()],
            luma: plane.clone(),
            depth: plane,
            id: vec![0; size * size],
        }
    }
}

/// Renders `snapshot` of `scene` into `frame`, over all threads of the current rayon pool.
///
/// # Panics
/// When `frame` is not of the optics' size, or that size is not a multiple of 16.
pub fn render(scene: &Scene, snapshot: &Snapshot, optics: &Optics, frame: &mut Frame) {
    let size = optics.size;
    assert!(
        frame.size == size && frame.luma.len() == size * size,
        "frame is {}, optics {size}",
        frame.size
    );
    assert!(
        size.is_multiple_of(TILE),
        "size {size} is not a multiple of {TILE}"
    );
    let picture = Picture::new(scene, snapshot, optics);
    let band = size * TILE;
    let [red, green, blue] = &mut frame.rgb;
    red.par_chunks_mut(band)
        .zip_eq(green.par_chunks_mut(band))
        .zip_eq(blue.par_chunks_mut(band))
        .zip_eq(frame.luma.par_chunks_mut(band))
        .zip_eq(frame.depth.par_chunks_mut(band))
        .zip_eq(frame.id.par_chunks_mut(band))
        .enumerate()
        .for_each(|(index, (((((red, green), blue), luma), depth), id))| {
            picture.band(
                index * TILE,
                Band {
                    rgb: [red, green, blue],
                    luma,
                    depth,
                    id,
                },
            );
        });
}

/// Sixteen rows of a frame.
struct Band<'a> {
    rgb: [&'a mut [f32]; 3],
    luma: &'a mut [f32],
    depth: &'a mut [f32],
    id: &'a mut [u16],
}

/// Everything that is the same for all tiles of one frame.
pub(crate) struct Picture<'a> {
    scene: &'a Scene,
    snapshot: &'a Snapshot,
    optics: &'a Optics,
    object_bounds: Vec<Bounds>,
    paint_bounds: Vec<Bounds>,
    lights: Lights<'a>,
    ground: surface::GroundFrame,
}

impl<'a> Picture<'a> {
    fn new(scene: &'a Scene, snapshot: &'a Snapshot, optics: &'a Optics) -> Self {
        Self {
            scene,
            snapshot,
            optics,
            object_bounds: snapshot
                .objects
                .iter()
                .map(|o| Bounds::of_shape(&o.shape, optics))
                .collect(),
            paint_bounds: snapshot
                .paint
                .iter()
                .map(|p| Bounds::of_paint(p, optics))
                .collect(),
            lights: Lights::new(scene, snapshot),
            ground: surface::GroundFrame::new(snapshot),
        }
    }

    fn band(&self, top: usize, mut out: Band<'_>) {
        let in_band: Vec<usize> = indices(&self.object_bounds, |b| b.touches_rows(top));
        let paint_in_band: Vec<usize> = indices(&self.paint_bounds, |b| b.touches_rows(top));
        let mut near = Vec::with_capacity(in_band.len());
        let mut paint = Vec::with_capacity(paint_in_band.len());
        for left in (0..self.optics.size).step_by(TILE) {
            near.clear();
            near.extend(
                in_band
                    .iter()
                    .copied()
                    .filter(|&i| self.object_bounds[i].touches_columns(left)),
            );
            paint.clear();
            paint.extend(
                paint_in_band
                    .iter()
                    .filter(|&&i| self.paint_bounds[i].touches_columns(left))
                    .map(|&i| self.snapshot.paint[i]),
            );
            self.tile(top, left, &near, &paint, &mut out);
        }
    }

    fn tile(
        &self,
        top: usize,
        left: usize,
        near: &[usize],
        paint: &[PlacedPaint],
        out: &mut Band<'_>,
    ) {
        let slopes: Lanes = core::array::from_fn(|i| self.optics.slope((left + i) as f32));
        let mut hits = Hits::new(top, slopes, self.optics);
        for &index in near {
            hits.add(
                &self.snapshot.objects[index],
                &self.object_bounds[index],
                top,
            );
        }
        let mut surface = Surface::default();
        for row in 0..TILE {
            let slope_y = self.optics.slope((top + row) as f32);
            let (z, id) = (&hits.z[row], &hits.id[row]);
            surface.set_out(z, id, &slopes, slope_y, self.optics);
            let mut done = [false; TILE];
            while let Some(lane) = done.iter().position(|d| !d) {
                let which = id[lane];
                for i in 0..TILE {
                    done[i] |= id[i] == which;
                }
                surface.fill(self, which, paint);
            }
            self.store(row, left, &hits, &surface, out);
        }
    }

    /// Lights one row and writes it out.
    fn store(&self, row: usize, left: usize, hits: &Hits, surface: &Surface, out: &mut Band<'_>) {
        let rgb = self.lights.shade(surface);
        let at = row * self.optics.size + left;
        for c in 0..3 {
            out.rgb[c][at..at + TILE].copy_from_slice(&rgb[c]);
        }
        let luma = &mut out.luma[at..at + TILE];
        for i in 0..TILE {
            luma[i] = LUMA[0] * rgb[0][i] + LUMA[1] * rgb[1][i] + LUMA[2] * rgb[2][i];
        }
        let (depth, id) = (&mut out.depth[at..at + TILE], &mut out.id[at..at + TILE]);
        for i in 0..TILE {
            id[i] = hits.id[row][i] as u16;
            depth[i] = if hits.id[row][i] == u32::from(SKY) {
                0.0
            } else {
                hits.z[row][i]
            };
        }
    }
}

fn indices(bounds: &[Bounds], keep: impl Fn(&Bounds) -> bool) -> Vec<usize> {
    let kept = bounds.iter().enumerate().filter(|(_, b)| keep(b));
    kept.map(|(i, _)| i).collect()
}

//! Surfaces through the returns: planes in inverse depth, one per nearest-return cell, blended.
//!
//! Inverse depth of a plane seen by a pinhole is affine in the image, so everything here runs on
//! inverse depth, as classical completion does (Ku, Harakeh and Waslander, "In Defense of
//! Classical Image Processing: Fast Depth Completion on the CPU", 2018). Where that method dilates
//! and blurs with fixed kernels, this one takes its neighbourhoods from the nearest-return cells
//! and so fits any size and any density:
//!
//! 1. Cells that touch are neighbours. Each return gets the inverse-depth slope that fits its
//!    neighbours best, those across a depth edge hardly counting (`surface`).
//! 2. Each pixel reads the plane of its cell, held between the neighbours' inverse depths.
//! 3. A pixel far outside the pattern of returns leans farther away: a surface in range would have
//!    answered (`spacing` says how far outside is far).
//! 4. Edge-keeping blurs, the widest first, join the cells (`blend`).

mod blend;
mod spacing;
mod surface;

use crate::nearest::NearestField;
use crate::size::{Size, is_return};
use blend::Blender;
use spacing::Spacing;
use surface::Surface;

/// Inverse depths are kept above this (1000 km) ...
const INVERSE_MIN_PER_M: f32 = 1e-6;
/// ... and below this (1 mm), which keeps every product in range.
const INVERSE_MAX_PER_M: f32 = 1e3;
/// Extra depth of a pixel at twice the expected reach of the pattern, as a share.
const LEAN: f32 = 0.5;
/// Most a pixel leans: this many times its surface's depth.
const LEAN_MAX: f32 = 2.0;

/// Buffers of the completion; reused from call to call.
pub(crate) struct Filler {
    size: Size,
    /// By pixel index; only those of returns are in use.
    surfaces: Vec<Surface>,
    spacing: Spacing,
    blender: Blender,
    inverse: Vec<f32>,
}

impl Filler {
    pub(crate) fn new(size: Size) -> Self {
        Self {
            size,
            surfaces: vec![Surface::default(); size.pixels()],
            spacing: Spacing::new(),
            blender: Blender::new(size),
            inverse: vec![0.0; size.pixels()],
        }
    }

    /// Completes `sparse`, whose nearest returns are in `field`, into `depth`.
    pub(crate) fn fill(&mut self, field: &NearestField, sparse: &[f32], depth: &mut [f32]) {
        self.start_surfaces(sparse);
        self.meet_neighbours(&field.source);
        self.settle_surfaces(sparse);
        self.lay(field);
        self.blender
            .blend(&mut self.inverse, self.spacing.blend_step());
        for (depth, &inverse) in depth.iter_mut().zip(&self.inverse) {
            *depth = 1.0 / inverse;
        }
    }

    /// One level surface per return.
    fn start_surfaces(&mut self, sparse: &[f32]) {
        let width = self.size.width();
        for (y, row) in sparse.chunks_exact(width).enumerate() {
            for (x, &depth) in row.iter().enumerate() {
                if is_return(depth) {
                    let inverse = depth.recip().clamp(INVERSE_MIN_PER_M, INVERSE_MAX_PER_M);
                    self.surfaces[y * width + x] = Surface::new(x as f32, y as f32, inverse);
                }
            }
        }
    }

    /// Shows every pair of touching cells to each other, once per pixel of common border.
    fn meet_neighbours(&mut self, source: &[u32]) {
        let width = self.size.width();
        for (y, row) in source.chunks_exact(width).enumerate() {
            for pair in row.windows(2) {
                if pair[0] != pair[1] {
                    self.meet(pair[0], pair[1]);
                }
            }
            let below = source
                .get((y + 1) * width..(y + 2) * width)
                .unwrap_or_default();
            for (&one, &other) in row.iter().zip(below) {
                if one != other {
                    self.meet(one, other);
                }
            }
            for &one in row {
                self.surfaces[one as usize].area_px += 1;
            }
        }
    }

    fn meet(&mut self, one: u32, other: u32) {
        let (mut a, mut b) = (self.surfaces[one as usize], self.surfaces[other as usize]);
        Surface::meet(&mut a, &mut b);
        self.surfaces[one as usize] = a;
        self.surfaces[other as usize] = b;
    }

    /// Solves for the slopes and learns the spacing of the returns.
    fn settle_surfaces(&mut self, sparse: &[f32]) {
        self.spacing.clear();
        for (surface, &depth) in self.surfaces.iter_mut().zip(sparse) {
            if is_return(depth) {
                surface.settle();
                self.spacing.count(surface);
            }
        }
    }

    /// Writes the inverse depth of every pixel from its cell's surface.
    fn lay(&mut self, field: &NearestField) {
        let width = self.size.width();
        let reach_px = self.spacing.reach_px();
        let reach_sq = reach_px * reach_px;
        let sources = field
            .source
            .chunks_exact(width)
            .zip(field.distance_sq.chunks_exact(width));
        for (y, (row, cells)) in self
            .inverse
            .chunks_exact_mut(width)
            .zip(sources)
            .enumerate()
        {
            for (x, (inverse, (&source, &distance_sq))) in
                row.iter_mut().zip(cells.0.iter().zip(cells.1)).enumerate()
            {
                *inverse = self.surfaces[source as usize].at(x as f32, y as f32);
                let distance_sq = distance_sq as f32;
                if distance_sq > reach_sq {
                    let beyond = distance_sq.sqrt() / reach_px - 1.0;
                    let lean = (1.0 + LEAN * beyond).min(LEAN_MAX);
                    *inverse = (*inverse / lean).max(INVERSE_MIN_PER_M);
                }
            }
        }
    }
}

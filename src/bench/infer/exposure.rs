//! One exposure of the synthetic night as a network sees it.

use noctule_depth::Ground;
use noctule_learn::night_ground;
use noctule_raster::{
    BINS, Exposure as Opening, Grid, PackedEvent, PixelMap, RasterError, Rescale, VoxelRaster,
};
use noctule_world::{STEPS, Sample, Tier};

/// Any night will do, as long as it is the same one every time.
const SEED: u64 = 1;

/// The inputs of a network, `size` x `size` pixels.
pub(super) struct Exposure {
    pub size: usize,
    /// `[3, H, W]`
    pub blur: Vec<f32>,
    /// `[T, BINS, H, W]`
    voxel: Vec<f32>,
    /// `[T, H, W]`
    sparse: Vec<f32>,
    /// Where level ground lies.
    pub ground: Option<Ground>,
}

impl Exposure {
    /// Draws it and cuts it into `steps`.
    #[expect(
        clippy::cast_possible_truncation,
        reason = "sides are at most 2048, exposures below a second"
    )]
    pub fn draw(size: usize, steps: usize) -> Result<Self, RasterError> {
        let sample = Sample::render(SEED, Tier::B, size);
        let side = size as u32;
        let map = PixelMap::rescaled(&Rescale::identity(Grid::new(side, side))?);
        let raster = VoxelRaster::new(steps, map)?;
        let opened_us = sample.opening.open_ns / 1000;
        let closed_us = sample.opening.close_ns / 1000;
        let events = sample.events.iter().map(|event| {
            let t_us = event.t.as_micros().saturating_sub(opened_us);
            PackedEvent::new(t_us as u32, event.x, event.y, event.on)
        });
        let events: Vec<PackedEvent> = events.collect::<Result<_, _>>()?;
        let mut voxel = vec![0.0; raster.shape().len()];
        let opening = Opening::from_micros(0, closed_us - opened_us)?;
        raster.raster(opening, &events, &mut voxel)?;
        let area = size * size;
        // The step whose time is nearest, where there are not eight.
        let of_step = |step: usize| (2 * step + 1) * STEPS / (2 * steps);
        let sparse = (0..steps)
            .flat_map(|step| &sample.sparse[of_step(step) * area..][..area])
            .copied()
            .collect();
        let blur = sample.blur.iter().map(|code| f32::from(*code) / 255.0);
        Ok(Self {
            size,
            ground: night_ground(size),
            blur: blur.collect(),
            voxel,
            sparse,
        })
    }

    pub fn step_count(&self) -> usize {
        self.sparse.len() / (self.size * self.size)
    }

    /// Voxels and sparse depth, step by step.
    pub fn steps(&self) -> impl Iterator<Item = (&[f32], &[f32])> {
        let area = self.size * self.size;
        self.voxel
            .chunks_exact(BINS * area)
            .zip(self.sparse.chunks_exact(area))
    }
}

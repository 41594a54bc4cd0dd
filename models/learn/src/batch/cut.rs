//! One example cut out, varied at random and rastered, as it enters a batch.

use noctule_depth::{Size, edge_band};
use noctule_raster::{
    BINS, Exposure, Grid, PackedEvent, PixelMap, RasterError, Rescale, VoxelRaster,
};
use noctule_world::STEPS;

use crate::cache::Example;
use crate::chance::Chance;
use crate::settings::{Augment, Domain};

/// Exponent of the world's encoding.
pub(crate) const GAMMA: f32 = 2.2;
/// Weights of red, green and blue in grey (paper, eq. 10).
pub(crate) const GREY: [f32; 3] = [0.299, 0.587, 0.114];

/// Which part of an example is taken and what is done to it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Cut {
    pub x0: usize,
    pub y0: usize,
    pub side: usize,
    /// First step and number of steps.
    pub window: (usize, usize),
    pub flip: bool,
    pub event_drop: f64,
    pub event_noise: f64,
    pub return_drop: f64,
    pub gain: f64,
}

impl Cut {
    /// The whole example as it is.
    pub(super) fn whole(size: usize) -> Self {
        Self {
            x0: 0,
            y0: 0,
            side: size,
            window: (0, STEPS),
            flip: false,
            event_drop: 0.0,
            event_noise: 0.0,
            return_drop: 0.0,
            gain: 1.0,
        }
    }

    /// A random one; every setting draws, whether it varies or not, so that turning one on does
    /// not move the others.
    pub(super) fn random(
        augment: &Augment,
        size: usize,
        side: usize,
        window: (usize, usize),
        chance: &mut Chance,
    ) -> Self {
        let [low, high] = augment.gain;
        Self {
            x0: chance.below(size - side + 1),
            y0: chance.below(size - side + 1),
            side,
            window,
            flip: chance.happens(augment.flip),
            event_drop: chance.between(0.0, augment.event_drop_max),
            event_noise: chance.between(0.0, augment.event_noise_max),
            return_drop: chance.between(0.0, augment.return_drop_max),
            gain: chance.between(low.ln(), high.ln()).exp(),
        }
    }

    /// Row by row, the index in the example of each pixel of the cut.
    fn cells(&self, size: usize) -> impl Iterator<Item = usize> + '_ {
        (0..self.side * self.side).map(move |i| {
            let (x, y) = (i % self.side, i / self.side);
            let x = if self.flip { self.side - 1 - x } else { x };
            (self.y0 + y) * size + self.x0 + x
        })
    }

    /// A field of planes, cut.
    fn planes<V: Copy, W>(&self, field: &[V], size: usize, map: impl Fn(V) -> W) -> Vec<W> {
        field
            .chunks_exact(size * size)
            .flat_map(|plane| self.cells(size).map(|cell| plane[cell]).collect::<Vec<V>>())
            .map(map)
            .collect()
    }
}

/// What a batch needs beside the network's inputs and the depth truth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Wanted {
    /// Sharp pictures and the grey that events imply; how the latter is averaged, and the contrast.
    pub pictures: Option<(Domain, f64)>,
    /// The band around depth edges.
    pub edges: bool,
    /// What moves on its own.
    pub movers: bool,
}

/// A cut of one example, one vector per field, row-major.
#[derive(Debug, Default, Clone, PartialEq)]
pub(super) struct Piece {
    /// `[3, H, W]`
    pub blur: Vec<f32>,
    /// From the start of the exposure, `[first + n, BINS, H, W]`
    pub voxel: Vec<f32>,
    /// `[n, 1, H, W]`
    pub sparse: Vec<f32>,
    /// `[n, 1, H, W]`
    pub depth: Vec<f32>,
    /// `[n, 3, H, W]`
    pub sharp: Vec<f32>,
    /// `[n, 1, H, W]`
    pub event_grey: Vec<f32>,
    /// `[n, 1, H, W]`
    pub edges: Vec<f32>,
    /// `[n, 1, H, W]`
    pub movers: Vec<f32>,
}

/// Cuts examples; holds the raster's memory for one side length.
pub(super) struct Cutter {
    side: usize,
    raster: VoxelRaster,
    voxel: Vec<f32>,
    /// Depth beyond this is no truth, metres.
    depth_max_m: f32,
}

impl Cutter {
    pub(super) fn new(side: usize, depth_max_m: f32) -> Result<Self, RasterError> {
        let map = PixelMap::rescaled(&Rescale::identity(Grid::new(side as u32, side as u32))?);
        let raster = VoxelRaster::new(STEPS, map)?;
        Ok(Self {
            side,
            voxel: vec![0.0; raster.shape().len()],
            raster,
            depth_max_m,
        })
    }

    /// Carries out `cut`, whose side is this cutter's.
    pub(super) fn cut(
        &mut self,
        example: &Example,
        cut: &Cut,
        wanted: Wanted,
        chance: &mut Chance,
    ) -> Result<Piece, RasterError> {
        debug_assert_eq!(cut.side, self.side);
        let size = example.size;
        let (first, count) = cut.window;
        let area = self.side * self.side;
        let steps =
            |planes: usize| first * planes * size * size..(first + count) * planes * size * size;
        let brighten = (cut.gain as f32).powf(1.0 / GAMMA);
        let shade = |code: u8| (f32::from(code) / 255.0 * brighten).min(1.0);
        let known = |depth: f32| {
            if depth <= self.depth_max_m {
                depth
            } else {
                0.0
            }
        };

        let events = self.events(example, cut, chance);
        let exposure = Exposure::from_micros(0, u64::from(example.exposure_us))?;
        self.raster.raster(exposure, &events, &mut self.voxel)?;
        let mut sparse = cut.planes(&example.sparse[steps(1)], size, |depth| depth);
        for depth in sparse.iter_mut().filter(|depth| **depth > 0.0) {
            if chance.happens(cut.return_drop) {
                *depth = 0.0;
            }
        }
        let mut piece = Piece {
            blur: cut.planes(&example.blur, size, shade),
            voxel: self.voxel[..(first + count) * BINS * area].to_vec(),
            sparse,
            depth: cut.planes(&example.depth[steps(1)], size, known),
            ..Piece::default()
        };
        if let Some((domain, contrast)) = wanted.pictures {
            piece.sharp = cut.planes(&example.sharp[steps(3)], size, shade);
            let sums = event_sums(&events, example.exposure_us, self.side);
            piece.event_grey = event_grey(&piece.blur, &sums, domain, contrast as f32)
                [first * area..(first + count) * area]
                .to_vec();
        }
        if wanted.movers {
            let flag = |mover: bool| f32::from(u8::from(mover));
            piece.movers = cut.planes(&example.movers[steps(1)], size, flag);
        }
        if wanted.edges {
            piece.edges = self.edges(&piece.depth);
        }
        Ok(piece)
    }

    /// The events within the cut in its own pixels, some lost and some made up.
    fn events(&self, example: &Example, cut: &Cut, chance: &mut Chance) -> Vec<PackedEvent> {
        let side = self.side as u32;
        let place = |x: u32, y: u32| {
            let (x, y) = (x.wrapping_sub(cut.x0 as u32), y.wrapping_sub(cut.y0 as u32));
            (x < side && y < side).then(|| (if cut.flip { side - 1 - x } else { x }, y))
        };
        let pack = |t_us: u32, (x, y): (u32, u32), on: bool| {
            PackedEvent::new(t_us, x as u16, y as u16, on).ok()
        };
        let mut events: Vec<PackedEvent> = example
            .events
            .iter()
            .filter_map(|event| {
                let place = place(event.x(), event.y())?;
                pack(event.t_us, place, event.is_on())
            })
            .collect();
        if cut.event_drop > 0.0 {
            events.retain(|_| !chance.happens(cut.event_drop));
        }
        let made_up = (cut.event_noise * f64::from(side * side)).round() as usize;
        for _ in 0..made_up {
            let t_us = chance.below(example.exposure_us.max(1) as usize) as u32;
            let at = (
                chance.below(self.side) as u32,
                chance.below(self.side) as u32,
            );
            events.extend(pack(t_us, at, chance.happens(0.5)));
        }
        events
    }

    fn edges(&self, depth: &[f32]) -> Vec<f32> {
        let area = self.side * self.side;
        let size = Size::new(self.side, self.side).expect("a raster of this side exists");
        let mut band = vec![false; area];
        depth
            .chunks_exact(area)
            .flat_map(|depth| {
                edge_band(depth, size, &mut band).expect("lengths are equal");
                band.iter()
                    .map(|&near| f32::from(u8::from(near)))
                    .collect::<Vec<_>>()
            })
            .collect()
    }
}

/// Signed events from the opening to each step's centre, `[T, H, W]`.
fn event_sums(events: &[PackedEvent], exposure_us: u32, side: usize) -> Vec<f32> {
    let area = side * side;
    let mut sums = vec![0.0f32; STEPS * area];
    for event in events {
        // Step k's centre lies at (k + 1/2) / T of the exposure: the first one after the event.
        let step =
            (u64::from(event.t_us) * 2 * STEPS as u64 / u64::from(exposure_us.max(1))).div_ceil(2);
        if let Ok(step @ 0..STEPS) = usize::try_from(step) {
            let cell = event.y() as usize * side + event.x() as usize;
            sums[step * area + cell] += if event.is_on() { 1.0 } else { -1.0 };
        }
    }
    for cell in area..STEPS * area {
        sums[cell] += sums[cell - area];
    }
    sums
}

/// Grey at the step centres as the event double integral has it (paper, eq. 10), `[T, H, W]`.
fn event_grey(blur: &[f32], sums: &[f32], domain: Domain, contrast: f32) -> Vec<f32> {
    let area = blur.len() / 3;
    let gamma = match domain {
        Domain::Linear => GAMMA,
        Domain::Encoded => 1.0,
    };
    let (decode, encode) = (|v: f32| v.powf(gamma), |v: f32| v.powf(1.0 / gamma));
    let mut grey = vec![0.0; sums.len()];
    for cell in 0..area {
        let mean: f32 = (0..3)
            .map(|c| GREY[c] * decode(blur[c * area + cell]))
            .sum();
        let rise = |step: usize| (contrast * sums[step * area + cell]).exp();
        let total = (0..STEPS).map(rise).sum::<f32>() / STEPS as f32;
        for step in 0..STEPS {
            grey[step * area + cell] = encode(mean * rise(step) / total).min(1.0);
        }
    }
    grey
}

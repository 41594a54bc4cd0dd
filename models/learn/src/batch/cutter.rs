//! Carries out cuts: an example's square, varied and rastered, as it enters a batch.

use noctule_depth::{Size, edge_band};
use noctule_raster::{
    BINS, Exposure, Grid, PackedEvent, PixelMap, RasterError, Rescale, VoxelRaster,
};
use noctule_world::STEPS;

use super::crop::Crop;
use super::cut::{Cut, GAMMA, GREY, Piece, Wanted};
use super::integral::{event_grey, event_sums};
use super::pixels;
use super::vary::Purpose;
use crate::cache::Example;
use crate::chance::Chance;

/// Cuts examples; holds the raster's memory for one side length.
pub(super) struct Cutter {
    side: usize,
    raster: VoxelRaster,
    voxel: Vec<f32>,
    /// Depth beyond this is no truth, metres.
    depth_max_m: f32,
    /// Light of each code, white 1.
    light: Box<[f32; 256]>,
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
            light: Box::new(std::array::from_fn(|code| {
                (code as f32 / 255.0).powf(GAMMA)
            })),
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
        debug_assert_eq!(cut.crop.side, self.side);
        let crop = &cut.crop;
        let size = example.size;
        let (first, count) = cut.window;
        let area = self.side * self.side;
        let steps =
            |planes: usize| first * planes * size * size..(first + count) * planes * size * size;
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
        let mut sparse = crop.points(&example.sparse[steps(1)], size);
        cut.vary.returns(&mut sparse, &crop.rows());
        for depth in sparse.iter_mut().filter(|depth| **depth > 0.0) {
            if chance.happens(cut.return_drop) {
                *depth = 0.0;
            }
        }
        let mut blur = self.shaded(&example.blur, size, cut);
        cut.vary.picture(&mut blur, GAMMA);
        let mut piece = Piece {
            blur,
            voxel: self.voxel[..(first + count) * BINS * area].to_vec(),
            sparse,
            depth: crop.planes(&example.depth[steps(1)], size, known),
            ..Piece::default()
        };
        if let Some((domain, contrast)) = wanted.pictures {
            piece.sharp = self.shaded(&example.sharp[steps(3)], size, cut);
            let sums = event_sums(&events, example.exposure_us, self.side);
            // An event stands for a higher threshold where it was raised.
            let contrast = (contrast * cut.vary.threshold) as f32;
            piece.event_grey = event_grey(&piece.blur, &sums, domain, contrast)
                [first * area..(first + count) * area]
                .to_vec();
        }
        if wanted.movers {
            let flag = |mover: bool| f32::from(u8::from(mover));
            piece.movers = crop.planes(&example.movers[steps(1)], size, flag);
        }
        if wanted.edges {
            piece.edges = self.edges(&piece.depth);
        }
        Ok(piece)
    }

    /// Planes of codes as encoded values, with the cut's gain on their light.
    fn shaded(&self, codes: &[u8], size: usize, cut: &Cut) -> Vec<f32> {
        let gain = cut.gain as f32;
        if cut.crop.is_enlarged() {
            let encode = |light: f32| (light * gain).min(1.0).powf(1.0 / GAMMA);
            return cut.crop.blended(codes, size, &self.light, encode);
        }
        let brighten = gain.powf(1.0 / GAMMA);
        let shade = |code: u8| (f32::from(code) / 255.0 * brighten).min(1.0);
        cut.crop.planes(codes, size, shade)
    }

    /// The events within the cut in its own pixels: seen by other event pixels, laid out, some
    /// lost and some made up.
    fn events(&self, example: &Example, cut: &Cut, chance: &mut Chance) -> Vec<PackedEvent> {
        let mut events = cut.crop.laid_out(self.seen(example, cut));
        if cut.event_drop > 0.0 {
            events.retain(|_| !chance.happens(cut.event_drop));
        }
        let area = self.side * self.side;
        let made_up = (cut.event_noise * area as f64).round() as usize;
        for _ in 0..made_up {
            let t_us = chance.below(example.exposure_us.max(1) as usize) as u32;
            let at = (
                chance.below(self.side) as u32,
                chance.below(self.side) as u32,
            );
            let made_up = PackedEvent::new(t_us, at.0 as u16, at.1 as u16, chance.happens(0.5));
            events.extend(made_up);
        }
        events
    }

    /// The events within the square, in its own pixels, as the cut's event pixels see them.
    fn seen(&self, example: &Example, cut: &Cut) -> Vec<PackedEvent> {
        let (crop, vary) = (&cut.crop, &cut.vary);
        let mut events = crop.inside(&example.events);
        if vary.lag_us > 0.0 {
            let light = self.grey_light(example, crop);
            let close_us = example.exposure_us;
            events = pixels::slow_down(&events, crop.span, close_us, vary.lag_us, &light);
        }
        if vary.threshold > 1.0 {
            let mut chance = vary.chance(Purpose::Threshold);
            pixels::raise_threshold(&mut events, crop.span, vary.threshold, &mut chance);
        }
        if vary.dead_us > 0.0 {
            pixels::rest(&mut events, crop.span, vary.dead_us);
        }
        events
    }

    /// Grey light of the blurred picture in the square's own pixels, white 1.
    fn grey_light(&self, example: &Example, crop: &Crop) -> Vec<f32> {
        let own = Crop {
            side: crop.span,
            flip: false,
            ..*crop
        };
        let planes = own.planes(&example.blur, example.size, |code: u8| {
            self.light[usize::from(code)]
        });
        let area = crop.span * crop.span;
        let grey = |cell: usize| (0..3).map(|c| GREY[c] * planes[c * area + cell]).sum();
        (0..area).map(grey).collect()
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

#[cfg(test)]
mod tests {
    use noctule_world::Tier;

    use super::*;
    use crate::batch::vary::Vary;
    use crate::settings::{Augment, Domain};

    const SIZE: usize = 64;
    const SIDE: usize = 32;

    fn strong() -> Augment {
        Augment {
            flip: 0.5,
            zoom: 0.5,
            zoom_max: 3.0,
            event_threshold_max: 3.0,
            event_lag_us_max: 300.0,
            event_dead_us_max: 3000.0,
            ring_drop_max: 0.5,
            ring_stride_max: 3,
            range_noise_m_max: 0.1,
            read_noise_max: 0.02,
            picture_bits_min: 6,
            ..Augment::default()
        }
    }

    fn drawn(augment: &Augment, seed: u64) -> Cut {
        Cut::random(augment, SIZE, SIDE, (2, 4), &mut Chance::of(&[seed]))
    }

    fn made(example: &Example, cut: &Cut) -> Piece {
        let wanted = Wanted {
            pictures: Some((Domain::Linear, 0.25)),
            edges: true,
            movers: true,
        };
        let mut cutter = Cutter::new(cut.crop.side, 80.0).expect("a cutter");
        let piece = cutter.cut(example, cut, wanted, &mut Chance::of(&[1]));
        piece.expect("a piece")
    }

    #[test]
    fn turning_one_on_does_not_move_the_others() {
        let none = Augment {
            flip: 0.5,
            ..Augment::default()
        };
        for seed in 0..100 {
            let (all, few) = (drawn(&strong(), seed), drawn(&none, seed));
            let key = all.vary.key;
            assert_eq!(few.vary, Vary { key, ..Vary::NONE });
            assert_eq!(all.crop.flip, few.crop.flip);
            let mut unzoomed = strong();
            unzoomed.zoom = 0.0;
            assert_eq!(drawn(&unzoomed, seed).crop, few.crop);
            assert!(!few.crop.is_enlarged() && all.crop.span * 3 >= SIDE - 1);
            assert!(all.crop.x0 + all.crop.span <= SIZE && all.crop.y0 + all.crop.span <= SIZE);
        }
        let enlarged = (0..100).filter(|seed| drawn(&strong(), *seed).crop.is_enlarged());
        assert!((30..70).contains(&enlarged.count()));
    }

    #[test]
    fn crops_are_laid_over_outlines_of_movers() {
        let mut example = Example::render(7, Tier::B, SIZE).expect("an example");
        example.movers.fill(false);
        let plain = |seed| drawn(&Augment::default(), seed);
        let laid = |example: &Example, seed, probability| {
            let mut cut = plain(seed);
            cut.over_movers(example, probability);
            assert_eq!(
                (cut.crop.span, cut.crop.flip),
                (SIDE, plain(seed).crop.flip)
            );
            (cut.crop.x0, cut.crop.y0)
        };
        let was = |seed| (plain(seed).crop.x0, plain(seed).crop.y0);
        assert!((0..100).all(|seed| laid(&example, seed, 1.0) == was(seed)));
        // Nor has a band from side to side an outline in any row.
        for step in example.movers.chunks_exact_mut(SIZE * SIZE) {
            step[10 * SIZE..20 * SIZE].fill(true);
        }
        assert!((0..100).all(|seed| laid(&example, seed, 1.0) == was(seed)));
        example.movers.fill(false);
        // The window is of steps 3 to 6.
        for (step, x, y) in [(2, 5, 5), (4, 40, 61), (7, 60, 2)] {
            example.movers[((step - 1) * SIZE + y) * SIZE + x] = true;
        }
        let corners: Vec<_> = (0..200).map(|seed| laid(&example, seed, 1.0)).collect();
        assert!(corners.iter().all(|(_, y0)| *y0 == SIZE - SIDE));
        let columns = || corners.iter().map(|(x0, _)| *x0);
        assert_eq!((columns().min(), columns().max()), (Some(17), Some(32)));
        let moved = (0..200).filter(|seed| laid(&example, *seed, 0.5) != was(*seed));
        assert!((70..=130).contains(&moved.count()));
    }

    #[test]
    fn each_change_touches_its_own_field_alone() {
        let example = Example::render(7, Tier::B, SIZE).expect("an example");
        let plain = made(&example, &drawn(&Augment::default(), 4));
        let count = |values: &[f32]| values.iter().filter(|v| **v != 0.0).count();
        let with = |change: &dyn Fn(&mut Vary)| {
            let mut cut = drawn(&Augment::default(), 4);
            change(&mut cut.vary);
            assert_eq!(made(&example, &cut), made(&example, &cut));
            made(&example, &cut)
        };
        for change in [
            &(|vary: &mut Vary| vary.lag_us = 500.0) as &dyn Fn(&mut Vary),
            &|vary| vary.threshold = 2.5,
            &|vary| vary.dead_us = 20_000.0,
        ] {
            let piece = with(change);
            assert!(count(&piece.voxel) < count(&plain.voxel) && count(&piece.voxel) > 0);
            let (voxel, event_grey) = (plain.voxel.clone(), plain.event_grey.clone());
            let rest = Piece {
                voxel,
                event_grey,
                ..piece
            };
            assert_eq!(rest, plain);
        }
        for change in [
            &(|vary: &mut Vary| vary.ring_drop = 0.5) as &dyn Fn(&mut Vary),
            &|vary| vary.ring_stride = 3,
            &|vary| vary.range_noise_m = 0.1,
        ] {
            let piece = with(change);
            assert!(piece.sparse != plain.sparse && count(&piece.sparse) <= count(&plain.sparse));
            let sparse = plain.sparse.clone();
            assert_eq!(Piece { sparse, ..piece }, plain);
        }
        for change in [
            &(|vary: &mut Vary| vary.read_noise = 0.02) as &dyn Fn(&mut Vary),
            &|vary| vary.bits = 5,
        ] {
            let piece = with(change);
            assert_ne!(piece.blur, plain.blur);
            let (blur, event_grey) = (plain.blur.clone(), plain.event_grey.clone());
            let rest = Piece {
                blur,
                event_grey,
                ..piece
            };
            assert_eq!(rest, plain);
        }
    }

    /// Fewer events, each worth more: the grey they imply keeps its contrast.
    #[test]
    fn a_raised_threshold_raises_what_an_event_stands_for() {
        let example = Example::render(7, Tier::B, SIZE).expect("an example");
        let spread = |threshold: f64| {
            let mut cut = drawn(&Augment::default(), 4);
            cut.vary.threshold = threshold;
            let grey = made(&example, &cut).event_grey;
            let area = SIDE * SIDE;
            let steps = grey[..area].iter().zip(&grey[3 * area..]);
            steps.map(|(a, b)| f64::from((a - b).abs())).sum::<f64>()
        };
        let ratio = spread(2.0) / spread(1.0);
        assert!((0.6..1.4).contains(&ratio), "{ratio}");
    }

    #[test]
    fn an_enlarged_cut_keeps_depth_and_density() {
        let example = Example::render(9, Tier::B, SIZE).expect("an example");
        let cut = |span: usize| {
            let mut cut = Cut::whole(SIZE);
            cut.crop = Crop {
                x0: 8,
                y0: 24,
                span,
                ..cut.crop
            };
            cut
        };
        let mut small = cut(32);
        small.crop.side = 32;
        let (small, large) = (made(&example, &small), made(&example, &cut(32)));
        let count = |values: &[f32]| values.iter().filter(|v| **v > 0.0).count();
        assert_eq!(count(&large.sparse), count(&small.sparse));
        assert_eq!(count(&large.depth), 4 * count(&small.depth));
        assert_eq!(count(&large.movers), 4 * count(&small.movers));
        let sum = |values: &[f32]| values.iter().map(|v| f64::from(*v)).sum::<f64>();
        assert!((sum(&large.voxel) - 4.0 * sum(&small.voxel)).abs() < 1e-3);
        let (a, b) = (sum(&large.blur) / 4.0, sum(&small.blur));
        assert!((a / b - 1.0).abs() < 0.05, "{a} {b}");
    }
}

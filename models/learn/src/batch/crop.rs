//! A square of an example, enlarged or not, mirrored or not.
//!
//! An enlarged square is what a longer lens, or a sensor of more pixels, would have seen of the
//! same moment: depth along the axis stays what it is. Depth and masks are taken from the nearest
//! pixel; the picture is blended from the four around, in linear light. A return stays one point,
//! so they lie thinner. An event fires in every pixel that its own pixel is enlarged to: what fires
//! in a pixel depends on how the contrast in it changes, not on its size, so voxels hold what they
//! would have held.

use std::ops::Range;

use noctule_depth::Ground;
use noctule_raster::PackedEvent;

/// Which square is taken, and how it is laid on the cut.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Crop {
    /// First column in the example.
    pub x0: usize,
    /// First row in the example.
    pub y0: usize,
    /// Side of the square in the example, at most `side`.
    pub span: usize,
    /// Side of the cut.
    pub side: usize,
    /// Left and right exchanged.
    pub flip: bool,
}

/// Two neighbours along one axis, and the second one's weight.
type Blend = (usize, usize, f32);

impl Crop {
    /// Whether it is enlarged.
    pub(super) fn is_enlarged(&self) -> bool {
        self.span < self.side
    }

    /// Offset in the square of the pixel nearest to pixel `i` of the cut.
    fn nearest(&self, i: usize) -> usize {
        (2 * i + 1) * self.span / (2 * self.side)
    }

    /// The cut's column, which a mirror exchanges.
    fn column(&self, x: usize) -> usize {
        if self.flip { self.side - 1 - x } else { x }
    }

    /// Row in the example of each row of the cut.
    pub(super) fn rows(&self) -> Vec<usize> {
        (0..self.side).map(|y| self.y0 + self.nearest(y)).collect()
    }

    fn columns(&self) -> Vec<usize> {
        let column = |x| self.x0 + self.nearest(self.column(x));
        (0..self.side).map(column).collect()
    }

    /// The example's ground in the cut's own pixels.
    pub(super) fn ground(&self, ground: &Ground) -> Ground {
        let cut = ground.cut(self.x0, self.y0);
        let cut = cut.enlarged(self.side as f64 / self.span as f64);
        if self.flip {
            cut.mirrored(self.side)
        } else {
            cut
        }
    }

    /// Planes of `size` by `size`, cut by the nearest pixel.
    pub(super) fn planes<V: Copy, W>(
        &self,
        field: &[V],
        size: usize,
        map: impl Fn(V) -> W,
    ) -> Vec<W> {
        let (rows, columns) = (self.rows(), self.columns());
        let planes = field.len() / (size * size);
        let mut out = Vec::with_capacity(planes * self.side * self.side);
        for plane in field.chunks_exact(size * size) {
            for row in &rows {
                let line = &plane[row * size..][..size];
                out.extend(columns.iter().map(|&column| map(line[column])));
            }
        }
        out
    }

    /// Planes of points, each of which stays one: 0 where none fell.
    pub(super) fn points(&self, field: &[f32], size: usize) -> Vec<f32> {
        if !self.is_enlarged() {
            return self.planes(field, size, |depth| depth);
        }
        let area = self.side * self.side;
        let place = |i: usize| (2 * i + 1) * self.side / (2 * self.span);
        let columns: Vec<usize> = (0..self.span).map(|x| self.column(place(x))).collect();
        let mut out = vec![0.0; field.len() / (size * size) * area];
        for (plane, out) in field
            .chunks_exact(size * size)
            .zip(out.chunks_exact_mut(area))
        {
            for y in 0..self.span {
                let line = &plane[(self.y0 + y) * size + self.x0..][..self.span];
                let out = &mut out[place(y) * self.side..][..self.side];
                for (depth, column) in line.iter().zip(&columns) {
                    if *depth > 0.0 {
                        out[*column] = *depth;
                    }
                }
            }
        }
        out
    }

    /// Planes of codes as light (`light` of each code), blended from the four pixels around and
    /// then encoded.
    pub(super) fn blended(
        &self,
        field: &[u8],
        size: usize,
        light: &[f32; 256],
        encode: impl Fn(f32) -> f32,
    ) -> Vec<f32> {
        let rows: Vec<Blend> = (0..self.side).map(|y| self.blend(y, self.y0)).collect();
        let column = |x| self.blend(self.column(x), self.x0);
        let columns: Vec<Blend> = (0..self.side).map(column).collect();
        let mut out = Vec::with_capacity(field.len() / (size * size) * self.side * self.side);
        for plane in field.chunks_exact(size * size) {
            for &(above, below, down) in &rows {
                let (above, below) = (
                    &plane[above * size..][..size],
                    &plane[below * size..][..size],
                );
                out.extend(columns.iter().map(|&(left, right, across)| {
                    let at = |line: &[u8], column: usize| light[usize::from(line[column])];
                    let mix = |a: f32, b: f32, share: f32| a + share * (b - a);
                    let above = mix(at(above, left), at(above, right), across);
                    let below = mix(at(below, left), at(below, right), across);
                    encode(mix(above, below, down))
                }));
            }
        }
        out
    }

    fn blend(&self, i: usize, first: usize) -> Blend {
        let at = (i as f32 + 0.5) * self.span as f32 / self.side as f32 - 0.5;
        let at = at.clamp(0.0, (self.span - 1) as f32);
        let before = at.floor() as usize;
        let after = (before + 1).min(self.span - 1);
        (first + before, first + after, at - before as f32)
    }

    /// Events within the square, in its own pixels.
    pub(super) fn inside(&self, events: &[PackedEvent]) -> Vec<PackedEvent> {
        let span = self.span as u32;
        let within = |event: &PackedEvent| {
            let x = event.x().wrapping_sub(self.x0 as u32);
            let y = event.y().wrapping_sub(self.y0 as u32);
            let is_inside = x < span && y < span;
            is_inside
                .then(|| PackedEvent::new(event.t_us, x as u16, y as u16, event.is_on()).ok())?
        };
        events.iter().filter_map(within).collect()
    }

    /// Events of the square, each in all pixels of the cut that its own one is enlarged to.
    pub(super) fn laid_out(&self, mut events: Vec<PackedEvent>) -> Vec<PackedEvent> {
        let at = |event: &PackedEvent, x: usize, y: usize| {
            PackedEvent::new(event.t_us, x as u16, y as u16, event.is_on()).ok()
        };
        if !self.is_enlarged() {
            if self.flip {
                events.retain_mut(|event| {
                    let moved = at(event, self.column(event.x() as usize), event.y() as usize);
                    moved.map(|moved| *event = moved).is_some()
                });
            }
            return events;
        }
        let reach = self.reach();
        let growth = self.side as f64 / self.span as f64;
        let mut out = Vec::with_capacity((events.len() as f64 * growth * growth) as usize);
        for event in &events {
            for y in reach[event.y() as usize].clone() {
                let columns = reach[event.x() as usize].clone();
                out.extend(columns.filter_map(|x| at(event, self.column(x), y)));
            }
        }
        out
    }

    /// For each pixel along the square's side, the pixels of the cut nearest to it.
    fn reach(&self) -> Vec<Range<usize>> {
        let mut reach = vec![0..0; self.span];
        for i in 0..self.side {
            let range = &mut reach[self.nearest(i)];
            *range = if range.start == range.end {
                i..i + 1
            } else {
                range.start..i + 1
            };
        }
        reach
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const SIZE: usize = 32;

    fn crops() -> impl Strategy<Value = Crop> {
        (
            1_usize..=SIZE,
            0_usize..40,
            0_usize..32,
            0_usize..32,
            any::<bool>(),
        )
            .prop_map(|(span, more, x, y, flip)| Crop {
                x0: x % (SIZE - span + 1),
                y0: y % (SIZE - span + 1),
                span,
                side: span + more,
                flip,
            })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]

        /// Points, maps and events of one pixel land on one another.
        #[test]
        fn fields_stay_on_one_another(crop in crops()) {
            let field: Vec<f32> = (1..=SIZE * SIZE).map(|i| i as f32).collect();
            let map = crop.planes(&field, SIZE, |v| v);
            let points = crop.points(&field, SIZE);
            let ground = Ground {
                per_column: 0.01,
                per_row: 0.1,
                first: -1.0,
            };
            let seen = crop.ground(&ground);
            for (cell, source) in map.iter().enumerate() {
                let (x, y) = (cell % crop.side, cell / crop.side);
                let source = *source as usize - 1;
                let wanted = ground.inverse_depth((source % SIZE) as f32, (source / SIZE) as f32);
                let found = seen.inverse_depth(x as f32, y as f32);
                // Half a pixel off, at most, where pixels are repeated.
                let off = if crop.is_enlarged() { 0.056 } else { 1e-5 };
                prop_assert!((found - wanted).abs() <= off, "{found} and {wanted} at {x}, {y}");
            }
            prop_assert_eq!(points.iter().filter(|v| **v > 0.0).count(), crop.span * crop.span);
            prop_assert!(points.iter().zip(&map).all(|(p, m)| *p == 0.0 || p == m));
            let all: Vec<PackedEvent> = (0..SIZE * SIZE)
                .map(|i| PackedEvent::new(i as u32, (i % SIZE) as u16, (i / SIZE) as u16, true).expect("small"))
                .collect();
            let laid = crop.laid_out(crop.inside(&all));
            prop_assert_eq!(laid.len(), crop.side * crop.side);
            prop_assert!(laid.windows(2).all(|pair| pair[0].t_us <= pair[1].t_us));
            for event in laid {
                let cell = event.y() as usize * crop.side + event.x() as usize;
                prop_assert_eq!(map[cell], event.t_us as f32 + 1.0);
            }
        }

        /// A ramp stays a ramp; without enlargement blending changes nothing.
        #[test]
        fn pictures_are_blended_evenly(crop in crops()) {
            let field: Vec<u8> = (0..SIZE * SIZE).map(|i| (8 * (i % SIZE)) as u8).collect();
            let light: [f32; 256] = std::array::from_fn(|code| code as f32);
            let blended = crop.blended(&field, SIZE, &light, |light| light);
            let nearest = crop.planes(&field, SIZE, f32::from);
            for (row, nearest) in blended.chunks(crop.side).zip(nearest.chunks(crop.side)) {
                let rises = |pair: &[f32]| match crop.flip {
                    true => pair[0] >= pair[1],
                    false => pair[0] <= pair[1],
                };
                prop_assert!(row.windows(2).all(rises), "{row:?}");
                prop_assert!(row.iter().zip(nearest).all(|(a, b)| (a - b).abs() <= 4.001));
            }
            if !crop.is_enlarged() {
                prop_assert_eq!(blended, nearest);
            }
        }
    }

    #[test]
    fn an_enlarged_square_is_twice_as_large() {
        let crop = Crop {
            x0: 1,
            y0: 0,
            span: 2,
            side: 4,
            flip: false,
        };
        let field = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0];
        let wanted = [
            1.0, 1.0, 2.0, 2.0, 1.0, 1.0, 2.0, 2.0, 4.0, 4.0, 5.0, 5.0, 4.0, 4.0, 5.0, 5.0,
        ];
        assert_eq!(crop.planes(&field, 3, |v| v), wanted);
        let points = crop.points(&field, 3);
        assert_eq!(points.iter().filter(|v| **v > 0.0).count(), 4);
        let event = PackedEvent::new(9, 2, 1, false).expect("small");
        let places: Vec<(u32, u32)> = crop
            .laid_out(crop.inside(&[event]))
            .iter()
            .map(|e| (e.x(), e.y()))
            .collect();
        assert_eq!(places, [(2, 2), (3, 2), (2, 3), (3, 3)]);
    }
}

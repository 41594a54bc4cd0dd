//! Which pixels a shape can touch.

use super::TILE;
use crate::object::CAMERA_HEIGHT_M;
use crate::optics::Optics;
use crate::snapshot::{NEAR_M, PlacedPaint, Placement};

/// Inclusive pixel rectangle, clipped to the image; empty when `left > right`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Bounds {
    pub left: i32,
    pub right: i32,
    pub top: i32,
    pub bottom: i32,
}

impl Bounds {
    const NONE: Self = Self {
        left: 1,
        right: 0,
        top: 1,
        bottom: 0,
    };

    /// Bounds of a shape in the observer's frame.
    pub(crate) fn of_shape(shape: &Placement, optics: &Optics) -> Self {
        match *shape {
            Placement::Box {
                centre,
                cos,
                sin,
                half,
            } => {
                // The observer's frame is reached by turning back.
                Self::of_corners(centre, [cos, sin], half, optics)
            }
            Placement::Capsule {
                x,
                z,
                radius,
                top_y,
                bottom_y,
            } => {
                let middle = 0.5 * (top_y + bottom_y);
                let half_height = 0.5 * (bottom_y - top_y) + radius;
                Self::of_corners(
                    [x, middle, z],
                    [1.0, 0.0],
                    [radius, half_height, radius],
                    optics,
                )
            }
        }
    }

    /// Bounds of a rectangle on the ground.
    pub(crate) fn of_paint(paint: &PlacedPaint, optics: &Optics) -> Self {
        let centre = [paint.x, CAMERA_HEIGHT_M, paint.z];
        let half = [paint.half[0] + 0.1, 0.0, paint.half[1] + 0.1];
        Self::of_corners(centre, [paint.cos, paint.sin], half, optics)
    }

    fn of_corners(c: [f32; 3], [cos, sin]: [f32; 2], h: [f32; 3], optics: &Optics) -> Self {
        let corner = |i: usize| {
            let x = if i & 1 == 0 { -h[0] } else { h[0] };
            let y = if i & 2 == 0 { -h[1] } else { h[1] };
            let z = if i & 4 == 0 { -h[2] } else { h[2] };
            [c[0] + cos * x + sin * z, c[1] + y, c[2] - sin * x + cos * z]
        };
        let mut range = Range::default();
        for i in 0..8 {
            let a = corner(i);
            range.add(a, optics);
            for bit in [1, 2, 4] {
                if i & bit == 0 {
                    range.add_crossing(a, corner(i | bit), optics);
                }
            }
        }
        range.clipped(optics.size)
    }

    pub(crate) fn touches_rows(&self, top: usize) -> bool {
        let top = top as i32;
        self.left <= self.right && self.top < top + TILE as i32 && self.bottom >= top
    }

    pub(crate) fn touches_columns(&self, left: usize) -> bool {
        let left = left as i32;
        self.left < left + TILE as i32 && self.right >= left
    }
}

/// Grows over projected points that lie before the near plane's nearer half.
struct Range {
    low: [f32; 2],
    high: [f32; 2],
}

impl Default for Range {
    fn default() -> Self {
        Self {
            low: [f32::INFINITY; 2],
            high: [f32::NEG_INFINITY; 2],
        }
    }
}

/// Half the distance at which anything is seen, so that clipping never cuts into a picture.
const CLIP_M: f32 = 0.5 * NEAR_M;

impl Range {
    fn add(&mut self, p: [f32; 3], optics: &Optics) {
        if p[2] >= CLIP_M {
            for axis in 0..2 {
                let pixel = optics.pixel(p[axis] / p[2]);
                self.low[axis] = self.low[axis].min(pixel);
                self.high[axis] = self.high[axis].max(pixel);
            }
        }
    }

    fn add_crossing(&mut self, a: [f32; 3], b: [f32; 3], optics: &Optics) {
        if (a[2] < CLIP_M) != (b[2] < CLIP_M) {
            let u = (CLIP_M - a[2]) / (b[2] - a[2]);
            self.add(
                [a[0] + u * (b[0] - a[0]), a[1] + u * (b[1] - a[1]), CLIP_M],
                optics,
            );
        }
    }

    fn clipped(&self, size: usize) -> Bounds {
        let last = size as f32 - 1.0;
        let outside = |axis: usize| self.high[axis] < -1.0 || self.low[axis] > last + 1.0;
        if self.low[0] > self.high[0] || outside(0) || outside(1) {
            return Bounds::NONE;
        }
        // One pixel of margin for rounding.
        let low = |axis: usize| (self.low[axis] - 1.0).clamp(0.0, last) as i32;
        let high = |axis: usize| (self.high[axis] + 2.0).clamp(0.0, last) as i32;
        Bounds {
            left: low(0),
            right: high(0),
            top: low(1),
            bottom: high(1),
        }
    }
}

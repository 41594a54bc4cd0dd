//! The plane in inverse depth through one return, fitted to the returns of the touching cells.

/// Relative difference of inverse depth, `(a - b) / (a + b)`, at which a neighbour counts a quarter.
const EDGE_SHARE: f32 = 0.15;
/// Neighbours that count less than this (root of the weight) bound nothing: they lie across an edge.
const SAME_SURFACE_MIN: f32 = 0.1;
/// Pull towards level, as a share of the neighbours' weight; decides directions nobody covers.
const LEVEL_PULL: f32 = 0.005;

/// A return, its slope, and the sums its slope is fitted from. Inverse depths in 1/m, places in px.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Surface {
    x: f32,
    y: f32,
    inverse: f32,
    slope_x: f32,
    slope_y: f32,
    /// Bounds: the inverse depths of the neighbours on the same surface.
    low: f32,
    high: f32,
    // Weighted sums over the neighbours of the products of run, rise and step.
    xx: f32,
    xy: f32,
    yy: f32,
    x_step: f32,
    y_step: f32,
    /// Squared distance to the nearest neighbour that lies more above or below than beside.
    rise_sq: f32,
    /// Pixels of the cell.
    pub(crate) area_px: u32,
}

impl Surface {
    pub(crate) fn new(x: f32, y: f32, inverse: f32) -> Self {
        Self {
            x,
            y,
            inverse,
            low: inverse,
            high: inverse,
            rise_sq: f32::INFINITY,
            ..Self::default()
        }
    }

    /// Lets two touching cells know each other.
    #[inline]
    pub(crate) fn meet(one: &mut Self, other: &mut Self) {
        let (dx, dy) = (other.x - one.x, other.y - one.y);
        let step = other.inverse - one.inverse;
        let contrast = step / ((one.inverse + other.inverse) * EDGE_SHARE);
        let nearness = 1.0 / (1.0 + contrast * contrast);
        let distance_sq = dx * dx + dy * dy;
        let weight = nearness * nearness / distance_sq;
        let same = nearness > SAME_SURFACE_MIN;
        let (a, b) = (one.inverse, other.inverse);
        for (surface, inverse) in [(one, b), (other, a)] {
            // All sums are even in the direction, so both ends take the same terms.
            surface.xx += weight * dx * dx;
            surface.xy += weight * dx * dy;
            surface.yy += weight * dy * dy;
            surface.x_step += weight * dx * step;
            surface.y_step += weight * dy * step;
            if same {
                surface.low = surface.low.min(inverse);
                surface.high = surface.high.max(inverse);
            }
            if dy.abs() > dx.abs() {
                surface.rise_sq = surface.rise_sq.min(distance_sq);
            }
        }
    }

    /// Solves the weighted least squares for the slope.
    pub(crate) fn settle(&mut self) {
        let pull = LEVEL_PULL * (self.xx + self.yy) + 1e-9;
        let (xx, yy) = (self.xx + pull, self.yy + pull);
        let determinant = xx * yy - self.xy * self.xy;
        self.slope_x = (yy * self.x_step - self.xy * self.y_step) / determinant;
        self.slope_y = (xx * self.y_step - self.xy * self.x_step) / determinant;
    }

    /// Inverse depth at a pixel, between the neighbours' and its own.
    #[inline]
    pub(crate) fn at(&self, x: f32, y: f32) -> f32 {
        let free = self.inverse + self.slope_x * (x - self.x) + self.slope_y * (y - self.y);
        free.max(self.low).min(self.high)
    }

    /// Distance to the next return above or below; `None` if there is none.
    pub(crate) fn rise_px(&self) -> Option<f32> {
        self.rise_sq.is_finite().then(|| self.rise_sq.sqrt())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Four neighbours on the plane 0.1 + 0.002 x - 0.001 y around (10, 10).
    #[test]
    fn the_slope_of_a_plane_is_found() {
        let plane = |x: f32, y: f32| 0.1 + 0.002 * x - 0.001 * y;
        let mut centre = Surface::new(10.0, 10.0, plane(10.0, 10.0));
        for (x, y) in [(13.0, 10.0), (7.0, 11.0), (10.0, 17.0), (9.0, 4.0)] {
            Surface::meet(&mut centre, &mut Surface::new(x, y, plane(x, y)));
        }
        centre.settle();
        assert!((centre.slope_x - 0.002).abs() < 4e-5, "{}", centre.slope_x);
        assert!((centre.slope_y + 0.001).abs() < 4e-5, "{}", centre.slope_y);
        assert!((centre.at(11.0, 9.0) - plane(11.0, 9.0)).abs() < 1e-4);
        assert_eq!(centre.rise_px(), Some(37.0_f32.sqrt()));
    }

    #[test]
    fn a_neighbour_across_an_edge_neither_tilts_nor_bounds() {
        let (mut near, mut far) = (Surface::new(0.0, 0.0, 0.5), Surface::new(2.0, 0.0, 0.02));
        Surface::meet(&mut near, &mut far);
        Surface::meet(&mut near, &mut Surface::new(-2.0, 0.0, 0.5));
        near.settle();
        assert!(near.slope_x.abs() < 1e-3);
        assert_eq!(near.at(1.0, 0.0), 0.5);
    }

    #[test]
    fn a_lone_return_is_level() {
        let mut lone = Surface::new(3.0, 3.0, 0.25);
        lone.settle();
        assert_eq!((lone.at(500.0, 0.0), lone.rise_px()), (0.25, None));
    }
}

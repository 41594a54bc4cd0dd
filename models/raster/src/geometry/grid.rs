//! Rectangles of pixels: a grid, a crop of a sensor, and the rescaling from one to the other.

use crate::RasterError;

/// Longest side of a grid or sensor, pixels; keeps every cell index well inside 32 bits.
const SIDE_MAX: u32 = 8192;

/// A rectangle of pixels, row-major, first row at the top.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Grid {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

impl Grid {
    /// A grid of `width` columns and `height` rows.
    #[must_use]
    pub const fn new(width: u32, height: u32) -> Self {
        Self { width, height }
    }

    /// Number of pixels.
    #[must_use]
    pub const fn cells(self) -> usize {
        self.width as usize * self.height as usize
    }

    /// The whole grid as a crop.
    #[must_use]
    pub const fn whole(self) -> Crop {
        Crop {
            x: 0,
            y: 0,
            width: self.width,
            height: self.height,
        }
    }

    /// # Errors
    /// [`RasterError::Size`], when a side is zero or longer than 8192 pixels.
    pub(crate) fn check(self, what: &'static str) -> Result<(), RasterError> {
        let side = 1..=SIDE_MAX;
        if side.contains(&self.width) && side.contains(&self.height) {
            return Ok(());
        }
        let (width, height) = (self.width, self.height);
        Err(RasterError::Size {
            what,
            width,
            height,
            limit: SIDE_MAX,
        })
    }
}

/// A rectangle inside a sensor, in the sensor's pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Crop {
    /// First column.
    pub x: u32,
    /// First row.
    pub y: u32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// Crops a rectangle out of a sensor and scales it to a grid; each axis has its own ratio.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Rescale {
    sensor: Grid,
    crop: Crop,
    grid: Grid,
}

impl Rescale {
    /// Maps `crop` of `sensor` onto `grid`.
    ///
    /// # Errors
    /// [`RasterError::Size`] for a rectangle without pixels or too long a side,
    /// [`RasterError::Crop`] for a crop that leaves the sensor.
    pub fn new(sensor: Grid, crop: Crop, grid: Grid) -> Result<Self, RasterError> {
        sensor.check("sensor")?;
        grid.check("grid")?;
        Grid::new(crop.width, crop.height).check("crop")?;
        let fits = |start: u32, len: u32, limit: u32| {
            start.checked_add(len).is_some_and(|end| end <= limit)
        };
        if fits(crop.x, crop.width, sensor.width) && fits(crop.y, crop.height, sensor.height) {
            return Ok(Self { sensor, crop, grid });
        }
        Err(RasterError::Crop {
            x: crop.x,
            y: crop.y,
            width: crop.width,
            height: crop.height,
            sensor_width: sensor.width,
            sensor_height: sensor.height,
        })
    }

    /// The identity: a sensor that is the grid.
    ///
    /// # Errors
    /// [`RasterError::Size`], as [`new`](Self::new).
    pub fn identity(grid: Grid) -> Result<Self, RasterError> {
        Self::new(grid, grid.whole(), grid)
    }

    /// The sensor that is cropped.
    #[must_use]
    pub const fn sensor(&self) -> Grid {
        self.sensor
    }

    /// The rectangle that is kept.
    #[must_use]
    pub const fn crop(&self) -> Crop {
        self.crop
    }

    /// The grid it is scaled to.
    #[must_use]
    pub const fn grid(&self) -> Grid {
        self.grid
    }

    /// Grid pixels per sensor pixel, (across, down).
    #[must_use]
    pub fn scale(&self) -> (f64, f64) {
        let ratio = |to: u32, from: u32| f64::from(to) / f64::from(from);
        (
            ratio(self.grid.width, self.crop.width),
            ratio(self.grid.height, self.crop.height),
        )
    }

    /// Where sensor pixel coordinates (u, v) lie in the grid; may be outside it.
    #[must_use]
    pub fn grid_from_sensor(&self, (u, v): (f64, f64)) -> (f64, f64) {
        let (sx, sy) = self.scale();
        (
            (u - f64::from(self.crop.x) + 0.5) * sx - 0.5,
            (v - f64::from(self.crop.y) + 0.5) * sy - 0.5,
        )
    }

    /// Where grid coordinates (u, v) lie on the sensor; the inverse of
    /// [`grid_from_sensor`](Self::grid_from_sensor).
    #[must_use]
    pub fn sensor_from_grid(&self, (u, v): (f64, f64)) -> (f64, f64) {
        let (sx, sy) = self.scale();
        (
            (u + 0.5) / sx - 0.5 + f64::from(self.crop.x),
            (v + 0.5) / sy - 0.5 + f64::from(self.crop.y),
        )
    }

    /// The grid column that holds the centre of sensor column `x`; `None` outside the crop.
    #[must_use]
    pub fn column(&self, x: u32) -> Option<u32> {
        axis_cell(x, self.crop.x, self.crop.width, self.grid.width)
    }

    /// The grid row that holds the centre of sensor row `y`; `None` outside the crop.
    #[must_use]
    pub fn row(&self, y: u32) -> Option<u32> {
        axis_cell(y, self.crop.y, self.crop.height, self.grid.height)
    }
}

/// Cell of the centre of pixel `at`, in integers: floor((at - start + 1/2) * to / from).
fn axis_cell(at: u32, start: u32, from: u32, to: u32) -> Option<u32> {
    let inside = at.checked_sub(start).filter(|offset| *offset < from)?;
    Some((2 * inside + 1) * to / (2 * from)) // below 2^28: sides are at most 8192
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rig() -> Rescale {
        let crop = Crop {
            x: 384,
            y: 104,
            width: 512,
            height: 512,
        };
        Rescale::new(Grid::new(1280, 720), crop, Grid::new(256, 256)).unwrap()
    }

    #[test]
    fn two_pixels_share_a_cell_at_half_size() {
        let map = rig();
        assert_eq!(
            [383, 384, 385, 386, 895, 896].map(|x| map.column(x)),
            [None, Some(0), Some(0), Some(1), Some(255), None]
        );
        assert_eq!(
            [103, 104, 105, 615, 616].map(|y| map.row(y)),
            [None, Some(0), Some(0), Some(255), None]
        );
    }

    #[test]
    fn a_ratio_of_five_to_three_goes_by_pixel_centres() {
        let map = Rescale::new(Grid::new(5, 5), Grid::new(5, 5).whole(), Grid::new(3, 3)).unwrap();
        // Centres 0.5, 1.5, .. 4.5 times 3/5: 0.3, 0.9, 1.5, 2.1, 2.7.
        assert_eq!(
            [0, 1, 2, 3, 4].map(|x| map.column(x)),
            [0, 0, 1, 2, 2].map(Some)
        );
    }

    #[test]
    fn coordinates_go_there_and_back_and_agree_with_cells() {
        let map = rig();
        for x in 384..896 {
            let (u, v) = map.grid_from_sensor((f64::from(x), 200.25));
            assert_eq!(map.column(x), Some((u + 0.5).floor() as u32));
            let back = map.sensor_from_grid((u, v));
            assert!((back.0 - f64::from(x)).abs() < 1e-12 && (back.1 - 200.25).abs() < 1e-12);
        }
    }

    #[test]
    fn bad_rectangles_are_named() {
        let (sensor, grid) = (Grid::new(1280, 720), Grid::new(256, 256));
        let crop = Crop {
            x: 800,
            y: 0,
            width: 512,
            height: 512,
        };
        let error = Rescale::new(sensor, crop, grid).unwrap_err();
        assert_eq!(
            error.to_string(),
            "crop 512x512 at (800, 0) leaves the 1280x720 sensor"
        );
        let crop = Crop {
            x: u32::MAX,
            y: 0,
            width: 2,
            height: 2,
        };
        assert!(matches!(
            Rescale::new(sensor, crop, grid),
            Err(RasterError::Crop { .. })
        ));
        let error = Rescale::identity(Grid::new(0, 4)).unwrap_err();
        assert_eq!(
            error.to_string(),
            "sensor is 0x4 pixels, each side must be 1..=8192"
        );
    }
}

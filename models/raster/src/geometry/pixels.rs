//! Which cell of the grid an event camera's pixel falls into, looked up rather than computed.

use nalgebra::{Point3, UnitQuaternion};

use super::{Grid, Pinhole, Rescale};
use crate::RasterError;
use crate::error::check_len;

/// Marks a sensor pixel that falls outside the grid, in a remap table.
pub const OUTSIDE: u32 = u32::MAX;

/// Side of the square of pixels a packed event can name.
const ADDRESSES: u32 = 2048;
/// Added to an offset of either axis to push the sum beyond every grid.
const FAR: u32 = 1 << 30;

/// Where each pixel of the event camera falls in the grid.
#[derive(Debug, Clone)]
pub struct PixelMap {
    grid: Grid,
    pub(crate) lookup: Lookup,
}

/// The tables behind a [`PixelMap`].
#[derive(Debug, Clone)]
pub(crate) enum Lookup {
    /// Cell = `columns[x] + rows[y]`; at least [`FAR`] outside. 2048 entries each.
    Axes {
        columns: Box<[u32]>,
        rows: Box<[u32]>,
    },
    /// Cell = `cells[y * width + x]`; [`OUTSIDE`] outside.
    Table { width: u32, cells: Box<[u32]> },
}

impl PixelMap {
    /// Crop and rescale: a pixel falls into the cell that holds its centre.
    #[must_use]
    pub fn rescaled(rescale: &Rescale) -> Self {
        let axis = |cell: &dyn Fn(u32) -> Option<u32>, stride: u32| {
            (0..ADDRESSES)
                .map(|at| cell(at).map_or(FAR, |cell| cell * stride))
                .collect()
        };
        let columns = axis(&|x| rescale.column(x), 1);
        let rows = axis(&|y| rescale.row(y), rescale.grid().width);
        Self {
            grid: rescale.grid(),
            lookup: Lookup::Axes { columns, rows },
        }
    }

    /// A precomputed table: `table[y * sensor.width + x]` is the row-major cell of `grid` that
    /// pixel (x, y) falls into, or [`OUTSIDE`].
    ///
    /// # Errors
    /// [`RasterError::Length`] for a table of another size than the sensor,
    /// [`RasterError::Remap`] for an entry that is neither a cell nor [`OUTSIDE`],
    /// [`RasterError::Size`] for an empty or oversized grid or sensor.
    pub fn remapped(sensor: Grid, table: Vec<u32>, grid: Grid) -> Result<Self, RasterError> {
        sensor.check("sensor")?;
        grid.check("grid")?;
        check_len("remap table", sensor.cells(), table.len())?;
        let cells = grid.cells();
        let wrong = |cell: &u32| *cell != OUTSIDE && *cell as usize >= cells;
        if let Some(index) = table.iter().position(wrong) {
            return Err(RasterError::Remap {
                index,
                cell: table[index],
                cells,
            });
        }
        let cells = table.into_boxed_slice();
        Ok(Self {
            grid,
            lookup: Lookup::Table {
                width: sensor.width,
                cells,
            },
        })
    }

    /// Undistorts every pixel of the event camera, turns its ray into the image camera's frame, and
    /// falls into the cell where the image camera sees it: exact for things far away against the
    /// distance between the two lenses.
    ///
    /// `events` is in pixels of the event sensor, `sensor` its size; `image` is in pixels of
    /// `grid`, that is, already [rescaled](Pinhole::rescaled).
    ///
    /// # Errors
    /// [`RasterError::Size`] for an empty or oversized grid or sensor.
    pub fn rotated(
        sensor: Grid,
        events: &Pinhole,
        image: &Pinhole,
        image_from_events: &UnitQuaternion<f64>,
        grid: Grid,
    ) -> Result<Self, RasterError> {
        sensor.check("sensor")?;
        let cell = |x: u32, y: u32| {
            let ray = events.unproject((f64::from(x), f64::from(y)))?;
            grid_cell(grid, image.project(&Point3::from(image_from_events * ray))?)
        };
        let rows = 0..sensor.height;
        let table = rows
            .flat_map(|y| (0..sensor.width).map(move |x| (x, y)))
            .map(|(x, y)| cell(x, y).unwrap_or(OUTSIDE))
            .collect();
        Self::remapped(sensor, table, grid)
    }

    /// The grid pixels are mapped to.
    #[must_use]
    pub const fn grid(&self) -> Grid {
        self.grid
    }

    /// Row-major cell of pixel (x, y); `None` when it falls outside the grid.
    #[must_use]
    pub fn cell(&self, x: u16, y: u16) -> Option<usize> {
        let (x, y) = (u32::from(x), u32::from(y));
        if x.max(y) >= ADDRESSES {
            return None;
        }
        let cell = match &self.lookup {
            Lookup::Axes { columns, rows } => axes_cell(columns, rows, x, y),
            Lookup::Table { width, cells } => table_cell(*width, cells, x, y),
        } as usize;
        (cell < self.grid.cells()).then_some(cell)
    }
}

/// Cell by axis; beyond every grid when outside. `columns` and `rows` cover every address.
#[inline(always)]
pub(crate) fn axes_cell(columns: &[u32], rows: &[u32], x: u32, y: u32) -> u32 {
    columns[x as usize] + rows[y as usize]
}

/// Cell by table; beyond every grid when outside.
#[inline(always)]
pub(crate) fn table_cell(width: u32, cells: &[u32], x: u32, y: u32) -> u32 {
    if x >= width {
        return OUTSIDE;
    }
    cells
        .get((y * width + x) as usize)
        .copied()
        .unwrap_or(OUTSIDE)
}

/// Row-major cell of the pixel that covers grid coordinates (u, v).
pub(crate) fn grid_cell(grid: Grid, (u, v): (f64, f64)) -> Option<u32> {
    let (column, row) = ((u + 0.5).floor(), (v + 0.5).floor());
    let inside = column >= 0.0
        && row >= 0.0
        && column < f64::from(grid.width)
        && row < f64::from(grid.height);
    inside.then(|| row as u32 * grid.width + column as u32) // both whole and inside the grid
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Crop, Distortion};

    #[test]
    fn axes_are_the_rescaling_and_nothing_outside_the_crop_is_inside() {
        let crop = Crop {
            x: 384,
            y: 104,
            width: 512,
            height: 512,
        };
        let rescale = Rescale::new(Grid::new(1280, 720), crop, Grid::new(256, 200)).unwrap();
        let map = PixelMap::rescaled(&rescale);
        for y in (0..720u16).chain([2047, 2048, u16::MAX]) {
            for x in (0..1280u16)
                .step_by(7)
                .chain([895, 896, 2047, 2048, u16::MAX])
            {
                let expected = rescale
                    .column(u32::from(x))
                    .zip(rescale.row(u32::from(y)))
                    .map(|(column, row)| (row * 256 + column) as usize);
                assert_eq!(map.cell(x, y), expected, "({x}, {y})");
            }
        }
    }

    #[test]
    fn a_camera_that_is_the_image_camera_maps_to_itself() {
        let lens = Distortion {
            k1: -0.2,
            k2: 0.05,
            p1: 1e-3,
            p2: 2e-3,
            k3: 0.0,
        };
        let camera = Pinhole::new(60.0, 61.0, 31.5, 23.5, lens).unwrap();
        let grid = Grid::new(64, 48);
        let map =
            PixelMap::rotated(grid, &camera, &camera, &UnitQuaternion::identity(), grid).unwrap();
        for (x, y) in [(0, 0), (63, 47), (31, 20), (5, 40)] {
            assert_eq!(map.cell(x, y), Some(usize::from(y) * 64 + usize::from(x)));
        }
        assert_eq!((map.cell(64, 0), map.cell(0, 48)), (None, None));
    }

    #[test]
    fn a_turned_camera_shifts_the_picture() {
        // A turn of atan(10/100) about y moves the axis by ten pixels to the right.
        let camera = Pinhole::new(100.0, 100.0, 32.0, 32.0, Distortion::default()).unwrap();
        let turn = UnitQuaternion::from_euler_angles(0.0, 0.1f64.atan(), 0.0);
        let grid = Grid::new(64, 64);
        let map = PixelMap::rotated(grid, &camera, &camera, &turn, grid).unwrap();
        assert_eq!(map.cell(32, 32), Some(32 * 64 + 42));
        assert_eq!(map.cell(60, 32), None);
    }

    #[test]
    fn bad_tables_are_named() {
        let grid = Grid::new(2, 2);
        let error = PixelMap::remapped(grid, vec![0; 3], grid).unwrap_err();
        assert_eq!(error.to_string(), "remap table has 3 elements, needs 4");
        let error = PixelMap::remapped(grid, vec![0, OUTSIDE, 4, 1], grid).unwrap_err();
        assert_eq!(
            error.to_string(),
            "remap entry 2 names cell 4 of a grid of 4"
        );
    }
}

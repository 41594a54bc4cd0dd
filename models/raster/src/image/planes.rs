//! Interleaved RGB of any stride and depth -> three planes on the network's grid.

use crate::error::check_len;
use crate::{Grid, RasterError, Rescale};

/// How a sample lies in memory, and which value is white.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Samples {
    /// One byte, 255 is 1.0.
    U8,
    /// Two bytes, low one first.
    U16Le {
        /// The value that is 1.0: 65,535, or 1,023 or 4,095 for 10 or 12 bits; brighter is clamped.
        white: u16,
    },
}

impl Samples {
    const fn bytes(self) -> usize {
        match self {
            Self::U8 => 1,
            Self::U16Le { .. } => 2,
        }
    }
}

/// A borrowed image: red, green, blue, red, .. row by row from the top.
#[derive(Debug, Clone, Copy)]
pub struct ImageView<'a> {
    /// The rows, the first one first; the last one need not be padded.
    pub data: &'a [u8],
    /// Columns and rows.
    pub size: Grid,
    /// Bytes from one row to the next.
    pub stride_bytes: usize,
    /// What a sample is.
    pub samples: Samples,
}

/// How the crop becomes the grid.
#[derive(Debug, Clone)]
enum Method {
    /// Mean over whole blocks of so many columns and rows; (1, 1) copies.
    Mean { across: usize, down: usize },
    /// Between the four neighbours, a tap per column and per row.
    Bilinear {
        columns: Box<[Tap]>,
        rows: Box<[Tap]>,
    },
}

/// Between two neighbouring samples.
#[derive(Debug, Clone, Copy)]
struct Tap {
    /// Earlier sample, sensor pixels.
    first: usize,
    /// Later sample; the same at the crop's edge.
    second: usize,
    /// Weight of the later one.
    weight: f32,
}

/// Crops, rescales and splits images into planes, `f32 [3, H, W]` in 0..=1, encoded as they came.
///
/// Where the crop is a whole multiple of the grid on both axes, a cell is the mean of its block of
/// pixels, summed in integers; otherwise it is interpolated between its four neighbours.
#[derive(Debug, Clone)]
pub struct ImagePlanes {
    rescale: Rescale,
    method: Method,
}

impl ImagePlanes {
    /// For images of the size of the sensor in `rescale`.
    #[must_use]
    pub fn new(rescale: Rescale) -> Self {
        let (crop, grid) = (rescale.crop(), rescale.grid());
        let whole = crop.width % grid.width == 0 && crop.height % grid.height == 0;
        let method = if whole {
            let ratio = |from: u32, to: u32| (from / to) as usize;
            Method::Mean {
                across: ratio(crop.width, grid.width),
                down: ratio(crop.height, grid.height),
            }
        } else {
            let at = |u: u32, v: u32| rescale.sensor_from_grid((f64::from(u), f64::from(v)));
            let columns = (0..grid.width).map(|u| tap(at(u, 0).0, crop.x, crop.width));
            let rows = (0..grid.height).map(|v| tap(at(0, v).1, crop.y, crop.height));
            Method::Bilinear {
                columns: columns.collect(),
                rows: rows.collect(),
            }
        };
        Self { rescale, method }
    }

    /// The crop and rescaling it does.
    #[must_use]
    pub const fn rescale(&self) -> &Rescale {
        &self.rescale
    }

    /// Elements of the planes, `[3, height, width]`.
    #[must_use]
    pub const fn planes_len(&self) -> usize {
        3 * self.rescale.grid().cells()
    }

    /// Fills `out`, `[3, height, width]`, from an image.
    ///
    /// # Errors
    /// [`RasterError::ImageSize`] for an image of another size than the sensor,
    /// [`RasterError::Setting`] for a white of 0, [`RasterError::Length`] for a stride shorter than
    /// a row, fewer bytes than rows need, or another `out`.
    pub fn write(&self, image: &ImageView<'_>, out: &mut [f32]) -> Result<(), RasterError> {
        let sensor = self.rescale.sensor();
        if image.size != sensor {
            return Err(RasterError::ImageSize {
                width: image.size.width,
                height: image.size.height,
                needed_width: sensor.width,
                needed_height: sensor.height,
            });
        }
        let row_bytes = 3 * image.samples.bytes() * sensor.width as usize;
        if image.stride_bytes < row_bytes {
            return Err(short(
                "bytes from image row to row",
                row_bytes,
                image.stride_bytes,
            ));
        }
        let needed = (sensor.height as usize - 1)
            .saturating_mul(image.stride_bytes)
            .saturating_add(row_bytes);
        if image.data.len() < needed {
            return Err(short("image in bytes", needed, image.data.len()));
        }
        check_len("image planes", self.planes_len(), out.len())?;
        match image.samples {
            Samples::U8 => self.fill(image, 255, |bytes, at| u32::from(bytes[at]), out),
            Samples::U16Le { white: 0 } => {
                let (name, max) = ("white", f64::from(u16::MAX));
                return Err(RasterError::Setting {
                    name,
                    value: 0.0,
                    min: 1.0,
                    max,
                });
            }
            Samples::U16Le { white } => self.fill(
                image,
                u32::from(white),
                |bytes, at| {
                    u32::from(u16::from_le_bytes([bytes[2 * at], bytes[2 * at + 1]]).min(white))
                },
                out,
            ),
        }
        Ok(())
    }

    /// `sample(row, index)` reads one sample of a row.
    #[inline(always)]
    fn fill(
        &self,
        image: &ImageView<'_>,
        white: u32,
        sample: impl Fn(&[u8], usize) -> u32 + Copy,
        out: &mut [f32],
    ) {
        let row_bytes = 3 * image.samples.bytes() * image.size.width as usize;
        let row = |y: usize| &image.data[y * image.stride_bytes..][..row_bytes];
        let (grid, crop) = (self.rescale.grid(), self.rescale.crop());
        let width = grid.width as usize;
        let (red, rest) = out.split_at_mut(grid.cells());
        let (green, blue) = rest.split_at_mut(grid.cells());
        let planes = red
            .chunks_exact_mut(width)
            .zip(green.chunks_exact_mut(width));
        let planes = planes.zip(blue.chunks_exact_mut(width)).enumerate();
        for (v, ((red, green), blue)) in planes {
            match &self.method {
                Method::Mean { across, down } => {
                    let first = crop.y as usize + v * down;
                    let rows = (first..first + down).map(row);
                    let whole = u64::from(white) * (across * down) as u64;
                    mean_row(
                        rows,
                        crop.x as usize,
                        *across,
                        whole,
                        sample,
                        [red, green, blue],
                    );
                }
                Method::Bilinear { columns, rows } => {
                    let tap = rows[v];
                    let pair = [row(tap.first), row(tap.second)];
                    bilinear_row(
                        pair,
                        tap.weight,
                        columns,
                        white as f32,
                        sample,
                        [red, green, blue],
                    );
                }
            }
        }
    }
}

fn short(what: &'static str, needed: usize, actual: usize) -> RasterError {
    RasterError::Length {
        what,
        needed,
        actual,
    }
}

/// The samples round sensor coordinate `at`, kept inside the crop.
fn tap(at: f64, start: u32, len: u32) -> Tap {
    let at = at.clamp(f64::from(start), f64::from(start + len - 1));
    let first = at.floor() as usize;
    let second = (first + 1).min((start + len - 1) as usize);
    Tap {
        first,
        second,
        weight: (at - first as f64) as f32,
    }
}

/// One output row of block means: exact sums, one division. `whole` is the sum of a white block.
#[inline(always)]
fn mean_row<'a>(
    rows: impl Iterator<Item = &'a [u8]> + Clone,
    first: usize,
    across: usize,
    whole: u64,
    sample: impl Fn(&[u8], usize) -> u32 + Copy,
    [red, green, blue]: [&mut [f32]; 3],
) {
    if whole >= 1 << f32::MANTISSA_DIGITS {
        return large_mean_row(rows, first, across, whole, sample, [red, green, blue]);
    }
    // Sums stay below 2^24: exact in the planes themselves.
    for (index, row) in rows.enumerate() {
        let planes = [&mut *red, &mut *green, &mut *blue];
        match across {
            1 => sum_row::<1>(row, first, index == 0, sample, planes),
            2 => sum_row::<2>(row, first, index == 0, sample, planes),
            4 => sum_row::<4>(row, first, index == 0, sample, planes),
            _ => sum_row_of(row, first, across, index == 0, sample, planes),
        }
    }
    for value in red.iter_mut().chain(green).chain(blue) {
        *value /= whole as f32;
    }
}

/// Adds one row of blocks of a width the compiler knows.
#[inline(always)]
fn sum_row<const ACROSS: usize>(
    row: &[u8],
    first: usize,
    is_first: bool,
    sample: impl Fn(&[u8], usize) -> u32 + Copy,
    planes: [&mut [f32]; 3],
) {
    sum_row_of(row, first, ACROSS, is_first, sample, planes);
}

/// Adds one row of blocks to one row of each plane; sets it, if it is the first.
#[inline(always)]
fn sum_row_of(
    row: &[u8],
    first: usize,
    across: usize,
    is_first: bool,
    sample: impl Fn(&[u8], usize) -> u32 + Copy,
    [red, green, blue]: [&mut [f32]; 3],
) {
    for (u, ((red, green), blue)) in red.iter_mut().zip(green).zip(blue).enumerate() {
        let mut sums = [0u32; 3];
        for x in 0..across {
            let at = 3 * (first + u * across + x);
            for (channel, sum) in sums.iter_mut().enumerate() {
                *sum += sample(row, at + channel);
            }
        }
        let [r, g, b] = sums.map(|sum| sum as f32);
        if is_first {
            (*red, *green, *blue) = (r, g, b);
        } else {
            (*red, *green, *blue) = (*red + r, *green + g, *blue + b);
        }
    }
}

/// Means of blocks whose sums do not fit 24 bits: at most 8192 x 8192 pixels of 16 bits, 42 bits.
fn large_mean_row<'a>(
    rows: impl Iterator<Item = &'a [u8]> + Clone,
    first: usize,
    across: usize,
    whole: u64,
    sample: impl Fn(&[u8], usize) -> u32,
    planes: [&mut [f32]; 3],
) {
    for (channel, plane) in planes.into_iter().enumerate() {
        for (u, value) in plane.iter_mut().enumerate() {
            let start = first + u * across;
            let row_sum = |row: &[u8]| {
                (start..start + across)
                    .map(|x| u64::from(sample(row, 3 * x + channel)))
                    .sum::<u64>()
            };
            let sum: u64 = rows.clone().map(row_sum).sum();
            *value = (sum as f64 / whole as f64) as f32; // both exact in f64
        }
    }
}

/// One output row between two rows of the image.
#[inline(always)]
fn bilinear_row(
    [above, below]: [&[u8]; 2],
    weight: f32,
    columns: &[Tap],
    white: f32,
    sample: impl Fn(&[u8], usize) -> u32 + Copy,
    [red, green, blue]: [&mut [f32]; 3],
) {
    let between = |a: f32, b: f32, weight: f32| a * (1.0 - weight) + b * weight;
    for (((red, green), blue), tap) in red.iter_mut().zip(green).zip(blue).zip(columns) {
        let value = |channel: usize| {
            let at = |row: &[u8], x: usize| sample(row, 3 * x + channel) as f32;
            let upper = between(at(above, tap.first), at(above, tap.second), tap.weight);
            let lower = between(at(below, tap.first), at(below, tap.second), tap.weight);
            between(upper, lower, weight) / white
        };
        (*red, *green, *blue) = (value(0), value(1), value(2));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Crop;
    use proptest::prelude::*;

    fn bytes(len: usize) -> Vec<u8> {
        (0..len as u32)
            .map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8)
            .collect()
    }

    fn rescale(sensor: (u32, u32), crop: Crop, grid: (u32, u32)) -> Rescale {
        Rescale::new(
            Grid::new(sensor.0, sensor.1),
            crop,
            Grid::new(grid.0, grid.1),
        )
        .unwrap()
    }

    #[test]
    fn two_by_two_worked_by_hand() {
        // One row of two blocks; the red of the first block is 10, 20, 30, 41: 101 / 4 / 255.
        let data = [
            [10, 0, 255],
            [20, 0, 255],
            [1, 2, 3],
            [1, 2, 3],
            [30, 0, 255],
            [41, 0, 255],
            [1, 2, 3],
            [1, 2, 3],
        ]
        .concat();
        let crop = Grid::new(4, 2).whole();
        let planes = ImagePlanes::new(rescale((4, 2), crop, (2, 1)));
        let size = Grid::new(4, 2);
        let view = ImageView {
            data: &data,
            size,
            stride_bytes: 12,
            samples: Samples::U8,
        };
        let mut out = [f32::NAN; 6];
        planes.write(&view, &mut out).unwrap();
        let expected = [
            101.0 / 1020.0,
            1.0 / 255.0,
            0.0,
            2.0 / 255.0,
            1.0,
            3.0 / 255.0,
        ];
        assert_eq!(out, expected);
    }

    #[test]
    fn a_crop_at_full_size_is_a_copy_whatever_the_stride() {
        let crop = Crop {
            x: 3,
            y: 2,
            width: 5,
            height: 4,
        };
        let planes = ImagePlanes::new(rescale((9, 7), crop, (5, 4)));
        let data = bytes(40 * 6 + 27);
        let view = ImageView {
            data: &data,
            size: Grid::new(9, 7),
            stride_bytes: 40,
            samples: Samples::U8,
        };
        let mut out = vec![0.0; 60];
        planes.write(&view, &mut out).unwrap();
        for (index, value) in out.iter().enumerate() {
            let (channel, y, x) = (index / 20, index / 5 % 4 + 2, index % 5 + 3);
            assert_eq!(*value, f32::from(data[y * 40 + 3 * x + channel]) / 255.0);
        }
    }

    #[test]
    fn deep_samples_have_their_own_white() {
        let words: [u16; 6] = [0, 2048, 4095, 9000, 1, 2];
        let data: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
        let size = Grid::new(2, 1);
        let planes = ImagePlanes::new(Rescale::identity(size).unwrap());
        let mut out = [0.0; 6];
        let mut view = ImageView {
            data: &data,
            size,
            stride_bytes: 12,
            samples: Samples::U16Le { white: 4095 },
        };
        planes.write(&view, &mut out).unwrap();
        assert_eq!(
            out,
            [0.0, 1.0, 2048.0 / 4095.0, 1.0 / 4095.0, 1.0, 2.0 / 4095.0]
        );
        view.samples = Samples::U16Le { white: u16::MAX };
        planes.write(&view, &mut out).unwrap();
        assert_eq!(out[1], 9000.0 / 65535.0);
        view.samples = Samples::U16Le { white: 0 };
        assert!(matches!(
            planes.write(&view, &mut out),
            Err(RasterError::Setting { .. })
        ));
    }

    proptest! {
        /// Block means against the plain sum, from copies to blocks too large for 24 bits.
        #[test]
        fn whole_ratios_are_means(
            (across, down) in (1..20u32, 1..20u32), (gw, gh) in (1..5u32, 1..5u32), x in 0..3u32,
        ) {
            let sensor = (across * gw + 2, down * gh + 1);
            let crop = Crop { x, y: 1, width: across * gw, height: down * gh };
            let map = rescale(sensor, crop, (gw, gh));
            let stride = sensor.0 as usize * 6 + 5;
            let data = bytes(stride * sensor.1 as usize);
            let size = Grid::new(sensor.0, sensor.1);
            let samples = Samples::U16Le { white: u16::MAX };
            let view = ImageView { data: &data, size, stride_bytes: stride, samples };
            let cells = (gw * gh) as usize;
            let mut out = vec![0.0; 3 * cells];
            ImagePlanes::new(map).write(&view, &mut out).unwrap();
            for (index, value) in out.iter().enumerate() {
                let (channel, cell) = (index / cells, (index % cells) as u32);
                let mut sum = 0u64;
                for row in (0..down).map(|y| (1 + cell / gw * down + y) as usize) {
                    for column in (0..across).map(|dx| (x + cell % gw * across + dx) as usize) {
                        let at = row * stride + 6 * column + 2 * channel;
                        sum += u64::from(u16::from_le_bytes([data[at], data[at + 1]]));
                    }
                }
                let expected = sum as f64 / (65_535 * u64::from(across * down)) as f64;
                prop_assert_eq!(*value, expected as f32);
            }
        }

        /// Interpolation against the formula in f64, for any ratio either way.
        #[test]
        fn other_ratios_interpolate(
            (width, height) in (2..20u32, 2..20u32), (gw, gh) in (1..25u32, 1..25u32), x in 0..4u32,
        ) {
            prop_assume!(width % gw != 0 || height % gh != 0);
            let sensor = (width + 5, height + 3);
            let crop = Crop { x, y: 1, width, height };
            let map = rescale(sensor, crop, (gw, gh));
            let stride = sensor.0 as usize * 3;
            let data = bytes(stride * sensor.1 as usize);
            let size = Grid::new(sensor.0, sensor.1);
            let view = ImageView { data: &data, size, stride_bytes: stride, samples: Samples::U8 };
            let mut out = vec![0.0; 3 * (gw * gh) as usize];
            ImagePlanes::new(map).write(&view, &mut out).unwrap();
            for (index, value) in out.iter().enumerate() {
                let cells = (gw * gh) as usize;
                let (channel, cell) = (index / cells, index % cells);
                let (u, v) = ((cell % gw as usize) as f64, (cell / gw as usize) as f64);
                let (sx, sy) = map.sensor_from_grid((u, v));
                let sx = sx.clamp(f64::from(crop.x), f64::from(crop.x + width - 1));
                let sy = sy.clamp(f64::from(crop.y), f64::from(crop.y + height - 1));
                let at = |dx: usize, dy: usize| {
                    let column = (sx as usize + dx).min((crop.x + width - 1) as usize);
                    let row = (sy as usize + dy).min((crop.y + height - 1) as usize);
                    f64::from(data[row * stride + 3 * column + channel]) / 255.0
                };
                let (fx, fy) = (sx.fract(), sy.fract());
                let expected = (at(0, 0) * (1.0 - fx) + at(1, 0) * fx) * (1.0 - fy)
                    + (at(0, 1) * (1.0 - fx) + at(1, 1) * fx) * fy;
                prop_assert!((f64::from(*value) - expected).abs() < 1e-6);
            }
        }
    }

    #[test]
    fn what_does_not_fit_is_named() {
        let size = Grid::new(4, 4);
        let planes = ImagePlanes::new(Rescale::identity(size).unwrap());
        let data = [0; 48];
        let view = ImageView {
            data: &data,
            size,
            stride_bytes: 12,
            samples: Samples::U8,
        };
        let mut out = [0.0; 48];
        let text = |view: &ImageView<'_>, out: &mut [f32]| {
            planes.write(view, out).unwrap_err().to_string()
        };
        let other = ImageView {
            size: Grid::new(4, 5),
            ..view
        };
        assert_eq!(text(&other, &mut out), "image is 4x5 pixels, needs 4x4");
        let narrow = ImageView {
            stride_bytes: 11,
            ..view
        };
        assert_eq!(
            text(&narrow, &mut out),
            "bytes from image row to row has 11 elements, needs 12"
        );
        let short = ImageView {
            data: &data[1..],
            ..view
        };
        assert_eq!(
            text(&short, &mut out),
            "image in bytes has 47 elements, needs 48"
        );
        let huge = ImageView {
            stride_bytes: usize::MAX,
            ..view
        };
        assert!(planes.write(&huge, &mut out).is_err());
        assert_eq!(
            text(&view, &mut out[1..]),
            "image planes has 47 elements, needs 48"
        );
        planes.write(&view, &mut out).unwrap();
    }
}

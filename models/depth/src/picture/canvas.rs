//! An RGB picture to draw on: copy, enlarge, fill, write. What lies outside is cut, never an error.

use super::font;
use crate::size::{SizeError, check_len};
use thiserror::Error;

/// Longest side of a canvas, pixels.
pub const CANVAS_SIDE_MAX: usize = 16_384;

/// Why a picture cannot be made.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum PictureError {
    /// A side is zero or above [`CANVAS_SIDE_MAX`].
    #[error("picture is {width}x{height} pixels, sides must lie in 1..={CANVAS_SIDE_MAX}")]
    Side {
        /// Columns asked for.
        width: usize,
        /// Rows asked for.
        height: usize,
    },
    /// A slice does not hold the picture.
    #[error(transparent)]
    Size(#[from] SizeError),
    /// The ends of a colour scale do not rise.
    #[error("colour scale from {near_m} m to {far_m} m is not a rising range above 0")]
    Scale {
        /// Light end, metres.
        near_m: f32,
        /// Dark end, metres.
        far_m: f32,
    },
    /// A tile of another size than its sheet's.
    #[error(
        "tile {label:?} is {width}x{height} pixels, the sheet takes {sheet_width}x{sheet_height}"
    )]
    Tile {
        /// The tile's label.
        label: String,
        /// The tile's columns.
        width: usize,
        /// The tile's rows.
        height: usize,
        /// The sheet's tile columns.
        sheet_width: usize,
        /// The sheet's tile rows.
        sheet_height: usize,
    },
}

/// An RGB picture of 8 bits per channel.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Canvas {
    width: usize,
    height: usize,
    rgb: Vec<u8>,
}

impl Canvas {
    /// A canvas of one colour.
    pub fn new(width: usize, height: usize, colour: [u8; 3]) -> Result<Self, PictureError> {
        check_side(width, height)?;
        Ok(Self {
            width,
            height,
            rgb: colour.repeat(width * height),
        })
    }

    /// A canvas over `width * height * 3` bytes, row by row.
    pub fn from_rgb(width: usize, height: usize, rgb: Vec<u8>) -> Result<Self, PictureError> {
        check_side(width, height)?;
        check_len("rgb", rgb.len(), 3 * width * height)?;
        Ok(Self { width, height, rgb })
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// All pixels, row by row, three bytes each.
    pub fn rgb(&self) -> &[u8] {
        &self.rgb
    }

    /// All pixels, to colour them in place.
    pub fn rgb_mut(&mut self) -> &mut [u8] {
        &mut self.rgb
    }

    /// Colour of a pixel; `None` outside.
    pub fn pixel(&self, x: usize, y: usize) -> Option<[u8; 3]> {
        (x < self.width && y < self.height).then(|| {
            let start = 3 * (y * self.width + x);
            [self.rgb[start], self.rgb[start + 1], self.rgb[start + 2]]
        })
    }

    /// Fills a rectangle.
    pub fn rect(&mut self, x: usize, y: usize, width: usize, height: usize, colour: [u8; 3]) {
        let columns = x.min(self.width)..x.saturating_add(width).min(self.width);
        for row in y.min(self.height)..y.saturating_add(height).min(self.height) {
            let start = 3 * row * self.width;
            for pixel in
                self.rgb[start + 3 * columns.start..start + 3 * columns.end].chunks_exact_mut(3)
            {
                pixel.copy_from_slice(&colour);
            }
        }
    }

    /// Copies `source` with its top left corner at `(x, y)`.
    pub fn blit(&mut self, source: &Self, x: usize, y: usize) {
        self.blit_enlarged(source, x, y, 1);
    }

    /// Copies `source`, each of its pixels as a square of `factor` pixels (0 draws nothing).
    pub fn blit_enlarged(&mut self, source: &Self, x: usize, y: usize, factor: usize) {
        let (width, height) = (source.width * factor, source.height * factor);
        let columns = width.min(self.width.saturating_sub(x));
        for row in 0..height.min(self.height.saturating_sub(y)) {
            let from = &source.rgb[3 * (row / factor) * source.width..];
            let start = 3 * ((y + row) * self.width + x);
            for (column, pixel) in self.rgb[start..start + 3 * columns]
                .chunks_exact_mut(3)
                .enumerate()
            {
                let at = 3 * (column / factor);
                pixel.copy_from_slice(&from[at..at + 3]);
            }
        }
    }

    /// Writes one line with its top left corner at `(x, y)`, each font pixel `scale` pixels wide.
    pub fn text(&mut self, x: usize, y: usize, scale: usize, colour: [u8; 3], text: &str) {
        for (index, character) in text.chars().enumerate() {
            let left = x + font::advance(index) * scale;
            for (row, bits) in font::glyph(character).into_iter().enumerate() {
                for column in 0..font::GLYPH_WIDTH {
                    if bits >> (font::GLYPH_WIDTH - 1 - column) & 1 == 1 {
                        let (x, y) = (left + column * scale, y + row * scale);
                        self.rect(x, y, scale, scale, colour);
                    }
                }
            }
        }
    }
}

fn check_side(width: usize, height: usize) -> Result<(), PictureError> {
    let fits = |side| (1..=CANVAS_SIDE_MAX).contains(&side);
    if fits(width) && fits(height) {
        Ok(())
    } else {
        Err(PictureError::Side { width, height })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RED: [u8; 3] = [255, 0, 0];
    const BLUE: [u8; 3] = [0, 0, 255];

    #[test]
    fn drawing_outside_is_cut() {
        let mut canvas = Canvas::new(4, 3, [0; 3]).expect("a size");
        let stamp = Canvas::new(3, 3, RED).expect("a size");
        canvas.blit(&stamp, 2, 1);
        canvas.blit(&stamp, 9, 9);
        canvas.rect(3, 2, usize::MAX, usize::MAX, BLUE);
        canvas.rect(usize::MAX, 0, 1, 1, BLUE);
        canvas.text(3, 2, 5, RED, "");
        let red = (0..12)
            .filter(|i| canvas.pixel(i % 4, i / 4) == Some(RED))
            .count();
        assert_eq!(
            (red, canvas.pixel(3, 2), canvas.pixel(4, 0)),
            (3, Some(BLUE), None)
        );
    }

    #[test]
    fn enlarging_repeats_pixels() {
        let source = Canvas::from_rgb(2, 1, [RED, BLUE].concat()).expect("a size");
        let mut canvas = Canvas::new(7, 4, [0; 3]).expect("a size");
        canvas.blit_enlarged(&source, 1, 1, 3);
        canvas.blit_enlarged(&source, 0, 0, 0);
        for (x, expected) in [(0, [0; 3]), (1, RED), (3, RED), (4, BLUE), (6, BLUE)] {
            assert_eq!(canvas.pixel(x, 3), Some(expected), "column {x}");
        }
        assert_eq!(canvas.pixel(1, 0), Some([0; 3]));
    }

    #[test]
    fn text_lands_where_its_width_says() {
        let mut canvas = Canvas::new(40, 12, [0; 3]).expect("a size");
        canvas.text(1, 2, 1, RED, "LH");
        let columns: Vec<usize> = (0..40)
            .filter(|&x| (0..12).any(|y| canvas.pixel(x, y) == Some(RED)))
            .collect();
        assert_eq!(
            (columns[0], columns[columns.len() - 1]),
            (1, font::text_width("LH", 1))
        );
        // The left bar of L and the foot of it.
        assert_eq!(
            (canvas.pixel(1, 2), canvas.pixel(5, 8)),
            (Some(RED), Some(RED))
        );
        assert_eq!(canvas.pixel(5, 2), Some([0; 3]));
    }

    #[test]
    fn sizes_are_checked() {
        assert!(Canvas::new(0, 1, RED).is_err() && Canvas::new(1, 16_385, RED).is_err());
        let error = Canvas::from_rgb(2, 2, vec![0; 11]).expect_err("short");
        assert_eq!(error.to_string(), "rgb holds 11 values, needs 12");
    }
}

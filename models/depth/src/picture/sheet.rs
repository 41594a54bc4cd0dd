//! A contact sheet: rows of equally large, labelled tiles under one title, legends at the foot.

use super::canvas::{Canvas, PictureError};
use super::font::{LINE_HEIGHT, text_width};
use super::legend::Legend;

const PAPER: [u8; 3] = [13, 15, 18];
const FRAME: [u8; 3] = [48, 52, 58];
const TITLE_INK: [u8; 3] = [242, 244, 247];
const LABEL_INK: [u8; 3] = [200, 205, 212];
const QUIET_INK: [u8; 3] = [136, 143, 152];

const MARGIN: usize = 32;
const TILE_GAP: usize = 12;
const ROW_GAP: usize = 20;
/// Between a line of text and what it belongs to.
const TEXT_GAP: usize = 8;
const TITLE_SCALE: usize = 3;
const LABEL_SCALE: usize = 2;
const LEGEND_WIDTH_MAX: usize = 560;

struct Row {
    label: String,
    tiles: Vec<(String, Canvas)>,
}

/// Collects tiles, then draws them all.
///
/// ```
/// use noctule_depth::{Canvas, ContactSheet, Legend, Scale};
///
/// let mut sheet = ContactSheet::new("seed 101", 64, 48, 2)?;
/// sheet.row("truth");
/// sheet.tile("step 1", Canvas::new(64, 48, [90, 30, 10])?)?;
/// sheet.legend(Legend::depth(Scale::DRIVE));
/// assert!(sheet.render()?.width() > 2 * 64);
/// # Ok::<(), noctule_depth::PictureError>(())
/// ```
pub struct ContactSheet {
    title: String,
    note: String,
    tile_width: usize,
    tile_height: usize,
    zoom: usize,
    rows: Vec<Row>,
    legends: Vec<Legend>,
}

impl ContactSheet {
    /// A sheet of tiles of this size, each pixel drawn as a square of `zoom` pixels.
    ///
    /// Errs if a drawn tile would have no pixel or exceed the largest canvas.
    pub fn new(
        title: &str,
        tile_width: usize,
        tile_height: usize,
        zoom: usize,
    ) -> Result<Self, PictureError> {
        // A canvas of one drawn tile must be possible.
        Canvas::new(
            tile_width.saturating_mul(zoom),
            tile_height.saturating_mul(zoom),
            PAPER,
        )?;
        Ok(Self {
            title: title.into(),
            note: String::new(),
            tile_width,
            tile_height,
            zoom,
            rows: Vec::new(),
            legends: Vec::new(),
        })
    }

    /// One quiet line under the title.
    pub fn note(&mut self, note: &str) {
        self.note = note.into();
    }

    /// Starts a row; its label stands above it.
    pub fn row(&mut self, label: &str) {
        self.rows.push(Row {
            label: label.into(),
            tiles: Vec::new(),
        });
    }

    /// Adds a tile to the current row (the first, if none was started); its label stands below it.
    pub fn tile(&mut self, label: &str, picture: Canvas) -> Result<(), PictureError> {
        if (picture.width(), picture.height()) != (self.tile_width, self.tile_height) {
            return Err(PictureError::Tile {
                label: label.into(),
                width: picture.width(),
                height: picture.height(),
                sheet_width: self.tile_width,
                sheet_height: self.tile_height,
            });
        }
        if self.rows.is_empty() {
            self.row("");
        }
        if let Some(row) = self.rows.last_mut() {
            row.tiles.push((label.into(), picture));
        }
        Ok(())
    }

    /// Adds a legend to the foot.
    pub fn legend(&mut self, legend: Legend) {
        self.legends.push(legend);
    }

    /// Draws the sheet; errs if it exceeds the largest canvas.
    pub fn render(&self) -> Result<Canvas, PictureError> {
        let columns = self
            .rows
            .iter()
            .map(|row| row.tiles.len())
            .max()
            .unwrap_or(0);
        let tiles_width = (columns * (self.drawn_width() + TILE_GAP)).saturating_sub(TILE_GAP);
        let inner_width = [
            tiles_width,
            text_width(&self.title, TITLE_SCALE),
            text_width(&self.note, LABEL_SCALE),
            240,
        ]
        .into_iter()
        .fold(0, usize::max);
        let per_line = legends_per_line(inner_width, self.legends.len());
        let legend_lines = self.legends.len().div_ceil(per_line);
        let height = 2 * MARGIN
            + self.head_height()
            + self
                .rows
                .iter()
                .map(|row| self.row_height(row))
                .sum::<usize>()
            + (ROW_GAP * self.rows.len().saturating_sub(1))
            + legend_lines * (Legend::height() + ROW_GAP);
        let mut canvas = Canvas::new(inner_width + 2 * MARGIN, height, PAPER)?;
        let mut y = self.draw_head(&mut canvas);
        for row in &self.rows {
            y = self.draw_row(&mut canvas, row, y) + ROW_GAP;
        }
        let slot = (inner_width + MARGIN) / per_line;
        for (index, legend) in self.legends.iter().enumerate() {
            let x = MARGIN + (index % per_line) * slot;
            let y = y + (index / per_line) * (Legend::height() + ROW_GAP);
            let width = (slot - MARGIN).min(LEGEND_WIDTH_MAX);
            legend.draw(&mut canvas, x, y, width, LABEL_INK);
        }
        Ok(canvas)
    }

    fn drawn_width(&self) -> usize {
        self.tile_width * self.zoom
    }

    fn drawn_height(&self) -> usize {
        self.tile_height * self.zoom
    }

    fn head_height(&self) -> usize {
        let note = if self.note.is_empty() {
            0
        } else {
            LINE_HEIGHT * LABEL_SCALE + TEXT_GAP
        };
        LINE_HEIGHT * TITLE_SCALE + note + ROW_GAP
    }

    fn draw_head(&self, canvas: &mut Canvas) -> usize {
        canvas.text(MARGIN, MARGIN, TITLE_SCALE, TITLE_INK, &self.title);
        let note_top = MARGIN + LINE_HEIGHT * TITLE_SCALE + TEXT_GAP;
        canvas.text(MARGIN, note_top, LABEL_SCALE, QUIET_INK, &self.note);
        MARGIN + self.head_height()
    }

    fn row_height(&self, row: &Row) -> usize {
        let line = LINE_HEIGHT * LABEL_SCALE + TEXT_GAP;
        let heading = if row.label.is_empty() { 0 } else { line };
        let labels = if row.tiles.iter().all(|(label, _)| label.is_empty()) {
            0
        } else {
            line
        };
        heading + self.drawn_height() + labels
    }

    fn draw_row(&self, canvas: &mut Canvas, row: &Row, top: usize) -> usize {
        let mut y = top;
        if !row.label.is_empty() {
            canvas.text(MARGIN, y, LABEL_SCALE, TITLE_INK, &row.label);
            y += LINE_HEIGHT * LABEL_SCALE + TEXT_GAP;
        }
        let (width, height) = (self.drawn_width(), self.drawn_height());
        for (column, (label, picture)) in row.tiles.iter().enumerate() {
            let x = MARGIN + column * (width + TILE_GAP);
            canvas.rect(x - 1, y - 1, width + 2, height + 2, FRAME);
            canvas.blit_enlarged(picture, x, y, self.zoom);
            let (scale, label) = fitted(label, width);
            let drop = (LABEL_SCALE - scale) * LINE_HEIGHT / 2;
            canvas.text(x, y + height + TEXT_GAP + drop, scale, QUIET_INK, &label);
        }
        top + self.row_height(row)
    }
}

/// How many legends stand side by side: as many as keep 360 columns each.
fn legends_per_line(inner_width: usize, count: usize) -> usize {
    ((inner_width + MARGIN) / (360 + MARGIN)).clamp(1, count.max(1))
}

/// A label and the scale at which it fits; cut with a tilde where even the small one does not.
fn fitted(label: &str, width: usize) -> (usize, String) {
    for scale in [LABEL_SCALE, 1] {
        if text_width(label, scale) <= width {
            return (scale, label.into());
        }
    }
    let mut cut: String = label.into();
    while cut.pop().is_some() {
        let marked = format!("{cut}~");
        if text_width(&marked, 1) <= width {
            return (1, marked);
        }
    }
    (1, String::new())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::picture::Scale;

    #[test]
    fn tiles_stand_where_the_grid_says() {
        let mut sheet = ContactSheet::new("t", 8, 6, 3).expect("a size");
        let colours = [[200, 0, 0], [0, 200, 0]];
        for (name, colour) in ["a", "b"].into_iter().zip(colours) {
            sheet
                .tile(name, Canvas::new(8, 6, colour).expect("a size"))
                .expect("the sheet's size");
        }
        sheet.legend(Legend::depth(Scale::DRIVE));
        let canvas = sheet.render().expect("small");
        let count = |colour: [u8; 3]| {
            canvas
                .rgb()
                .chunks_exact(3)
                .filter(|pixel| *pixel == colour)
                .count()
        };
        assert_eq!(colours.map(count), [8 * 6 * 9, 8 * 6 * 9]);
        let top = MARGIN + LINE_HEIGHT * TITLE_SCALE + ROW_GAP;
        assert_eq!(canvas.pixel(MARGIN, top), Some(colours[0]));
        assert_eq!(canvas.pixel(MARGIN + 24 + TILE_GAP, top), Some(colours[1]));
        assert_eq!(canvas.pixel(MARGIN - 2, top), Some(PAPER));
    }

    #[test]
    fn a_tile_of_another_size_is_refused_by_name() {
        let mut sheet = ContactSheet::new("t", 8, 6, 1).expect("a size");
        let error = sheet
            .tile("odd", Canvas::new(8, 7, PAPER).expect("a size"))
            .expect_err("7 rows");
        assert_eq!(
            error.to_string(),
            "tile \"odd\" is 8x7 pixels, the sheet takes 8x6"
        );
        assert!(ContactSheet::new("t", 8, 0, 1).is_err());
        assert!(ContactSheet::new("t", 8, 6, 0).is_err());
        assert!(ContactSheet::new("t", 8, usize::MAX, 2).is_err());
    }

    #[test]
    fn an_empty_sheet_still_has_its_title() {
        let canvas = ContactSheet::new("nothing", 8, 6, 1)
            .expect("a size")
            .render()
            .expect("small");
        assert!(canvas.rgb().chunks_exact(3).any(|pixel| pixel == TITLE_INK));
    }

    #[test]
    fn long_labels_shrink_then_end_in_a_tilde() {
        assert_eq!(fitted("abc", 60), (2, "abc".into()));
        assert_eq!(fitted("abcdef", 40), (1, "abcdef".into()));
        assert_eq!(
            fitted("abcdefghij", 40),
            (1, "abcdef~"[..6].replace('f', "~"))
        );
        assert_eq!(fitted("abc", 3), (1, String::new()));
    }
}

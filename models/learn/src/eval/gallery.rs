//! Sheets of pictures: inputs, the depth that methods make of them, truth and error; or a blurred
//! picture, what restoration makes of it, and the sharp truth.

use std::path::Path;

use noctule_depth::{
    Canvas, ContactSheet, Legend, Scale, Size, SizeError, depth_to_rgb, error_to_rgb,
    events_to_rgb, sparse_to_rgb,
};
use noctule_raster::BINS;
use noctule_world::STEPS;

use super::error::EvalError;
use super::scene::Scene;

/// Exposures drawn.
const ROWS: usize = 6;
/// The step that is drawn: the last, where a recursion has had its say.
const STEP: usize = STEPS - 1;
/// The steps that restored pictures are drawn of.
const RESTORED: [usize; 3] = [0, STEPS / 2 - 1, STEPS - 1];
/// Error at the ends of the error ramp, metres.
const ERROR_FULL_M: f32 = 20.0;

/// Pictures of some exposures, spread evenly over a set.
#[derive(Default)]
pub struct Gallery {
    size: Option<Size>,
    rows: Vec<Row>,
    /// Whether depth is drawn, and its scale with it.
    has_depth: bool,
}

struct Row {
    label: String,
    tiles: Vec<(String, Canvas)>,
}

impl Gallery {
    /// Keeps the pictures of exposure `index` of `count`, if it is one of those drawn and as large
    /// as those before: what `maps` name, each `[T, H, W]` in metres, and the error of the last.
    ///
    /// # Errors
    /// [`EvalError`], when a map is not as large as the scene.
    pub fn add(
        &mut self,
        (index, count): (usize, usize),
        scene: &Scene,
        maps: &[(&str, &[f32])],
    ) -> Result<(), EvalError> {
        let size = scene.size;
        if !self.is_drawn((index, count), size) {
            return Ok(());
        }
        self.has_depth = true;
        let area = size.pixels();
        let voxel = &scene.voxel[STEP * BINS * area..][..BINS * area];
        let of_step = |maps: &[f32]| maps[STEP * area..][..area].to_vec();
        let (sparse, truth) = (of_step(&scene.sparse), of_step(&scene.depth));
        let mut tiles = vec![
            ("blurred", photograph(size, &scene.blur)?),
            (
                "events",
                draw(size, |rgb| events_to_rgb(voxel, BINS, 1.0, rgb))?,
            ),
            (
                "returns",
                draw(size, |rgb| {
                    sparse_to_rgb(&sparse, size, 1, Scale::DRIVE, rgb)
                })?,
            ),
        ];
        let depth = |depth: &[f32]| draw(size, |rgb| depth_to_rgb(depth, Scale::DRIVE, rgb));
        for (name, maps) in maps {
            tiles.push((*name, depth(&of_step(maps))?));
        }
        tiles.push(("truth", depth(&truth)?));
        if let Some((_, last)) = maps.last() {
            let last = of_step(last);
            let error = draw(size, |rgb| error_to_rgb(&last, &truth, ERROR_FULL_M, rgb))?;
            tiles.push(("error", error));
        }
        self.rows.push(Row {
            label: scene.name.clone(),
            tiles: tiles
                .into_iter()
                .map(|(name, tile)| (name.to_owned(), tile))
                .collect(),
        });
        Ok(())
    }

    /// As [`add`](Self::add), of an exposure whose pictures are restored: `blur` `[3, H, W]`,
    /// `restored` and `sharp` `[T, 3, H, W]`, encoded values over 255.
    ///
    /// # Errors
    /// [`EvalError`], when a picture is not of this size.
    pub fn add_restored(
        &mut self,
        (index, count): (usize, usize),
        (label, size): (&str, Size),
        blur: &[f32],
        [restored, sharp]: [&[f32]; 2],
    ) -> Result<(), EvalError> {
        if !self.is_drawn((index, count), size) {
            return Ok(());
        }
        let of_step = |pictures: &[f32], step: usize| {
            let area = 3 * size.pixels();
            photograph(
                size,
                pictures.get(step * area..(step + 1) * area).unwrap_or(&[]),
            )
        };
        let mut tiles = vec![("blurred".to_owned(), photograph(size, blur)?)];
        for step in RESTORED {
            tiles.push((format!("restored {}", step + 1), of_step(restored, step)?));
            tiles.push((format!("sharp {}", step + 1), of_step(sharp, step)?));
        }
        self.rows.push(Row {
            label: label.to_owned(),
            tiles,
        });
        Ok(())
    }

    /// Whether an exposure is one of those drawn, and as large as those before.
    fn is_drawn(&mut self, (index, count): (usize, usize), size: Size) -> bool {
        let every = count.div_ceil(ROWS).max(1);
        index.is_multiple_of(every) && *self.size.get_or_insert(size) == size
    }

    /// Draws the sheet; nothing where no exposure was kept.
    ///
    /// # Errors
    /// [`EvalError`], when the file cannot be written.
    pub fn save(&self, path: &Path, title: &str) -> Result<(), EvalError> {
        let Some(size) = self.size.filter(|_| !self.rows.is_empty()) else {
            return Ok(());
        };
        let mut sheet = ContactSheet::new(title, size.width(), size.height(), 1)?;
        if self.has_depth {
            sheet.note(&format!("step {} of {STEPS}", STEP + 1));
        }
        for row in &self.rows {
            sheet.row(&row.label);
            for (label, canvas) in &row.tiles {
                sheet.tile(label, canvas.clone())?;
            }
        }
        if self.has_depth {
            sheet.legend(Legend::depth(Scale::DRIVE));
            sheet.legend(Legend::error(ERROR_FULL_M));
        }
        Ok(sheet.render()?.save_png(path)?)
    }
}

/// A picture of three planes, encoded values over 255.
fn photograph(size: Size, planes: &[f32]) -> Result<Canvas, EvalError> {
    let code = |value: f32| (value.clamp(0.0, 1.0) * 255.0).round() as u8;
    let area = planes.len() / 3;
    let pixel = |cell: usize| [0, 1, 2].map(|plane| code(planes[plane * area + cell]));
    canvas(size, (0..area).flat_map(pixel).collect())
}

fn draw(
    size: Size,
    colour: impl Fn(&mut [u8]) -> Result<(), SizeError>,
) -> Result<Canvas, EvalError> {
    let mut rgb = vec![0; 3 * size.pixels()];
    colour(&mut rgb)?;
    canvas(size, rgb)
}

fn canvas(size: Size, rgb: Vec<u8>) -> Result<Canvas, EvalError> {
    Ok(Canvas::from_rgb(size.width(), size.height(), rgb)?)
}

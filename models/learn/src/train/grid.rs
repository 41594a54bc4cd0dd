//! The sheet of pictures a validation leaves: inputs, depth, truth and error of a few exposures.

use std::path::Path;

use noctule_depth::{
    Canvas, ContactSheet, Legend, Scale, Size, depth_to_rgb, error_to_rgb, events_to_rgb,
    sparse_to_rgb,
};
use noctule_raster::BINS;
use noctule_world::STEPS;

use super::error::TrainError;
use crate::cache::Example;
use crate::eval::Scene;

/// Exposures drawn.
const ROWS: usize = 6;
/// The step that is drawn: the last, where a recursion has had its say.
const STEP: usize = STEPS - 1;
/// Error at the ends of the error ramp, metres.
const ERROR_FULL_M: f32 = 20.0;

/// Some exposures' pictures, spread evenly over the set.
pub(super) struct Grid {
    size: Size,
    every: usize,
    rows: Vec<Row>,
}

struct Row {
    label: String,
    tiles: Vec<(&'static str, Canvas)>,
}

impl Grid {
    pub(super) fn new(size: Size, examples: usize) -> Self {
        Self {
            size,
            every: examples.div_ceil(ROWS).max(1),
            rows: Vec::new(),
        }
    }

    /// Keeps the pictures of example `index`, if it is one of those drawn.
    pub(super) fn add(
        &mut self,
        index: usize,
        example: &Example,
        scene: &Scene,
        [pred, nearest]: [&[f32]; 2],
    ) -> Result<(), TrainError> {
        if !index.is_multiple_of(self.every) {
            return Ok(());
        }
        let area = self.size.pixels();
        let voxel = &scene.voxel[STEP * BINS * area..][..BINS * area];
        let (sparse, truth) = (
            example.step(&example.sparse, STEP),
            example.step(&example.depth, STEP),
        );
        let [pred, nearest] = [pred, nearest].map(|maps| &maps[STEP * area..][..area]);
        let mut blur = vec![0; 3 * area];
        for (cell, pixel) in blur.chunks_exact_mut(3).enumerate() {
            pixel.copy_from_slice(&[0, 1, 2].map(|c| example.blur[c * area + cell]));
        }
        let tiles = vec![
            ("blurred", self.canvas(blur)?),
            (
                "events",
                self.draw(|rgb| events_to_rgb(voxel, BINS, 1.0, rgb))?,
            ),
            (
                "returns",
                self.draw(|rgb| sparse_to_rgb(sparse, self.size, 1, Scale::DRIVE, rgb))?,
            ),
            (
                "nearest",
                self.draw(|rgb| depth_to_rgb(nearest, Scale::DRIVE, rgb))?,
            ),
            (
                "network",
                self.draw(|rgb| depth_to_rgb(pred, Scale::DRIVE, rgb))?,
            ),
            (
                "truth",
                self.draw(|rgb| depth_to_rgb(truth, Scale::DRIVE, rgb))?,
            ),
            (
                "error",
                self.draw(|rgb| error_to_rgb(pred, truth, ERROR_FULL_M, rgb))?,
            ),
        ];
        let label = format!("tier {}, seed {}", example.origin.letter(), example.seed);
        self.rows.push(Row { label, tiles });
        Ok(())
    }

    fn draw(
        &self,
        colour: impl Fn(&mut [u8]) -> Result<(), noctule_depth::SizeError>,
    ) -> Result<Canvas, TrainError> {
        let mut rgb = vec![0; 3 * self.size.pixels()];
        colour(&mut rgb)?;
        self.canvas(rgb)
    }

    fn canvas(&self, rgb: Vec<u8>) -> Result<Canvas, TrainError> {
        Ok(Canvas::from_rgb(
            self.size.width(),
            self.size.height(),
            rgb,
        )?)
    }

    /// Draws the sheet; nothing where no depth was validated.
    pub(super) fn save(&self, path: &Path, title: &str) -> Result<(), TrainError> {
        if self.rows.is_empty() {
            return Ok(());
        }
        let mut sheet = ContactSheet::new(title, self.size.width(), self.size.height(), 1)?;
        sheet.note(&format!("step {} of {STEPS}", STEP + 1));
        for row in &self.rows {
            sheet.row(&row.label);
            for (label, canvas) in &row.tiles {
                sheet.tile(label, canvas.clone())?;
            }
        }
        sheet.legend(Legend::depth(Scale::DRIVE));
        sheet.legend(Legend::error(ERROR_FULL_M));
        Ok(sheet.render()?.save_png(path)?)
    }
}

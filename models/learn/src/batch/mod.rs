//! Batches: examples cut, varied and put side by side, made ahead of the trainer.

mod crop;
mod cut;
mod cutter;
mod integral;
mod loader;
mod order;
mod pixels;
mod vary;

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;

use candle_core::{Device, Tensor};
use noctule_depth::Ground;
use noctule_raster::{BINS, RasterError};
use noctule_world::STEPS;
use safetensors::Dtype;
use safetensors::tensor::TensorView;
use thiserror::Error;

use crate::cache::{CacheError, Example, Examples, write_whole};
use crate::chance::Chance;
use crate::settings::{Augment, Domain, Kind, Loss, Stage};
use cut::{Cut, Piece, Wanted};
pub(crate) use cut::{GAMMA, GREY};
use cutter::Cutter;
pub use loader::Loader;
use order::Order;

/// Salts of what is random about a batch.
const WINDOW: u64 = 2;
const CUT: u64 = 3;

/// Why a batch could not be made.
#[derive(Debug, Error)]
pub enum BatchError {
    /// An example could not be read.
    #[error(transparent)]
    Cache(#[from] CacheError),
    /// Its events do not fit the raster.
    #[error(transparent)]
    Raster(#[from] RasterError),
    /// A thread that makes batches ended early.
    #[error("a loader thread ended")]
    Ended,
}

/// Some exposures side by side, in plain memory.
#[derive(Debug, Clone, PartialEq)]
pub struct Batch {
    /// Its number in the stage.
    pub number: u64,
    /// Letter of the origin and seed of each exposure.
    pub places: Vec<(char, u64)>,
    /// Width and height, pixels.
    pub side: usize,
    /// First step and number of steps.
    pub window: (usize, usize),
    /// Where level ground lies in each, where that is known.
    pub grounds: Vec<Option<Ground>>,
    fields: Piece,
}

/// A batch as the network takes it.
#[derive(Debug, Clone)]
pub struct Inputs {
    /// `[B, 3, H, W]`, encoded values over 255.
    pub blur: Tensor,
    /// From the start of the exposure, `[B, first_step + n, BINS, H, W]`.
    pub voxel: Tensor,
    /// `[B, n, 1, H, W]`, metres, 0 for no return.
    pub sparse: Tensor,
    /// Truth, `[B, n, 1, H, W]`, metres, 0 for none.
    pub depth: Tensor,
    /// `[B, n, 1, H, W]`, 1 near depth edges; only where asked for.
    pub edges: Option<Tensor>,
    /// `[B, n, 1, H, W]`, 1 on what moves on its own; only where asked for.
    pub movers: Option<Tensor>,
    /// Truth of restoration; only where asked for.
    pub pictures: Option<Pictures>,
    /// The step of the exposure that `n` counts from.
    pub first_step: usize,
    /// Where level ground lies in each of the batch, where that is known.
    pub grounds: Vec<Option<Ground>>,
}

/// What restoration is held to.
#[derive(Debug, Clone)]
pub struct Pictures {
    /// `[B, n, 3, H, W]`.
    pub sharp: Tensor,
    /// Grey that events imply, `[B, n, 1, H, W]`.
    pub event_grey: Tensor,
}

impl Batch {
    /// Puts the batch on a device.
    ///
    /// # Errors
    /// When the device has no room.
    pub fn to_device(&self, device: &Device) -> candle_core::Result<Inputs> {
        let (b, n, side) = (self.places.len(), self.window.1, self.side);
        let steps = |values: &[f32], planes: usize| {
            Tensor::from_slice(values, (b, n, planes, side, side), device)
        };
        let fields = &self.fields;
        let given = |values: &[f32]| (!values.is_empty()).then(|| steps(values, 1)).transpose();
        let pictures = match (fields.sharp.is_empty(), given(&fields.event_grey)?) {
            (false, Some(event_grey)) => Some(Pictures {
                sharp: steps(&fields.sharp, 3)?,
                event_grey,
            }),
            _ => None,
        };
        Ok(Inputs {
            blur: Tensor::from_slice(&fields.blur, (b, 3, side, side), device)?,
            voxel: Tensor::from_slice(
                &fields.voxel,
                (b, self.window.0 + n, BINS, side, side),
                device,
            )?,
            sparse: steps(&fields.sparse, 1)?,
            depth: steps(&fields.depth, 1)?,
            edges: given(&fields.edges)?,
            movers: given(&fields.movers)?,
            pictures,
            first_step: self.window.0,
            grounds: self.grounds.clone(),
        })
    }

    fn append(&mut self, piece: Piece) {
        let Piece {
            blur,
            voxel,
            sparse,
            depth,
            sharp,
            event_grey,
            edges,
            movers,
        } = piece;
        let all = &mut self.fields;
        for (field, more) in [
            (&mut all.blur, blur),
            (&mut all.voxel, voxel),
            (&mut all.sparse, sparse),
            (&mut all.depth, depth),
            (&mut all.sharp, sharp),
            (&mut all.event_grey, event_grey),
            (&mut all.edges, edges),
            (&mut all.movers, movers),
        ] {
            field.extend_from_slice(&more);
        }
    }

    /// Writes every field to a safetensors file, with what the batch was made of, for a look at
    /// what went wrong.
    ///
    /// # Errors
    /// [`CacheError`], when the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), CacheError> {
        let (b, n, side) = (self.places.len(), self.window.1, self.side);
        let fields = &self.fields;
        let all = [
            ("blur", vec![b, 3, side, side], &fields.blur),
            (
                "voxel",
                vec![b, self.window.0 + n, BINS, side, side],
                &fields.voxel,
            ),
            ("sparse", vec![b, n, 1, side, side], &fields.sparse),
            ("depth", vec![b, n, 1, side, side], &fields.depth),
            ("sharp", vec![b, n, 3, side, side], &fields.sharp),
            ("event_grey", vec![b, n, 1, side, side], &fields.event_grey),
            ("edges", vec![b, n, 1, side, side], &fields.edges),
            ("movers", vec![b, n, 1, side, side], &fields.movers),
        ];
        let given: Vec<_> = all
            .into_iter()
            .filter(|(_, _, values)| !values.is_empty())
            .map(|(name, shape, values)| {
                let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
                (name, shape, bytes)
            })
            .collect();
        let shard = |e: safetensors::SafeTensorError| CacheError::Shard {
            path: path.into(),
            fault: e.to_string(),
        };
        let views = given
            .iter()
            .map(|(name, shape, bytes)| {
                Ok((*name, TensorView::new(Dtype::F32, shape.clone(), bytes)?))
            })
            .collect::<Result<Vec<_>, _>>()
            .map_err(shard)?;
        let about = format!(
            "batch {}, steps from {}, of {:?}",
            self.number, self.window.0, self.places
        );
        let table = HashMap::from([("about".to_owned(), about)]);
        let bytes = safetensors::serialize(views, Some(table)).map_err(shard)?;
        write_whole(path, &bytes).map_err(|source| CacheError::File {
            path: path.into(),
            source,
        })
    }

    /// One whole example, all steps, as it is.
    ///
    /// # Errors
    /// [`RasterError`], when its events do not fit the raster.
    pub fn whole(
        example: &Example,
        pictures: Option<(Domain, f64)>,
        depth_max_m: f32,
    ) -> Result<Self, RasterError> {
        let mut cutter = Cutter::new(example.size, depth_max_m)?;
        let wanted = Wanted {
            pictures,
            edges: false,
            movers: false,
        };
        let cut = Cut::whole(example.size);
        Ok(Self {
            number: 0,
            places: vec![(example.origin.letter(), example.seed)],
            side: example.size,
            window: (0, STEPS),
            grounds: vec![example.ground],
            fields: cutter.cut(example, &cut, wanted, &mut Chance::of(&[]))?,
        })
    }
}

/// Everything that decides which batch has which number.
#[derive(Debug, Clone)]
pub struct Recipe {
    /// What batches are made of.
    pub examples: Arc<Examples>,
    /// Width and height of the examples, pixels.
    pub size: usize,
    /// Cut, window and batch size, and whether pictures are needed.
    pub stage: Stage,
    /// How examples are varied.
    pub augment: Augment,
    /// Which extra fields the losses need.
    pub loss: Loss,
    /// Distinguishes runs and stages.
    pub seed: [u64; 2],
    /// Depth beyond this is no truth, metres.
    pub depth_max_m: f32,
}

impl Recipe {
    fn wanted(&self) -> Wanted {
        let restores = self.stage.kind == Kind::Restore;
        Wanted {
            pictures: restores.then_some((self.loss.reblur_domain, self.loss.contrast)),
            edges: !restores && self.loss.depth_edges > 0.0,
            movers: !restores && self.loss.depth_movers + self.loss.mover_mean > 0.0,
        }
    }

    /// Makes batch `number`: always the same, whatever was made before.
    fn make(&self, number: u64, cutter: &mut Cutter) -> Result<Batch, BatchError> {
        let order = Order {
            examples: self.examples.len(),
            mixed_in: self.examples.mixed_in(),
            batch: self.stage.batch,
            seed: self.seed,
        };
        let [run, stage] = self.seed;
        let length = self.stage.window;
        let first = Chance::of(&[WINDOW, run, stage, number]).below(STEPS - length + 1);
        let wanted = self.wanted();
        let mut batch = Batch {
            number,
            places: Vec::with_capacity(self.stage.batch),
            side: self.stage.crop,
            window: (first, length),
            grounds: Vec::with_capacity(self.stage.batch),
            fields: Piece::default(),
        };
        for (place, index) in (0..).zip(order.of_batch(number)) {
            let mut chance = Chance::of(&[CUT, run, stage, number, place]);
            let mut cut = Cut::random(
                &self.augment,
                self.size,
                self.stage.crop,
                batch.window,
                &mut chance,
            );
            let example = self.examples.read(index, wanted.pictures.is_some())?;
            cut.over_movers(&example, self.augment.over_movers);
            batch.places.push((example.origin.letter(), example.seed));
            batch.grounds.push(cut.ground(example.ground.as_ref()));
            batch.append(cutter.cut(&example, &cut, wanted, &mut chance)?);
        }
        Ok(batch)
    }
}

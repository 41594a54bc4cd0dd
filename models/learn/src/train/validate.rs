//! How good the averaged weights are on drives that are never trained on.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use candle_core::Tensor;
use noctule_depth::{Completer, Score, ScoreTable, Size};
use noctule_erunet::{Network, Norms, Pass, Plan, PlanOptions, Weights};
use noctule_world::STEPS;
use serde::Serialize;

use super::error::TrainError;
use super::step::{batch_loss, scalar};
use crate::batch::{Batch, BatchError, Inputs};
use crate::cache::{Example, Examples};
use crate::eval::{Gallery, Scene, Withheld, complete};
use crate::score::{DEPTH_CAP_M, Truth, score_sequence};
use crate::settings::{CHARBONNIER_GUARD, Kind, Loss};

/// What a validation found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Validation {
    /// The stage's kind.
    pub stage: &'static str,
    /// Changes of the weights so far, over all stages.
    pub step: u64,
    /// Wall-clock seconds it took.
    pub seconds: f64,
    /// Depth of nights, in the stages that train it.
    pub depth: Option<DepthValidation>,
    /// Depth of real frames likewise, where the settings hold some for it.
    pub kitti: Option<DepthValidation>,
    /// Pictures, in stage 1.
    pub pictures: Option<PictureValidation>,
}

impl Validation {
    /// One number to compare weights by, lower is better: the mean over nights and real frames.
    pub fn score(&self) -> Option<f64> {
        let scores = [
            self.depth.map(|depth| depth.score()),
            self.kitti.map(|depth| depth.plain_score()),
        ];
        let scores: Vec<f64> = scores.into_iter().flatten().collect();
        (!scores.is_empty()).then(|| scores.iter().sum::<f64>() / scores.len() as f64)
    }
}

/// Errors as shares of those of the exact nearest return on the same exposures, all steps; not a
/// number where there is nothing of the kind.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DepthValidation {
    /// Root mean square error.
    pub rmse: f64,
    /// Mean absolute error.
    pub mae: f64,
    /// Mean absolute error within 5 px of a depth edge.
    pub edge_mae: f64,
    /// Mean absolute error on movers.
    pub mover_mae: f64,
    /// Mean absolute error on thin things.
    pub thin_mae: f64,
    /// Mean absolute error, millimetres.
    pub mae_mm: f64,
    /// Mean absolute error of the last step over that of the first.
    pub last_over_first: f64,
}

impl DepthValidation {
    /// One number to compare weights by, lower is better: the mean of the three main shares.
    pub fn score(&self) -> f64 {
        (self.rmse + self.mae + self.edge_mae) / 3.0
    }

    /// The same without edges, which truth of single returns does not show.
    pub fn plain_score(&self) -> f64 {
        0.5 * (self.rmse + self.mae)
    }
}

/// Restoration's loss, which only means something beside that of the blurred picture.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PictureValidation {
    /// Eq. 11.
    pub loss: f64,
    /// Eq. 11 of the blurred picture at every step.
    pub blurred: f64,
    /// Mean absolute difference of the restored pictures from their mean.
    pub spread: f64,
}

impl PictureValidation {
    /// Loss over that of the blurred picture: 1 is a collapse.
    pub fn share(&self) -> f64 {
        self.loss / self.blurred
    }
}

/// Validation's examples and what the nearest return makes of them.
struct Held {
    examples: Examples,
    nearest: Score,
}

/// Validates on nights, on real frames, or on both.
pub(super) struct Validator {
    nights: Option<Held>,
    kitti: Option<Held>,
    size: Size,
    depth_max_m: f32,
    threads: usize,
}

impl Validator {
    pub(super) fn new(
        nights: Examples,
        kitti: Examples,
        side: usize,
        depth_max_m: f32,
        threads: usize,
    ) -> Result<Self, TrainError> {
        let size = Size::new(side, side)?;
        let hold = |examples: Examples| -> Result<Option<Held>, TrainError> {
            if examples.is_empty() {
                return Ok(None);
            }
            let mut table = ScoreTable::new();
            for index in 0..examples.len() {
                let example = examples.read(index, false)?;
                add(&mut table, index, &nearest(&example, size)?, &example, size)?;
            }
            let nearest = table.mean().ok_or_else(no_truth)?;
            Ok(Some(Held { examples, nearest }))
        };
        Ok(Self {
            nights: hold(nights)?,
            kitti: hold(kitti)?,
            size,
            depth_max_m,
            threads,
        })
    }

    /// Validates `weights`; `None` when `stop` was set meanwhile. Depth maps of some exposures are
    /// drawn on a sheet.
    pub(super) fn run(
        &self,
        weights: &Weights,
        kind: Kind,
        loss: &Loss,
        stop: &AtomicBool,
    ) -> Result<Option<(Validation, Gallery)>, TrainError> {
        if kind == Kind::Restore {
            self.pictures(weights, loss, stop)
        } else {
            self.depth(weights, kind, stop)
        }
    }

    /// Restoration, through the network that training uses.
    fn pictures(
        &self,
        weights: &Weights,
        loss: &Loss,
        stop: &AtomicBool,
    ) -> Result<Option<(Validation, Gallery)>, TrainError> {
        let started = Instant::now();
        let loss = &Loss {
            charbonnier_guard: CHARBONNIER_GUARD,
            restored_power: 0.0,
            ..*loss
        };
        let config = weights.config().ok_or_else(no_truth)?;
        let network = Network::new(config, weights, Norms::Fold)?;
        let mut mean = PictureValidation {
            loss: 0.0,
            blurred: 0.0,
            spread: 0.0,
        };
        let held = self.nights.as_ref().or(self.kitti.as_ref());
        let examples = &held.ok_or_else(no_truth)?.examples;
        let share = 1.0 / examples.len() as f64;
        let mut grid = Gallery::default();
        for index in 0..examples.len() {
            if stop.load(Ordering::Relaxed) {
                return Ok(None);
            }
            let example = examples.read(index, true)?;
            let wanted = Some((loss.reblur_domain, loss.contrast));
            let batch = Batch::whole(&example, wanted, self.depth_max_m);
            let inputs = batch
                .map_err(BatchError::from)?
                .to_device(network.device())?;
            let mut pass = Pass::plain();
            let found = batch_loss(&network, Kind::Restore, &inputs, loss, &mut pass)?;
            mean.loss += share * scalar(&found.total)?;
            if let Some(beside) = found.beside {
                mean.blurred += share * beside.blurred;
                mean.spread += share * beside.spread;
            }
            let place = (index, examples.len());
            draw_restored(&mut grid, place, &example, &inputs, found.restored)?;
        }
        let validation = Validation {
            stage: Kind::Restore.name(),
            step: 0,
            seconds: started.elapsed().as_secs_f64(),
            pictures: Some(mean),
            depth: None,
            kitti: None,
        };
        Ok(Some((validation, grid)))
    }

    /// Depth, through the compiled plan that vehicles use.
    fn depth(
        &self,
        weights: &Weights,
        kind: Kind,
        stop: &AtomicBool,
    ) -> Result<Option<(Validation, Gallery)>, TrainError> {
        let started = Instant::now();
        let config = weights.config().ok_or_else(no_truth)?;
        let (height, width) = (self.size.height(), self.size.width());
        let options = PlanOptions {
            threads: self.threads,
            ..PlanOptions::default()
        };
        let mut plan = Plan::new(config, weights, height, width, options)?;
        let mut found = [None, None];
        let mut sheet = None;
        for (held, found) in [&self.nights, &self.kitti].into_iter().zip(&mut found) {
            let Some(held) = held else {
                continue;
            };
            let mut grid = Gallery::default();
            let mut table = ScoreTable::new();
            for index in 0..held.examples.len() {
                if stop.load(Ordering::Relaxed) {
                    return Ok(None);
                }
                let example = held.examples.read(index, false)?;
                let scene = Scene::of_example(&example)?;
                let pred = complete(&mut plan, &scene, Withheld::default())?;
                add(&mut table, index, &pred, &example, self.size)?;
                let beside = nearest(&example, self.size)?;
                let drawn = [("nearest", &beside[..]), ("network", &pred)];
                grid.add((index, held.examples.len()), &scene, &drawn)?;
            }
            let mean = table.mean().ok_or_else(no_truth)?;
            *found = Some(shares(&mean, &held.nearest, &table));
            sheet = sheet.or(Some(grid));
        }
        let [depth, kitti] = found;
        let validation = Validation {
            stage: kind.name(),
            step: 0,
            seconds: started.elapsed().as_secs_f64(),
            pictures: None,
            depth,
            kitti,
        };
        Ok(Some((validation, sheet.ok_or_else(no_truth)?)))
    }
}

/// Errors over those of the nearest returns.
fn shares(mean: &Score, nearest: &Score, table: &ScoreTable) -> DepthValidation {
    let part = |part: fn(&Score) -> Option<f64>| match (part(mean), part(nearest)) {
        (Some(ours), Some(nearest)) if nearest > 0.0 => ours / nearest,
        _ => f64::NAN,
    };
    let of_step = |step: u64| {
        let maes: Vec<f64> = table
            .rows()
            .filter(|(index, _)| index % STEPS as u64 == step)
            .map(|(_, score)| score.metrics.mae_mm)
            .collect();
        maes.iter().sum::<f64>() / maes.len() as f64
    };
    DepthValidation {
        rmse: part(|s| Some(s.metrics.rmse_mm)),
        mae: part(|s| Some(s.metrics.mae_mm)),
        edge_mae: part(|s| s.edge_band_mae_mm),
        mover_mae: part(|s| s.mover_mae_mm),
        thin_mae: part(|s| s.thin_mae_mm),
        mae_mm: mean.metrics.mae_mm,
        last_over_first: of_step(STEPS as u64 - 1) / of_step(0),
    }
}

/// Keeps the restored pictures of an exposure for the sheet.
fn draw_restored(
    grid: &mut Gallery,
    place: (usize, usize),
    example: &Example,
    inputs: &Inputs,
    restored: Option<Tensor>,
) -> Result<(), TrainError> {
    let (Some(restored), Some(truth)) = (restored, &inputs.pictures) else {
        return Ok(());
    };
    let plain = |tensor: &Tensor| tensor.flatten_all()?.to_vec1::<f32>();
    let (blur, sharp) = (plain(&inputs.blur)?, plain(&truth.sharp)?);
    let label = format!("{} {}", example.origin.letter(), example.seed);
    let size = Size::new(example.size, example.size)?;
    let pictures = [&plain(&restored)?[..], &sharp];
    Ok(grid.add_restored(place, (&label, size), &blur, pictures)?)
}

fn no_truth() -> TrainError {
    noctule_depth::MetricsError::NoTruth { cap: DEPTH_CAP_M }.into()
}

/// Nearest returns of all eight steps.
fn nearest(example: &Example, size: Size) -> Result<Vec<f32>, TrainError> {
    let mut completer = Completer::new(size.width(), size.height())?;
    let mut maps = vec![0.0; STEPS * size.pixels()];
    let mut distance_px = vec![0.0; size.pixels()];
    for (step, map) in maps.chunks_exact_mut(size.pixels()).enumerate() {
        let sparse = example.step(&example.sparse, step);
        completer.nearest(sparse, map, &mut distance_px)?;
    }
    Ok(maps)
}

fn add(
    table: &mut ScoreTable,
    index: usize,
    pred: &[f32],
    example: &Example,
    size: Size,
) -> Result<(), TrainError> {
    let truth = Truth {
        depth: &example.depth,
        movers: &example.movers,
        thin: &example.thin,
        flow: &[],
        cap_m: DEPTH_CAP_M,
    };
    for (step, score) in score_sequence(pred, truth, size)?.into_iter().enumerate() {
        if let Some(score) = score {
            table
                .insert((index * STEPS + step) as u64, score)
                .expect("every exposure is scored once");
        }
    }
    Ok(())
}

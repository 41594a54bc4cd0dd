//! One stage of a run, from its first step to its last.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use noctule_erunet::{Adam, AdamOptions, Network, Pass};

use super::curves::StepRow;
use super::error::TrainError;
use super::model::Average;
use super::schedule::rate;
use super::step::{BatchLoss, batch_loss, scalar};
use super::{Report, Run, StepReport, Validation, total_before};
use crate::batch::{Batch, Loader, Recipe};
use crate::settings::Stage;

/// What a stage works with.
struct Tools {
    stage: Stage,
    network: Network,
    adam: Adam,
    loader: Loader,
}

impl Run {
    /// Runs the stage the run is in, from the step it is at.
    pub(super) fn run_stage(
        &mut self,
        stop: &AtomicBool,
        report: &mut dyn FnMut(&Report<'_>),
    ) -> Result<(), TrainError> {
        let mut tools = self.tools()?;
        let stage = tools.stage.clone();
        let mut last = None;
        if !self.place.is_validated {
            last = self.validate(&stage, &tools.adam, stop, report)?;
        }
        while self.place.step < stage.steps {
            self.step(&mut tools, report)?;
            let step = self.place.step;
            if step.is_multiple_of(stage.validate_every) || step == stage.steps {
                self.place.is_validated = false;
                last = self.validate(&stage, &tools.adam, stop, report)?;
            }
            if step.is_multiple_of(stage.checkpoint_every) {
                self.keep(&tools.adam)?;
            }
            if stop.load(Ordering::Relaxed) {
                return Err(self.interrupted(&tools.adam)?);
            }
        }
        if last.is_none() {
            last = self.validate(&stage, &tools.adam, stop, report)?;
        }
        self.keep(&tools.adam)?;
        let name = format!("stage-{}.safetensors", stage.kind.name());
        self.average
            .weights(&self.model)?
            .write(&self.file(&name))?;
        check_collapse(&stage, last.as_ref(), report)
    }

    fn tools(&mut self) -> Result<Tools, TrainError> {
        let stage = self.settings.stages[self.place.stage].clone();
        let mut adam = Adam::new(self.model.trained(stage.kind), AdamOptions::default())?;
        match self.adam.take() {
            Some(state) => adam.restore(&state)?,
            None => self.average = Average::new(&self.model, self.settings.average)?,
        }
        let recipe = Recipe {
            examples: Arc::clone(&self.examples),
            size: self.settings.data.size,
            loss: self.settings.loss_of(&stage),
            stage: stage.clone(),
            augment: self.settings.augment.clone(),
            seed: [u64::from(self.settings.seed), self.place.stage as u64],
            depth_max_m: self.model.config().d_max as f32,
        };
        let loaders = self.settings.data.loaders;
        Ok(Tools {
            network: self.model.network(stage.kind)?,
            loader: Loader::new(Arc::new(recipe), self.place.step, loaders),
            stage,
            adam,
        })
    }

    /// One change of the weights.
    fn step(
        &mut self,
        tools: &mut Tools,
        report: &mut dyn FnMut(&Report<'_>),
    ) -> Result<(), TrainError> {
        let started = Instant::now();
        let kind = tools.stage.kind;
        let batch = tools.loader.next_batch()?;
        let inputs = batch.to_device(self.model.device())?;
        let mut pass = if kind.uses_batch_statistics() {
            Pass::training()
        } else {
            Pass::plain()
        };
        let weights = self.settings.loss_of(&tools.stage);
        let found = batch_loss(&tools.network, kind, &inputs, &weights, &mut pass)?;
        let BatchLoss {
            total,
            terms,
            beside,
            ..
        } = found;
        let loss = scalar(&total)?;
        if !loss.is_finite() {
            return Err(self.not_finite(&tools.stage, &batch, "the loss", loss)?);
        }
        let gradients = total.backward()?;
        let rate = rate(&tools.stage, self.place.step);
        let norm = tools.adam.step(&gradients, rate, tools.stage.clip_norm)?;
        if !norm.is_finite() {
            return Err(self.not_finite(&tools.stage, &batch, "the gradients' norm", norm)?);
        }
        self.model.follow(&pass)?;
        self.place.step += 1;
        self.average.take(&self.model, self.place.step)?;
        let seconds = started.elapsed().as_secs_f64();
        self.curves.step(&StepRow {
            stage: kind.name(),
            step: self.place.step,
            total: self.total(),
            rate,
            loss,
            gradient_norm: norm,
            beside,
            seconds,
        })?;
        report(&Report::Step(StepReport {
            kind,
            step: self.place.step,
            steps: tools.stage.steps,
            total: self.total(),
            totals: total_before(&self.settings, self.settings.stages.len()),
            loss,
            terms: &terms,
            beside,
            seconds,
        }));
        Ok(())
    }

    /// Validates the averaged weights and keeps the best; ends the run when asked to stop.
    fn validate(
        &mut self,
        stage: &Stage,
        adam: &Adam,
        stop: &AtomicBool,
        report: &mut dyn FnMut(&Report<'_>),
    ) -> Result<Option<Validation>, TrainError> {
        let weights = self.average.weights(&self.model)?;
        let loss = self.settings.loss_of(stage);
        let Some((mut found, grid)) = self.validator.run(&weights, stage.kind, &loss, stop)? else {
            return Err(self.interrupted(adam)?);
        };
        found.step = self.total();
        self.place.is_validated = true;
        self.curves.validation(&found)?;
        self.curves.draw()?;
        let title = format!(
            "{} {}, stage {}, step {}",
            self.settings.member,
            variant(&self.settings),
            found.stage,
            found.step
        );
        grid.save(&self.file("grid.png"), &title)?;
        if let Some(score) = found.score()
            && score.is_finite()
            && self.place.best.is_none_or(|best| score < best)
        {
            self.place.best = Some(score);
            weights.write(&self.file("best.safetensors"))?;
        }
        report(&Report::Validation(&found));
        Ok(Some(found))
    }

    /// A checkpoint within a stage.
    fn keep(&mut self, adam: &Adam) -> Result<(), TrainError> {
        let state = adam.state()?;
        self.place.adam_steps = state.steps;
        self.adam = Some(state);
        self.save()
    }

    fn interrupted(&mut self, adam: &Adam) -> Result<TrainError, TrainError> {
        self.keep(adam)?;
        Ok(TrainError::Interrupted(self.start.folder.clone()))
    }

    /// Saves the batch that did it.
    fn not_finite(
        &self,
        stage: &Stage,
        batch: &Batch,
        what: &'static str,
        value: f64,
    ) -> Result<TrainError, TrainError> {
        let path = self.file("not-finite.safetensors");
        batch.write(&path)?;
        Ok(TrainError::NotFinite {
            stage: stage.kind.name(),
            step: self.place.step,
            what,
            value,
            batch: path,
        })
    }
}

fn variant(settings: &crate::settings::Settings) -> &'static str {
    match settings.variant {
        noctule_erunet::Variant::Full => "whole",
        noctule_erunet::Variant::NoEfr => "without restoration",
        noctule_erunet::Variant::NoHgcm => "without event guidance",
    }
}

/// Stage 1 that did not beat the blurred picture ends the run, unless the settings say otherwise.
fn check_collapse(
    stage: &Stage,
    last: Option<&Validation>,
    report: &mut dyn FnMut(&Report<'_>),
) -> Result<(), TrainError> {
    let Some(pictures) = last.and_then(|last| last.pictures) else {
        return Ok(());
    };
    let share = pictures.share();
    if share < stage.collapse_margin {
        return Ok(());
    }
    let error = TrainError::Collapsed {
        share,
        margin: stage.collapse_margin,
        spread: pictures.spread,
    };
    if stage.go_on_collapsed {
        report(&Report::Note(format!("{error}; going on as told")));
        return Ok(());
    }
    Err(error)
}

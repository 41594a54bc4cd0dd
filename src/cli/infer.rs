//! `noctule infer`: the inference process.

use std::path::PathBuf;
use std::time::Duration;

use noctule::bus::{Ipc, Ports};
use noctule::config::Config;
use noctule::frame::ModelId;
use noctule::infer::{self, Engines, Ladder, Options};
use noctule::latency::monotonic_ns;
use noctule::supervise;

use super::{Outcome, stop_on_signals};

/// Arguments of `noctule infer`.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Configuration file; without it the built-in defaults
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Name of the running host, over the configuration's
    #[arg(long)]
    instance: Option<String>,
    /// nearest, fill, xs, s or full, over the configuration's
    #[arg(long)]
    model: Option<ModelId>,
    /// Take every bundle in order, run just this model, never drop
    #[arg(long)]
    lossless: bool,
    /// Process that started this one: ends with it
    #[arg(long, value_name = "PID", hide = true)]
    parent: Option<u32>,
}

/// Runs until a signal comes; ends with one line of JSON that says what was done.
#[expect(clippy::print_stdout, reason = "the report is this command's output")]
pub fn run(arguments: &Arguments) -> Outcome {
    let stop = stop_on_signals()?;
    if let Some(parent) = arguments.parent {
        supervise::end_with(parent)?;
    }
    let mut config = match &arguments.config {
        Some(path) => Config::load(path)?,
        None => Config::default(),
    };
    if let Some(instance) = &arguments.instance {
        config.instance.clone_from(instance);
    }
    if let Some(model) = arguments.model {
        config.infer.model = model;
    }
    config.validate("command line")?;

    let mut engines = Engines::load(&config)?;
    let rungs = engines.measure(config.infer.model, &monotonic_ns)?;
    for rung in &rungs {
        let (begin, step) = (
            Duration::from_nanos(rung.begin_ns),
            Duration::from_nanos(rung.step_ns),
        );
        tracing::info!("model {}: {begin:?} to begin, {step:?} a step", rung.model);
    }
    let steps_down = config.infer.ladder && !arguments.lossless;
    let mut ladder = Ladder::new(config.infer.model, rungs, steps_down);
    let options = Options {
        deadline: config.budget.depth(),
        lossless: arguments.lossless,
    };

    let ports = Ports::<Ipc>::open(config.instance(), "infer", config.limits())?;
    let report = infer::run(
        &ports,
        &mut engines,
        &mut ladder,
        options,
        &monotonic_ns,
        &stop,
    )?;
    println!("{}", serde_json::to_string(&report)?);
    Ok(())
}

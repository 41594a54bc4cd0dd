//! `noctule host`: the host process alone, on a recording.

use std::path::PathBuf;

use noctule::bus::{Ipc, Owner};
use noctule::config::Config;
use noctule::host::BusOutlet;
use noctule::ingest::Pace;
use noctule::replay::{HostOptions, Prepared, run_host};

use super::{Outcome, ended_well, stop_on_signals};

/// Arguments of `noctule host`.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Recording directory, Prophesee RAW file or packet capture to take in place of sensors
    #[arg(long, value_name = "PATH")]
    replay: PathBuf,
    /// Configuration file; without it the built-in defaults
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Name of this host, over the configuration's
    #[arg(long)]
    instance: Option<String>,
    /// realtime, max, or a factor such as 0.5
    #[arg(long, default_value = "realtime", value_parser = parse_pace)]
    pace: Pace,
}

fn parse_pace(text: &str) -> Result<Pace, String> {
    text.parse()
}

/// Owns the services, sends bundles to whoever listens, ends with a JSON report.
#[expect(clippy::print_stdout, reason = "the report is this command's output")]
pub fn run(arguments: &Arguments) -> Outcome {
    let stop = stop_on_signals()?;
    let mut config = match &arguments.config {
        Some(path) => Config::load(path)?,
        None => Config::default(),
    };
    if let Some(instance) = &arguments.instance {
        config.instance.clone_from(instance);
    }
    config.validate("command line")?;
    let prepared = Prepared::open(&arguments.replay, &config)?;
    let owner = Owner::<Ipc>::create(config.instance(), config.limits())?;
    let outlet = BusOutlet::new(owner.ports().bundle_sender()?);
    let options = HostOptions {
        pace: arguments.pace,
        piece_bytes: None,
    };
    let report = run_host(&prepared, &config, outlet, options, &stop)?;
    println!("{}", serde_json::to_string(&report)?);
    ended_well(&stop)
}

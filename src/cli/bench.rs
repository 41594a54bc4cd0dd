//! `noctule bench`: how fast whole paths are on this machine.

use std::path::PathBuf;

use clap::Subcommand;
use noctule::bench::bench_host;
use noctule::config::Config;

use super::{Outcome, progress};

/// Arguments of `noctule bench`.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Exposure closed to bundle sent, at several event rates, beside a copy of the bundle
    Host(Host),
    /// Picture in to depth maps out of the networks, beside the processors' peak
    #[cfg(feature = "model")]
    Infer(super::bench_infer::Arguments),
}

#[derive(Debug, clap::Args)]
struct Host {
    /// Event rates, Mev/s
    #[arg(long, value_delimiter = ',', default_values_t = [1, 20, 70])]
    rates: Vec<u32>,
    /// Length of each run, seconds
    #[arg(long, default_value_t = 6)]
    seconds: u32,
    /// RAW file whose events are repeated; without it a made-up pattern
    #[arg(long, value_name = "FILE")]
    raw: Option<PathBuf>,
    /// Folder for the load (70 Mev/s take about 200 MB a second)
    #[arg(long, value_name = "DIR")]
    scratch: Option<PathBuf>,
    /// Configuration file; without it the built-in defaults
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// JSON instead of a table
    #[arg(long)]
    json: bool,
}

/// Runs the benchmark and prints its table.
pub fn run(arguments: &Arguments) -> Outcome {
    match &arguments.what {
        What::Host(host) => run_host(host),
        #[cfg(feature = "model")]
        What::Infer(infer) => super::bench_infer::run(infer),
    }
}

#[expect(clippy::print_stdout, reason = "the table is this command's output")]
fn run_host(host: &Host) -> Outcome {
    let mut config = match &host.config {
        Some(path) => Config::load(path)?,
        None => Config::default(),
    };
    config.instance = format!("bench-{}", std::process::id());
    let scratch = host.scratch.clone().unwrap_or_else(|| {
        std::env::temp_dir().join(format!("noctule-bench-{}", std::process::id()))
    });
    let spinner = progress::spinner("starting");
    let say = |text: &str| spinner.set_message(text.to_owned());
    let bench = bench_host(
        &config,
        &host.rates,
        host.seconds,
        host.raw.as_deref(),
        &scratch,
        &say,
    );
    spinner.finish_and_clear();
    if host.scratch.is_none() && scratch.exists() {
        std::fs::remove_dir_all(&scratch)?;
    }
    let bench = bench?;
    if host.json {
        println!("{}", serde_json::to_string(&bench)?);
    } else {
        print!("{}", bench.text());
    }
    Ok(())
}

//! Subcommands: arguments, wiring, exit code; no logic.
//!
//! Exit codes: 0 the work was done; 1 it could not be done, or a gate was missed (the reason is on
//! standard error); 2 the arguments are wrong; 130 it was interrupted and ended cleanly.

mod bench;
#[cfg(feature = "model")]
mod bench_infer;
mod check;
mod demo;
#[cfg(feature = "model")]
mod eval;
mod export;
mod host;
mod infer;
mod inspect;
#[cfg(feature = "model")]
mod named;
mod progress;
mod replay;
#[cfg(feature = "model")]
mod train;
#[cfg(feature = "model")]
mod weights;
mod world;

use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use clap::{Parser, Subcommand};

/// Depth in the dark: events, one blurred image and sparse LiDAR in, dense depth sequences out.
#[derive(Debug, Parser)]
#[command(name = "noctule", version, about, after_help = EXIT_CODES)]
pub struct Arguments {
    #[command(subcommand)]
    command: Command,
}

const EXIT_CODES: &str = "\
Exit codes: 0 done; 1 failed, or a gate was missed; 2 wrong arguments; 130 interrupted.
Diagnostics go to standard error; RUST_LOG=debug shows more.";

#[derive(Debug, Subcommand)]
enum Command {
    /// Makes a short night drive, runs it through host and inference, reports and draws
    Demo(demo::Arguments),
    /// Runs a recording (or a lone RAW or pcap file) as if its sensors were there
    Replay(replay::Arguments),
    /// Runs the host process alone, on a recording
    Host(host::Arguments),
    /// Runs the inference process of a running host
    Infer(infer::Arguments),
    /// Renders a recording of a synthetic night drive, with exact truth
    World(world::Arguments),
    /// Says what is in RAW files, packet captures and recordings
    Inspect(inspect::Arguments),
    /// Converts a file to formats other programs read
    Export(export::Arguments),
    /// Measures whole paths on this machine
    Bench(bench::Arguments),
    /// Checks a configuration file
    Check(check::Arguments),
    /// Scores networks, and what needs no learning, against exact truth
    #[cfg(feature = "model")]
    Eval(eval::Arguments),
    /// Trains a network on the synthetic night
    #[cfg(feature = "model")]
    Train(train::Arguments),
    /// Describes the networks, or compares one with reference outputs
    #[cfg(feature = "model")]
    Weights(weights::Arguments),
}

/// Why a subcommand did not end with success.
#[derive(Debug)]
pub enum Failure {
    /// The work could not be done.
    Error(Box<dyn std::error::Error>),
    /// The work was done and its result is not good enough; the reason was printed.
    Gate,
    /// A signal ended it.
    Interrupted,
}

impl<E: std::error::Error + 'static> From<E> for Failure {
    fn from(error: E) -> Self {
        Self::Error(Box::new(error))
    }
}

type Outcome = Result<(), Failure>;

/// Runs the subcommand.
pub fn run(arguments: Arguments) -> ExitCode {
    let outcome = match arguments.command {
        Command::Demo(a) => demo::run(&a),
        Command::Replay(a) => replay::run(&a),
        Command::Host(a) => host::run(&a),
        Command::Infer(a) => infer::run(&a),
        Command::World(a) => world::run(&a),
        Command::Inspect(a) => inspect::run(&a),
        Command::Export(a) => export::run(&a),
        Command::Bench(a) => bench::run(&a),
        Command::Check(a) => check::run(&a),
        #[cfg(feature = "model")]
        Command::Eval(a) => eval::run(&a),
        #[cfg(feature = "model")]
        Command::Train(a) => train::run(&a),
        #[cfg(feature = "model")]
        Command::Weights(a) => weights::run(&a),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(Failure::Gate) => ExitCode::FAILURE,
        Err(Failure::Interrupted) => {
            eprintln!("interrupted");
            ExitCode::from(130)
        }
        Err(Failure::Error(error)) => {
            eprintln!("error: {}", chain(error.as_ref()));
            ExitCode::FAILURE
        }
    }
}

/// An error and its causes on one line, each cause once.
fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(cause) = source {
        let cause_text = cause.to_string();
        if !text.contains(&cause_text) {
            text = format!("{text}: {cause_text}");
        }
        source = cause.source();
    }
    text
}

/// A flag that SIGINT and SIGTERM set; a second signal ends the process at once.
fn stop_on_signals() -> std::io::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register_conditional_shutdown(signal, 130, Arc::clone(&stop))?;
        signal_hook::flag::register(signal, Arc::clone(&stop))?;
    }
    Ok(stop)
}

fn ended_well(stop: &AtomicBool) -> Outcome {
    if stop.load(Ordering::Relaxed) {
        Err(Failure::Interrupted)
    } else {
        Ok(())
    }
}

//! `noctule demo`: from nothing to depth maps on one command.

use std::path::PathBuf;

use noctule_world::{DriveOptions, Tier};

use super::replay::{How, replay};
use super::{Outcome, stop_on_signals, world};

/// Arguments of `noctule demo`.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Which night
    #[arg(long, default_value_t = 7)]
    seed: u64,
    /// Length of the drive, seconds
    #[arg(long, default_value_t = 4.0)]
    seconds: f64,
    /// Tier of the drive, as for `noctule world`
    #[arg(long, default_value = "B")]
    tier: Tier,
    /// Folder of recordings made before, and to be made now
    #[arg(long, value_name = "DIR")]
    cache: Option<PathBuf>,
    #[command(flatten)]
    how: How,
}

/// Renders the drive, unless an earlier demo did, and replays it.
pub fn run(arguments: &Arguments) -> Outcome {
    let out = arguments
        .how
        .out
        .clone()
        .unwrap_or_else(|| PathBuf::from("out/demo"));
    let cache = arguments
        .cache
        .clone()
        .unwrap_or_else(|| out.join("recordings"));
    let name = format!(
        "night-{}-{}s-{}-v{}",
        arguments.seed,
        arguments.seconds,
        arguments.tier.letter(),
        env!("CARGO_PKG_VERSION")
    );
    let recording = cache.join(name);
    // A recording that was cut off has no counts: render it again.
    let usable = noctule_recording::Recording::open(&recording).is_ok_and(|r| r.counts().is_some());
    if usable {
        eprintln!("using {}", recording.display());
    } else {
        if recording.exists() {
            std::fs::remove_dir_all(&recording)?;
        }
        std::fs::create_dir_all(&cache)?;
        eprintln!("rendering {}", recording.display());
        let options = DriveOptions::new(
            arguments.seed,
            arguments.tier,
            world::seconds(arguments.seconds),
        );
        world::render(&options, &recording)?;
    }
    let mut how = arguments.how.clone();
    how.out = Some(out);
    // Until here a signal simply ends the process: there is nothing to clear away.
    replay(&recording, &how, &stop_on_signals()?)
}

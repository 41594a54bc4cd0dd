//! `noctule train`: teaches a network on the synthetic night.

use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

use noctule_learn::{Cache, CacheError, Prepared, Settings};

use super::{Failure, Outcome, progress, stop_on_signals};

/// Arguments of `noctule train`.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Settings of the run (`config/train/*.toml`)
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// Only renders the examples the run needs; can be stopped and called again
    #[arg(long)]
    prepare_only: bool,
    /// Processor threads; without it as the settings say
    #[arg(long, value_name = "N")]
    threads: Option<usize>,
}

/// Prepares the examples, then trains.
pub fn run(arguments: &Arguments) -> Outcome {
    let settings = Settings::read(&arguments.config)?;
    let threads = arguments.threads.unwrap_or(settings.threads).max(1);
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build_global()?;
    let stop = stop_on_signals()?;
    prepare(&settings, &stop)?;
    Ok(())
}

/// Renders the missing examples, validation first, with a progress bar.
fn prepare(settings: &Settings, stop: &AtomicBool) -> Result<Cache, Failure> {
    let cache = Cache::new(&settings.data.cache, settings.data.size)?;
    let nights = [settings.validation()?, settings.train()?];
    for (what, nights) in ["validation", "training"].iter().zip(nights) {
        let bar = progress::bar(0, &format!("rendering {what} nights"));
        let started = std::time::Instant::now();
        let mut last = Prepared::default();
        let done = cache.prepare(&nights, stop, &mut |now: Prepared| {
            bar.set_length(now.total);
            bar.set_position(now.done);
            if bar.is_hidden() && now.rendered / 160 != last.rendered / 160 {
                let pace = started.elapsed().as_secs_f64() / now.rendered as f64;
                eprintln!("{} of {} {what} nights, {pace:.3} s each", now.done, now.total);
            }
            last = now;
        });
        bar.finish_and_clear();
        match done {
            Ok(()) => {}
            Err(CacheError::Interrupted) => return Err(Failure::Interrupted),
            Err(error) => return Err(error.into()),
        }
        eprintln!(
            "{} {what} nights in {}, {} of them new",
            last.done,
            cache.folder().display(),
            last.rendered
        );
    }
    Ok(cache)
}

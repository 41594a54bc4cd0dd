//! `noctule check`: is this configuration one that Noctule would run with?

use std::path::PathBuf;

use noctule::config::Config;

use super::Outcome;

/// Arguments of `noctule check`.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Configuration files (TOML)
    #[arg(required = true)]
    files: Vec<PathBuf>,
}

/// Checks each file and says what it would run.
#[expect(clippy::print_stdout, reason = "the answer is this command's output")]
pub fn run(arguments: &Arguments) -> Outcome {
    for path in &arguments.files {
        let config = Config::load(path)?;
        let (layout, limits) = (config.bundle_layout(), config.limits());
        println!(
            "{}: ok: instance '{}', {} steps of {} bins at {}x{} ({:.1} MiB a bundle, {} in shared \
             memory), model {}, {} ms from close to bundle, {} ms to the last depth map",
            path.display(),
            config.instance,
            layout.steps,
            layout.bins,
            layout.width,
            layout.height,
            mebibytes(layout.bytes()),
            limits.bundle.samples(),
            config.infer.model,
            config.budget.bundle_ms,
            config.budget.depth_ms,
        );
    }
    Ok(())
}

#[expect(clippy::cast_precision_loss, reason = "shown with one decimal")]
fn mebibytes(bytes: usize) -> f64 {
    bytes as f64 / f64::from(1 << 20)
}

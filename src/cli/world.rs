//! `noctule world`: renders a recording of a synthetic night drive.

use std::path::{Path, PathBuf};
use std::time::Duration;

use noctule_world::{
    DriveOptions, DriveProgress, DriveSummary, Faults, Tier, WorldError, record_drive,
};

use super::{Outcome, progress};

/// Arguments of `noctule world`.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Which night: the same number gives the same bytes
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Length of the drive, seconds
    #[arg(long, default_value_t = 4.0)]
    seconds: f64,
    /// Folder to write, which must not hold a recording yet
    #[arg(long)]
    out: PathBuf,
    /// A: 60 ms exposures; B: 160 ms; C: 400 to 700 ms; S: the vehicle stands
    #[arg(long, default_value = "B")]
    tier: Tier,
    /// Loses packets, strobe edges and images, and doubles some
    #[arg(long)]
    faults: bool,
}

/// Renders and says what came of it.
#[expect(clippy::print_stdout, reason = "the answer is this command's output")]
pub fn run(arguments: &Arguments) -> Outcome {
    let mut options = DriveOptions::new(arguments.seed, arguments.tier, seconds(arguments.seconds));
    if arguments.faults {
        options.faults = Faults::rough();
    }
    let summary = render(&options, &arguments.out)?;
    println!(
        "{}: {} exposures, {} events, {} LiDAR packets, {} images, {} CAN frames",
        arguments.out.display(),
        summary.exposures,
        summary.events,
        summary.counts.datagrams,
        summary.counts.images,
        summary.counts.can_frames,
    );
    Ok(())
}

/// Seconds as given on the command line; nonsense becomes a length that the world refuses.
pub fn seconds(seconds: f64) -> Duration {
    Duration::try_from_secs_f64(seconds).unwrap_or(Duration::ZERO)
}

/// Renders a drive with a progress bar.
pub fn render(options: &DriveOptions, out: &Path) -> Result<DriveSummary, WorldError> {
    let bar = progress::bar(1000, "rendering the night");
    let summary = record_drive(
        options,
        out,
        |DriveProgress {
             rendered_s,
             total_s,
         }| {
            // Between 0 and 1000.
            #[expect(
                clippy::cast_possible_truncation,
                clippy::cast_sign_loss,
                reason = "bounded"
            )]
            bar.set_position((1000.0 * rendered_s / total_s) as u64);
        },
    );
    bar.finish_and_clear();
    summary
}

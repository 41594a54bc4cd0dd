//! `noctule train`: teaches a network on the synthetic night, and on real drives.

use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use indicatif::ProgressBar;
use noctule_learn::{
    Cache, CacheError, Kind, KittiClips, Part, Prepared, Report, Run, Settings, Start, StepReport,
    TrainError, Validation,
};

use super::{Failure, Outcome, progress, stop_on_signals};

/// Time between lines about steps where standard error is no terminal.
const LINE_EVERY: Duration = Duration::from_secs(30);
/// Where candle reads the number of threads of its element-wise operations.
const CANDLE_THREADS: &str = "RAYON_NUM_THREADS";

/// Arguments of `noctule train`.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Settings of the run (`config/train/*.toml`)
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// The run's folder; without it `runs/NAME`, NAME as the settings file is called
    #[arg(long, value_name = "DIR")]
    run: Option<PathBuf>,
    /// Goes on from the folder's checkpoint
    #[arg(long)]
    resume: bool,
    /// Runs the stages of this kind alone: 1, 2, 3 or joint
    #[arg(long, value_name = "KIND", value_parser = stage_kind)]
    stage: Option<Kind>,
    /// Weights file to start from, in place of the settings' `init`
    #[arg(long, value_name = "FILE")]
    init: Option<PathBuf>,
    /// Only renders the examples the run needs; can be stopped and called again
    #[arg(long)]
    prepare_only: bool,
    /// Folder for rendered examples, in place of the settings' `data.cache`
    #[arg(long, value_name = "DIR")]
    cache: Option<PathBuf>,
    /// Folder of KITTI's raw drives, in place of the settings' `data.kitti.root`
    #[arg(long, value_name = "DIR")]
    kitti: Option<PathBuf>,
    /// Seed of weights, order and augmentation, in place of the settings' `seed`
    #[arg(long, value_name = "N")]
    seed: Option<u32>,
    /// Processor threads, in place of the settings' `threads`
    #[arg(long, value_name = "N")]
    threads: Option<usize>,
}

fn stage_kind(text: &str) -> Result<Kind, String> {
    [Kind::Restore, Kind::Complete, Kind::Together, Kind::Joint]
        .into_iter()
        .find(|kind| kind.name() == text)
        .ok_or_else(|| format!("stage is {text:?}, must be 1, 2, 3 or joint"))
}

/// Prepares the examples, then trains.
pub fn run(arguments: &Arguments) -> Outcome {
    let mut settings = Settings::read(&arguments.config)?;
    if let Some(init) = &arguments.init {
        settings.init = Some(init.clone());
    }
    if let Some(cache) = &arguments.cache {
        settings.data.cache.clone_from(cache);
    }
    if let Some(root) = &arguments.kitti {
        let Some(kitti) = &mut settings.data.kitti else {
            let file = arguments.config.display();
            let fault = format!("--kitti given, and {file} has no data.kitti that reads from it");
            return Err(Failure::Error(fault.into()));
        };
        kitti.root.clone_from(root);
    }
    settings.seed = arguments.seed.unwrap_or(settings.seed);
    if let Some(threads) = arguments.threads {
        settings.threads = threads.max(1);
    }
    hold_tensor_library_to(settings.threads);
    rayon::ThreadPoolBuilder::new()
        .num_threads(settings.threads)
        .build_global()?;
    let stop = stop_on_signals()?;
    let cache = prepare(&settings, &stop)?;
    if arguments.prepare_only {
        return Ok(());
    }
    let start = Start {
        folder: arguments
            .run
            .clone()
            .unwrap_or_else(|| default_folder(&arguments.config)),
        resume: arguments.resume,
        only: arguments.stage,
    };
    let mut telling = Telling::new();
    let mut run = Run::new(settings, start, &cache)?;
    let outcome = run.train(&stop, &mut |report| telling.tell(report));
    telling.bar.finish_and_clear();
    match outcome {
        Ok(()) => Ok(()),
        Err(TrainError::Interrupted(folder)) => {
            eprintln!(
                "a checkpoint is in {}: go on with --resume",
                folder.display()
            );
            Err(Failure::Interrupted)
        }
        Err(error) => Err(error.into()),
    }
}

/// Starts this program again with the environment variable that candle reads its number of threads
/// from: its workers wait by spinning, and more of them than processors cost a third of the time.
fn hold_tensor_library_to(threads: usize) {
    let wanted = threads.to_string();
    if std::env::var(CANDLE_THREADS).is_ok_and(|held| held == wanted) {
        return;
    }
    let Ok(program) = std::env::current_exe() else {
        return;
    };
    let error = std::process::Command::new(program)
        .args(std::env::args_os().skip(1))
        .env(CANDLE_THREADS, wanted)
        .exec();
    eprintln!("{CANDLE_THREADS} could not be set ({error}): training may be slower");
}

fn default_folder(config: &Path) -> PathBuf {
    Path::new("runs").join(config.file_stem().unwrap_or_default())
}

/// Makes the missing examples, validation first, with a progress bar.
fn prepare(settings: &Settings, stop: &AtomicBool) -> Result<Cache, Failure> {
    let cache = Cache::new(&settings.data.cache, settings.data.size)?;
    let nights = [settings.validation()?, settings.train()?];
    for (what, nights) in ["validation nights", "training nights"].iter().zip(nights) {
        showing(what, |progress| cache.prepare(&nights, stop, progress))?;
    }
    if let Some(kitti) = &settings.data.kitti {
        for (what, part) in [
            ("real exposures for validation", Part::Validation),
            ("real exposures for training", Part::Train),
        ] {
            let clips = KittiClips::open(kitti, part)?;
            showing(what, |progress| cache.prepare_clips(&clips, stop, progress))?;
        }
    }
    Ok(cache)
}

/// Shows how far one preparation is.
fn showing(
    what: &str,
    prepare: impl FnOnce(&mut dyn FnMut(Prepared)) -> Result<(), CacheError>,
) -> Result<(), Failure> {
    let bar = progress::bar(0, &format!("making {what}"));
    let started = Instant::now();
    let mut last = Prepared::default();
    let done = prepare(&mut |now: Prepared| {
        bar.set_length(now.total);
        bar.set_position(now.done);
        if bar.is_hidden() && now.rendered / 160 != last.rendered / 160 {
            let pace = started.elapsed().as_secs_f64() / now.rendered as f64;
            eprintln!("{} of {} {what}, {pace:.3} s each", now.done, now.total);
        }
        last = now;
    });
    bar.finish_and_clear();
    match done {
        Ok(()) => {}
        Err(CacheError::Interrupted) => return Err(Failure::Interrupted),
        Err(error) => return Err(error.into()),
    }
    if last.total > 0 {
        eprintln!("{} {what}, {} of them new", last.done, last.rendered);
    }
    Ok(())
}

/// Tells how a run goes: a bar on a terminal, a line now and then elsewhere.
struct Telling {
    bar: ProgressBar,
    last_line: Option<Instant>,
    /// Seconds a step takes, averaged over the last ones.
    pace_s: f64,
    /// Loss, averaged likewise, within one stage.
    loss: Option<(Kind, f64)>,
}

impl Telling {
    fn new() -> Self {
        Self {
            bar: progress::bar(0, "training"),
            last_line: None,
            pace_s: 0.0,
            loss: None,
        }
    }

    fn tell(&mut self, report: &Report<'_>) {
        match report {
            Report::Step(step) => self.step(step),
            Report::Validation(found) => self.line(&validation_line(found)),
            Report::Note(text) => self.line(text),
        }
    }

    fn line(&self, text: &str) {
        if self.bar.is_hidden() {
            eprintln!("{text}");
        } else {
            self.bar.println(text);
        }
    }

    fn step(&mut self, step: &StepReport<'_>) {
        self.pace_s = match self.pace_s {
            0.0 => step.seconds,
            pace => 0.95 * pace + 0.05 * step.seconds,
        };
        let loss = match self.loss {
            Some((kind, loss)) if kind == step.kind => 0.95 * loss + 0.05 * step.loss,
            _ => step.loss,
        };
        self.loss = Some((step.kind, loss));
        let left_s = self.pace_s * (step.totals - step.total) as f64;
        let mut text = format!(
            "stage {} step {}/{} loss {loss:.4}",
            step.kind.name(),
            step.step,
            step.steps
        );
        if let Some(beside) = step.beside {
            text += &format!(
                " (this batch {:.4}, the blurred picture {:.4}, spread {:.5})",
                step.loss, beside.blurred, beside.spread
            );
        }
        self.bar.set_length(step.totals);
        self.bar.set_position(step.total);
        self.bar.set_message(text.clone());
        let is_due = self.last_line.is_none_or(|at| at.elapsed() > LINE_EVERY);
        if self.bar.is_hidden() && is_due {
            self.last_line = Some(Instant::now());
            eprintln!(
                "{text}, {:.2} s/step, about {:.0} min left",
                self.pace_s,
                left_s / 60.0
            );
        }
    }
}

fn validation_line(found: &Validation) -> String {
    let mut line = format!("validation after {} steps:", found.step);
    if let Some(d) = found.depth {
        line += &format!(
            " nights of nearest: RMSE {:.3}, MAE {:.3}, edge band {:.3}, movers {:.3}, thin {:.3}; \
             MAE {:.0} mm; step 8 over step 1 {:.3}",
            d.rmse, d.mae, d.edge_mae, d.mover_mae, d.thin_mae, d.mae_mm, d.last_over_first
        );
    }
    if let Some(k) = found.kitti {
        line += &format!(
            "{} real frames of nearest: RMSE {:.3}, MAE {:.3}; MAE {:.0} mm",
            if found.depth.is_some() { ";" } else { "" },
            k.rmse,
            k.mae,
            k.mae_mm
        );
    }
    if let Some(p) = found.pictures {
        line += &format!(
            " loss {:.4} beside {:.4} for the blurred picture ({:.3}), spread {:.5}",
            p.loss,
            p.blurred,
            p.share(),
            p.spread
        );
    }
    format!("{line}; {:.0} s", found.seconds)
}

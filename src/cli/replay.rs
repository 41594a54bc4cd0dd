//! `noctule replay`: a recording through host and inference, with a report.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use clap::ValueEnum;
use noctule::config::Config;
use noctule::frame::ModelId;
use noctule::ingest::Pace;
use noctule::observe::{Kept, draw_sheet, score, truth_of, write_depth};
use noctule::replay::{HostOptions, Prepared, ReplayError, Session, SessionOptions};
use noctule_recording::ExposureTruth;

use super::{Failure, Outcome, progress, stop_on_signals};

/// How the report is printed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ReportForm {
    /// Tables
    Text,
    /// One JSON object
    Json,
}

/// Arguments of `noctule replay`.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Recording directory, Prophesee RAW file or packet capture
    recording: PathBuf,
    #[command(flatten)]
    how: How,
}

/// Everything but the recording; the demo takes it too.
#[derive(Debug, Clone, clap::Args)]
pub struct How {
    /// Configuration file; without it the built-in defaults
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Name of this run; two of different names share nothing
    #[arg(long)]
    instance: Option<String>,
    /// realtime, max, or a factor such as 0.5
    #[arg(long, default_value = "realtime", value_parser = parse_pace)]
    pace: Pace,
    /// Drop nothing and run one fixed model: the same bytes out at any pace
    #[arg(long)]
    lossless: bool,
    /// nearest, fill, xs, s or full, over the configuration's
    #[arg(long)]
    model: Option<ModelId>,
    /// Folder for pictures, depth maps and the report
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Form of the report on standard output
    #[arg(long, value_enum, default_value = "text")]
    report: ReportForm,
    /// Exposures drawn and scored at most; a whole sequence takes about 8 MB of memory
    #[arg(long, default_value_t = 64)]
    keep: usize,
    /// Hand byte streams on in pieces of this many bytes; results do not depend on it
    #[arg(long, value_name = "BYTES", hide = true)]
    piece_bytes: Option<usize>,
}

fn parse_pace(text: &str) -> Result<Pace, String> {
    text.parse()
}

/// Runs and reports.
pub fn run(arguments: &Arguments) -> Outcome {
    let stop = stop_on_signals()?;
    replay(&arguments.recording, &arguments.how, &stop)
}

/// Runs one recording, draws, scores and prints; the demo ends with the same.
#[expect(clippy::print_stdout, reason = "the report is this command's output")]
pub fn replay(recording: &Path, how: &How, stop: &Arc<AtomicBool>) -> Outcome {
    let mut config = match &how.config {
        Some(path) => Config::load(path)?,
        None => Config::default(),
    };
    config.instance = how.instance.clone().unwrap_or_else(|| {
        // Runs beside one another, and beside a vehicle's own, must not meet.
        format!("replay-{}", std::process::id())
    });
    if let Some(model) = how.model {
        config.infer.model = model;
    }
    config.validate("command line")?;
    let prepared = Prepared::open(recording, &config)?;
    let options = SessionOptions {
        host: HostOptions {
            pace: how.pace,
            piece_bytes: how.piece_bytes,
        },
        lossless: how.lossless,
        model: how.model,
        config_path: how.config.clone(),
        program: std::env::current_exe().map_err(ReplayError::Program)?,
        keep: how.keep,
    };
    let spinner = progress::spinner("waiting for inference");
    let session = Session::run(&prepared, &config, &options, stop, &|bundles, frames| {
        spinner.set_message(format!("{bundles} exposures, {frames} depth maps"));
    });
    spinner.finish_and_clear();
    let mut session = session?;
    let kept = session.observed.kept.values();
    session.report.scores = score(prepared.recording(), kept, config.grid.depth_m_max)?;
    if let Some(out) = &how.out {
        write_out(&prepared, &session, out)?;
    }
    match how.report {
        ReportForm::Text => print!("{}", session.report.text()),
        ReportForm::Json => println!("{}", serde_json::to_string(&session.report)?),
    }
    if let Some(out) = &how.out {
        eprintln!("pictures and depth maps in {}", out.display());
    }
    if stop.load(Ordering::Relaxed) {
        Err(Failure::Interrupted)
    } else {
        Ok(())
    }
}

/// Writes contact sheets, depth maps and the report.
fn write_out(prepared: &Prepared, session: &Session, out: &Path) -> Result<(), Failure> {
    let (sheets, depth) = (out.join("sheets"), out.join("depth"));
    for folder in [&sheets, &depth] {
        std::fs::create_dir_all(folder)?;
    }
    std::fs::write(
        out.join("report.json"),
        serde_json::to_string_pretty(&session.report)?,
    )?;
    std::fs::write(out.join("report.txt"), session.report.text())?;
    let recording = prepared.recording();
    let truths: Vec<ExposureTruth> = match recording.exposures_truth() {
        Ok(truths) => truths.collect::<Result<_, _>>()?,
        Err(_) => Vec::new(),
    };
    let samples = recording.samples()?;
    let bar = progress::bar(session.observed.kept.len() as u64, "drawing");
    for kept in session
        .observed
        .kept
        .values()
        .filter(|k: &&Kept| !k.depth.is_empty())
    {
        let truth = truth_of(kept, &truths)
            .filter(|t| samples.contains(&t.index))
            .map(|t| recording.sample_truth(t.index))
            .transpose()?;
        let path = sheets.join(format!("{:06}.png", kept.header.sequence));
        draw_sheet(kept, truth.as_ref(), &path)?;
        write_depth(kept, &depth)?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    if session.observed.not_kept > 0 {
        eprintln!(
            "{} further exposures were neither drawn nor scored (--keep {})",
            session.observed.not_kept,
            session.observed.kept.len()
        );
    }
    Ok(())
}

//! `noctule eval`: how good depth is, against exact truth.

use std::path::{Path, PathBuf};

use clap::ValueEnum;
use noctule::config::Config;
use noctule::dataset::RecordedScenes;
use noctule_erunet::PlanOptions;
use noctule_learn::{
    DataSet, EvalError, Gallery, KittiScenes, Method, NyuScenes, Observed, RgbdScenes, Scenes,
    Scores, Share, Withheld, csv, evaluate, markdown,
};

use super::{Failure, Outcome, named, progress, stop_on_signals};

/// Arguments of `noctule eval`.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Networks: `xs`, `s` (part of the program) or weights files; baselines are always there
    #[arg(long, value_name = "NAME|FILE", value_delimiter = ',')]
    weights: Vec<String>,
    /// `world:TIER:FIRST..LAST` (seeds, last excluded), `rec:DIR`, `kitti:ROOT`, `nyu:ROOT` or
    /// `rgbd:ROOT`
    ///
    /// kitti: official folders of depth completion or of raw drives with their calibration. nyu: raw
    /// scenes, pre-processed `00001.h5`, or `nyu_depth_v2_labeled.mat` with `splits.mat` beside it,
    /// whose frames for testing are scored. rgbd: sequences as 7-Scenes has them.
    #[arg(long, required_unless_present = "merge")]
    data: Option<DataSet>,
    /// What is printed
    #[arg(long, default_value = "md")]
    table: Table,
    /// Part i of n (from 0) of the exposures; merge the parts' tables with --merge
    #[arg(long, value_name = "i/n", default_value = "0/1")]
    shard: Share,
    /// Writes the table of single images
    #[arg(long, value_name = "FILE")]
    per_image: Option<PathBuf>,
    /// Draws six of the exposures: inputs, depth, truth and error of the last network
    #[arg(long, value_name = "PNG", conflicts_with = "merge")]
    pictures: Option<PathBuf>,
    /// What networks may see: `full`, or `no-events`, `no-image`, `no-lidar`, `no-ground`, and
    /// `ground-off:ROWS` (told that many rows too low), joined by `+`; one row each
    #[arg(long, value_delimiter = ',', default_value = "full")]
    inputs: Vec<Withheld>,
    /// Merges tables of single images in place of evaluating
    #[arg(long, value_name = "FILE", num_args = 1.., conflicts_with_all = ["data", "weights"])]
    merge: Vec<PathBuf>,
    /// Processor threads
    #[arg(long, value_name = "N", default_value_t = 1)]
    threads: usize,
    /// Configuration file of the host, for recordings; without it the built-in defaults
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Table {
    /// For people
    Md,
    /// All methods, all steps
    Csv,
    /// `{rows: [{method, rmse_mm, mae_mm, ...}]}`
    Json,
}

/// Evaluates or merges, and prints.
pub fn run(arguments: &Arguments) -> Outcome {
    let scores = match &arguments.data {
        None => merged(&arguments.merge)?,
        Some(data) => evaluated(arguments, data)?,
    };
    if let Some(path) = &arguments.per_image {
        std::fs::write(path, scores.per_image_csv()).map_err(in_file(path))?;
    }
    print(&scores, arguments)
}

fn in_file(path: &Path) -> impl FnOnce(std::io::Error) -> EvalError {
    |source| EvalError::File {
        path: path.into(),
        source,
    }
}

fn merged(files: &[PathBuf]) -> Result<Scores, Failure> {
    let mut scores = Scores::default();
    for path in files {
        let text = std::fs::read_to_string(path).map_err(in_file(path))?;
        scores.merge_csv(&text, path)?;
    }
    Ok(scores)
}

fn evaluated(arguments: &Arguments, data: &DataSet) -> Result<Scores, Failure> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(arguments.threads.max(1))
        .build_global()?;
    let stop = stop_on_signals()?;
    let mut methods = methods(arguments)?;
    let config = match &arguments.config {
        Some(path) => Config::load(path)?,
        None => Config::default(),
    };
    let (recorded, kitti, nyu, rgbd);
    let scenes: &dyn Scenes = match data {
        DataSet::World(world) => world,
        DataSet::Recording(path) => {
            recorded = RecordedScenes::open(path, &config, &stop)?;
            &recorded
        }
        DataSet::Kitti(root) => {
            kitti = KittiScenes::open(root).map_err(EvalError::from)?;
            &kitti
        }
        DataSet::Nyu(root) => {
            nyu = NyuScenes::open(root).map_err(EvalError::from)?;
            &nyu
        }
        DataSet::Rgbd(root) => {
            rgbd = RgbdScenes::open(root).map_err(EvalError::from)?;
            &rgbd
        }
    };
    let bar = progress::bar(0, "scoring exposures");
    let mut gallery = Gallery::default();
    let scores = evaluate(
        scenes,
        &mut methods,
        arguments.shard,
        &stop,
        &mut |observed| {
            let (done, of) = observed.progress;
            bar.set_length(of as u64);
            bar.set_position(done as u64);
            match arguments.pictures {
                Some(_) => {
                    let networks = arguments.weights.len() * arguments.inputs.len();
                    draw(&mut gallery, networks, observed)
                }
                None => Ok(()),
            }
        },
    );
    bar.finish_and_clear();
    if let (Some(path), Ok(_)) = (&arguments.pictures, &scores) {
        gallery.save(path, &arguments.weights.join(", "))?;
    }
    match scores {
        Err(EvalError::Interrupted) => Err(Failure::Interrupted),
        scores => Ok(scores?),
    }
}

/// The nearest return and what the networks make of it, beside inputs and truth.
fn draw(gallery: &mut Gallery, networks: usize, observed: &Observed<'_>) -> Result<(), EvalError> {
    let nearest = observed.maps.iter().filter(|(name, _)| name == "nearest");
    let drawn: Vec<(&str, &[f32])> = nearest
        .chain(observed.maps.iter().take(networks))
        .map(|(name, maps)| (name.as_str(), &maps[..]))
        .collect();
    let (done, of) = observed.progress;
    gallery.add((done - 1, of), observed.scene, &drawn)
}

/// Networks by what they may see, then what needs no learning.
fn methods(arguments: &Arguments) -> Result<Vec<Method>, Failure> {
    let options = PlanOptions {
        threads: arguments.threads.max(1),
        ..PlanOptions::default()
    };
    let mut methods = Vec::new();
    for name in &arguments.weights {
        let label = Path::new(name).file_stem().unwrap_or_default();
        let weights = named::weights(name)?;
        for inputs in &arguments.inputs {
            let (label, weights) = (label.to_string_lossy(), weights.clone());
            methods.push(Method::of_weights(&label, weights, *inputs, options)?);
        }
    }
    methods.extend(Method::baselines());
    Ok(methods)
}

#[expect(clippy::print_stdout, reason = "the table is this command's output")]
fn print(scores: &Scores, arguments: &Arguments) -> Outcome {
    let rows = scores.rows();
    match arguments.table {
        Table::Md => print!("{}", markdown(&rows)),
        Table::Csv => print!("{}", csv(&rows)),
        Table::Json => println!("{}", serde_json::json!({ "rows": rows })),
    }
    Ok(())
}

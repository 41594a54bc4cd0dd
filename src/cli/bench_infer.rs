//! `noctule bench infer`: the networks' speed on this machine's processors.

use std::path::Path;

use candle_core::Device;
use noctule::bench::{InferPlan, bench_infer};
use noctule::config::SHIPPED;
use noctule_erunet::{Config, Weights};
use noctule_kernels::Precision;

use super::{Failure, Outcome, named, progress};

/// Arguments of `noctule bench infer`.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// xs, s, full, or a file: a network's widths in JSON or its weights in safetensors
    #[arg(long, value_name = "NAME|FILE", value_delimiter = ',', default_values = ["xs", "s"])]
    config: Vec<String>,
    /// Threads that work together; without it 1 and 2
    #[arg(long, value_delimiter = ',', default_values_t = [1, 2])]
    threads: Vec<usize>,
    /// How numbers are stored; without it both
    #[arg(long, value_enum, value_delimiter = ',', default_values = ["f32", "bf16"])]
    precision: Vec<Stored>,
    /// Sides of the picture, pixels, multiples of 16
    #[arg(long, value_delimiter = ',', default_values_t = [256])]
    size: Vec<usize>,
    /// Depth maps per exposure
    #[arg(long, value_delimiter = ',', default_values_t = [8])]
    steps: Vec<usize>,
    /// Exposures timed for each row
    #[arg(long, default_value_t = 7)]
    rounds: usize,
    /// Leave out the comparison with candle (half a minute for full)
    #[arg(long)]
    no_reference: bool,
    /// Say where the time goes, layer by layer beside the roofline
    #[arg(long)]
    layers: bool,
    /// JSON instead of tables
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum Stored {
    F32,
    Bf16,
}

/// Runs the benchmark and prints its tables.
#[expect(clippy::print_stdout, reason = "the tables are this command's output")]
pub fn run(arguments: &Arguments) -> Outcome {
    let networks = arguments.config.iter().map(|name| network(name));
    let plan = InferPlan {
        networks: networks.collect::<Result<_, _>>()?,
        threads: arguments.threads.clone(),
        precisions: arguments
            .precision
            .iter()
            .map(|precision| match precision {
                Stored::F32 => Precision::Single,
                Stored::Bf16 => Precision::Brain,
            })
            .collect(),
        sizes: arguments.size.clone(),
        steps: arguments.steps.clone(),
        rounds: arguments.rounds,
        reference: !arguments.no_reference,
        layers: arguments.layers,
    };
    let spinner = progress::spinner("starting");
    let say = |text: &str| spinner.set_message(text.to_owned());
    let bench = bench_infer(&plan, &say);
    spinner.finish_and_clear();
    let bench = bench?;
    if arguments.json {
        println!("{}", serde_json::to_string(&bench)?);
    } else {
        print!("{}", bench.text());
    }
    Ok(())
}

/// A member of the family, with its own weights where they ship, or a file's network. Without
/// weights random ones do: speed does not depend on them.
fn network(name: &str) -> Result<(Config, Weights), Failure> {
    let has_weights = name.parse().is_ok_and(|model| SHIPPED.contains(&model));
    if has_weights
        || Path::new(name)
            .extension()
            .is_some_and(|e| e == "safetensors")
    {
        let weights = named::weights(name)?;
        let config = weights.config().cloned();
        let config = config.ok_or_else(|| refused(format!("{name}: does not say its widths")))?;
        return Ok((config, weights));
    }
    let config = match Config::member(name) {
        Ok(config) => config,
        Err(unknown) if !Path::new(name).exists() => {
            return Err(refused(format!("{unknown}, and there is no such file")));
        }
        Err(_) => {
            let text = std::fs::read_to_string(name)?;
            Config::from_json(&text).map_err(|cause| refused(format!("{name}: {cause}")))?
        }
    };
    let weights = Weights::initial(&config, 1, &Device::Cpu)?;
    Ok((config, weights))
}

fn refused(reason: String) -> Failure {
    Failure::Error(reason.into())
}

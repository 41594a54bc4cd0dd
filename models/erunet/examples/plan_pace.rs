//! How fast the compiled plan is, and where its time goes:
//! `cargo run --release -p noctule-erunet --example plan_pace -- [OPTION]... NETWORK...`
//!
//! A network is a member of the family or a file with a configuration in JSON. Options, in any
//! order: `threads=1,2`, `precision=single,brain`, `rounds=5`, `layers` for the profile,
//! `candle` for candle's time beside it.
//!
//! Prints the time to the first depth map and of all steps at 256 x 256 pixels, best of several
//! rounds, and the rate as a share of the peak of multiply-adds on that many cores; with `layers`
//! every layer's shortest time beside its roofline bound. Peak and bandwidth are measured in the
//! same run.
#![allow(clippy::print_stdout, reason = "the program's purpose is to print")]
#![allow(clippy::cast_precision_loss, reason = "operation counts fit a double")]

use std::error::Error;
use std::time::Instant;

use candle_core::{Device, Tensor};
use noctule_erunet::{Config, LayerProfile, Network, Norms, Plan, PlanOptions, Weights, describe};
use noctule_kernels::{Isa, Precision, spin, stream};

const SIDE: usize = 256;
const AREA: usize = SIDE * SIDE;

/// Seconds to the first depth map, and to the last.
type Times = (f64, f64);

/// What the command line asks for.
struct Wishes {
    threads: Vec<usize>,
    precisions: Vec<Precision>,
    rounds: usize,
    layers: bool,
    candle: bool,
    networks: Vec<Config>,
}

impl Wishes {
    fn read(arguments: impl Iterator<Item = String>) -> Result<Self, Box<dyn Error>> {
        let mut wishes = Self {
            threads: vec![1, 2],
            precisions: vec![Precision::Single, Precision::Brain],
            rounds: 5,
            layers: false,
            candle: false,
            networks: Vec::new(),
        };
        for argument in arguments {
            match argument.split_once('=') {
                Some(("threads", list)) => {
                    wishes.threads = list.split(',').map(str::parse).collect::<Result<_, _>>()?;
                }
                Some(("precision", list)) => {
                    wishes.precisions = list.split(',').map(precision).collect::<Result<_, _>>()?;
                }
                Some(("rounds", count)) => wishes.rounds = count.parse()?,
                None if argument == "layers" => wishes.layers = true,
                None if argument == "candle" => wishes.candle = true,
                _ => wishes.networks.push(network(&argument)?),
            }
        }
        Ok(wishes)
    }
}

fn precision(name: &str) -> Result<Precision, String> {
    match name {
        "single" => Ok(Precision::Single),
        "brain" => Ok(Precision::Brain),
        other => Err(format!("precision is \"{other}\", wanted single or brain")),
    }
}

fn network(argument: &str) -> Result<Config, Box<dyn Error>> {
    match Config::member(argument) {
        Ok(config) => Ok(config),
        Err(_) => Ok(Config::from_json(&std::fs::read_to_string(argument)?)?),
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    let wishes = Wishes::read(std::env::args().skip(1))?;
    for config in &wishes.networks {
        let weights = Weights::initial(config, 1, &Device::Cpu)?;
        for &precision in &wishes.precisions {
            for &threads in &wishes.threads {
                let options = PlanOptions {
                    threads,
                    precision,
                    ..PlanOptions::default()
                };
                measure(&wishes, config, &weights, options)?;
            }
        }
        if wishes.candle {
            let (first, all) = candle(config, &weights, wishes.rounds)?;
            println!("{} candle: first {first:.4} s, all {all:.4} s", config.name);
        }
    }
    Ok(())
}

fn measure(
    wishes: &Wishes,
    config: &Config,
    weights: &Weights,
    options: PlanOptions,
) -> Result<(), Box<dyn Error>> {
    let PlanOptions {
        threads, precision, ..
    } = options;
    let mut plan = Plan::new(config, weights, SIDE, SIDE, options)?;
    let peak = threads as f64 * peak(precision);
    let (first, all) = pace(&mut plan, config, wishes.rounds)?;
    let flop = 2e9 * describe(config, SIDE, SIDE)?.gmac;
    let layers = plan.profile(wishes.rounds)?;
    let sum: f64 = layers
        .iter()
        .map(|layer| layer.runs as f64 * layer.op.seconds)
        .sum();
    println!(
        "{} {precision:?} {threads} threads: first {first:.4} s, all {all:.4} s, {:.1} % of {:.0} \
         GFLOP/s; sum of layers {sum:.4} s, {:.1} %",
        config.name,
        100.0 * flop / all / peak,
        peak / 1e9,
        100.0 * flop / sum / peak,
    );
    if wishes.layers {
        let bandwidth = threads as f64 * bandwidth(plan.memory_bytes().0);
        print_layers(&layers, peak, bandwidth);
    }
    Ok(())
}

/// One line per layer: milliseconds per exposure, share of the sum, rate, share of its bound.
fn print_layers(layers: &[LayerProfile], peak: f64, bandwidth: f64) {
    let spent = |layer: &LayerProfile| layer.runs as f64 * layer.op.seconds;
    let bound = |layer: &LayerProfile| layer.runs as f64 * layer.op.bound(peak, bandwidth);
    let sum: f64 = layers.iter().map(spent).sum();
    println!(
        "  bandwidth {:.1} GB/s at the arena's size",
        bandwidth / 1e9
    );
    for layer in layers {
        let op = &layer.op;
        println!(
            "  {:<24} {:<22} {:>3}x{:<3} pass {} {:9.3} ms {:5.2} % {:7.1} GFLOP/s {:7.2} GB/s \
             {:6.1} % of bound",
            op.name,
            op.kind,
            op.size[0],
            op.size[1],
            op.pass,
            1e3 * spent(layer),
            100.0 * spent(layer) / sum,
            2e-9 * op.macs as f64 / op.seconds,
            1e-9 * (op.feature_bytes + op.weight_bytes) as f64 / op.seconds,
            100.0 * bound(layer) / spent(layer),
        );
    }
    let bounds: f64 = layers.iter().map(bound).sum();
    println!(
        "  bound of all layers {:.1} ms, {:.1} % of the time",
        1e3 * bounds,
        100.0 * bounds / sum
    );
}

/// Floating-point operations per second of one core, best of several.
fn peak(precision: Precision) -> f64 {
    let rates = (0..20).map(|_| {
        let started = Instant::now();
        let flop = spin(Isa::detect(), precision, 200_000).unwrap_or(0);
        flop as f64 / started.elapsed().as_secs_f64()
    });
    rates.fold(0.0, f64::max)
}

/// Bytes per second one core reads and writes within `bytes` of memory, best of several.
fn bandwidth(bytes: usize) -> f64 {
    let mut memory = vec![1e-30; bytes / size_of::<f32>()];
    let rates = (0..20).map(|_| {
        let started = Instant::now();
        let moved = stream(Isa::detect(), &mut memory, 2).unwrap_or(0);
        moved as f64 / started.elapsed().as_secs_f64()
    });
    rates.fold(0.0, f64::max)
}

fn shortest(
    rounds: usize,
    mut round: impl FnMut() -> Result<Times, Box<dyn Error>>,
) -> Result<Times, Box<dyn Error>> {
    let mut best = (f64::INFINITY, f64::INFINITY);
    for _ in 0..rounds {
        let (first, all) = round()?;
        best = (best.0.min(first), best.1.min(all));
    }
    Ok(best)
}

fn pace(plan: &mut Plan, config: &Config, rounds: usize) -> Result<Times, Box<dyn Error>> {
    let (blur, voxel) = (vec![0.5; 3 * AREA], vec![0.1; config.bins * AREA]);
    let sparse: Vec<f32> = (0..AREA)
        .map(|i| if i % 31 == 0 { 20.0 } else { 0.0 })
        .collect();
    let (mut depth, mut trust) = (vec![0.0; AREA], vec![0.0; AREA]);
    shortest(rounds, || {
        let started = Instant::now();
        plan.begin(&blur)?;
        plan.step(&voxel, &sparse, &mut depth, &mut trust)?;
        let first = started.elapsed().as_secs_f64();
        for _ in 1..config.steps {
            plan.step(&voxel, &sparse, &mut depth, &mut trust)?;
        }
        Ok((first, started.elapsed().as_secs_f64()))
    })
}

fn candle(config: &Config, weights: &Weights, rounds: usize) -> Result<Times, Box<dyn Error>> {
    let network = Network::new(config, weights, Norms::Fold)?;
    let random = |channels| Tensor::rand(0f32, 1f32, (1, channels, SIDE, SIDE), &Device::Cpu);
    let (blur, voxel, sparse) = (random(3)?, random(config.bins)?, random(1)?);
    shortest(rounds, || {
        let started = Instant::now();
        let mut sequence = network.begin(&blur)?;
        sequence.step(&voxel, &sparse)?;
        let first = started.elapsed().as_secs_f64();
        for _ in 1..config.steps {
            sequence.step(&voxel, &sparse)?;
        }
        Ok((first, started.elapsed().as_secs_f64()))
    })
}

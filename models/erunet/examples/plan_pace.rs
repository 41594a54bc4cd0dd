//! The compiled plan beside candle's network, in one run:
//! `cargo run --release -p noctule-erunet --example plan_pace -- xs s`.
//!
//! Prints, per member of the family, precision and number of threads, the time to the first depth
//! map and of all steps at 256 x 256 pixels, best of several, and the rate as a share of the peak
//! of multiply-adds on that many cores, measured in the same run.
#![allow(clippy::print_stdout, reason = "the program's purpose is to print")]
#![allow(clippy::cast_precision_loss, reason = "operation counts fit a double")]

use std::error::Error;
use std::time::Instant;

use candle_core::{Device, Tensor};
use noctule_erunet::{Config, Network, Norms, Plan, PlanOptions, Weights, describe};
use noctule_kernels::{Isa, Precision, spin};

const SIDE: usize = 256;
const AREA: usize = SIDE * SIDE;
const ROUNDS: usize = 5;

/// Seconds to the first depth map, and to the last.
type Times = (f64, f64);

fn main() -> Result<(), Box<dyn Error>> {
    for member in std::env::args().skip(1) {
        let config = Config::member(&member)?;
        let weights = Weights::initial(&config, 1, &Device::Cpu)?;
        let gflop = 2.0 * describe(&config, SIDE, SIDE)?.gmac;
        for precision in [Precision::Single, Precision::Brain] {
            let peak = peak(precision);
            for threads in [1, 2] {
                let (first, all) = plan(&config, &weights, precision, threads)?;
                let share = gflop / all / (peak * threads as f64);
                println!(
                    "{member} {precision:?} {threads} threads: first {first:.4} s, all {all:.4} s, \
                     {:.1} % of {threads} x {peak:.0} GFLOP/s",
                    100.0 * share
                );
            }
        }
        let (first, all) = candle(&config, &weights)?;
        println!("{member} candle: first {first:.4} s, all {all:.4} s");
    }
    Ok(())
}

/// GFLOP/s of one core, best of several.
fn peak(precision: Precision) -> f64 {
    let rates = (0..ROUNDS).map(|_| {
        let started = Instant::now();
        let flop = spin(Isa::detect(), precision, 500_000).unwrap_or(0);
        flop as f64 / started.elapsed().as_secs_f64() / 1e9
    });
    rates.fold(0.0, f64::max)
}

fn shortest(
    mut round: impl FnMut() -> Result<Times, Box<dyn Error>>,
) -> Result<Times, Box<dyn Error>> {
    let mut best = (f64::INFINITY, f64::INFINITY);
    for _ in 0..ROUNDS {
        let (first, all) = round()?;
        best = (best.0.min(first), best.1.min(all));
    }
    Ok(best)
}

fn plan(
    config: &Config,
    weights: &Weights,
    precision: Precision,
    threads: usize,
) -> Result<Times, Box<dyn Error>> {
    let options = PlanOptions {
        threads,
        precision,
        ..PlanOptions::default()
    };
    let mut plan = Plan::new(config, weights, SIDE, SIDE, options)?;
    let (blur, voxel) = (vec![0.5; 3 * AREA], vec![0.1; config.bins * AREA]);
    let sparse: Vec<f32> = (0..AREA)
        .map(|i| if i % 31 == 0 { 20.0 } else { 0.0 })
        .collect();
    let (mut depth, mut trust) = (vec![0.0; AREA], vec![0.0; AREA]);
    shortest(|| {
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

fn candle(config: &Config, weights: &Weights) -> Result<Times, Box<dyn Error>> {
    let network = Network::new(config, weights, Norms::Fold)?;
    let random = |channels| Tensor::rand(0f32, 1f32, (1, channels, SIDE, SIDE), &Device::Cpu);
    let (blur, voxel, sparse) = (random(3)?, random(config.bins)?, random(1)?);
    shortest(|| {
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

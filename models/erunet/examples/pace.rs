//! How long one exposure takes: `cargo run --release -p noctule-erunet --example pace -- xs s`.
//!
//! Prints, per member of the family, the time to the first depth map and the time of all steps
//! at 256 x 256 pixels, best of three, with random weights and inputs.
#![allow(clippy::print_stdout, reason = "the program's purpose is to print")]

use std::error::Error;
use std::time::{Duration, Instant};

use candle_core::{Device, Tensor};
use noctule_erunet::{Config, Network, Norms, Weights, describe};

const SIDE: usize = 256;
const ROUNDS: usize = 3;

fn main() -> Result<(), Box<dyn Error>> {
    for member in std::env::args().skip(1) {
        let config = Config::member(&member)?;
        let weights = Weights::initial(&config, 1, &Device::Cpu)?;
        let network = Network::new(&config, &weights, Norms::Fold)?;
        let rounds: Vec<_> = (0..ROUNDS)
            .map(|_| exposure(&network))
            .collect::<Result<_, _>>()?;
        let (first, all) = rounds
            .into_iter()
            .min_by_key(|(_, all)| *all)
            .unwrap_or_default();
        let gmac = describe(&config, SIDE, SIDE)?.gmac;
        println!(
            "{member}: first depth after {:.3} s, {} steps in {:.3} s, {:.1} GMAC/s",
            first.as_secs_f64(),
            config.steps,
            all.as_secs_f64(),
            gmac / all.as_secs_f64(),
        );
    }
    Ok(())
}

/// Time to the first depth map, and to the last.
fn exposure(network: &Network) -> Result<(Duration, Duration), Box<dyn Error>> {
    let random = |channels| Tensor::rand(0f32, 1f32, (1, channels, SIDE, SIDE), &Device::Cpu);
    let (blur, voxel, sparse) = (random(3)?, random(network.config().bins)?, random(1)?);
    let started = Instant::now();
    let mut sequence = network.begin(&blur)?;
    sequence.step(&voxel, &sparse)?;
    let first = started.elapsed();
    for _ in 1..network.config().steps {
        sequence.step(&voxel, &sparse)?;
    }
    Ok((first, started.elapsed()))
}

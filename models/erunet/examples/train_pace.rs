//! How long a training step takes: `cargo run --release -p noctule-erunet --example train_pace`.
//!
//! Runs stage 3 (everything trains, running statistics) or, with `--stage 2`, the depth network
//! alone with batch statistics: forward, depth loss, backward, Adam. Prints the median of several
//! steps. `--member`, `--batch`, `--side`, `--steps`, `--rounds` and `--threads` change the rest.
//! With `--serve` a step is run for each line read, and its milliseconds printed, so that another
//! program can take turns with this one (`scripts/train_race.py`).
#![allow(clippy::print_stdout, reason = "the program's purpose is to print")]

use std::error::Error;
use std::time::Instant;

use candle_core::{Device, Tensor, Var};
use noctule_erunet::{Adam, AdamOptions, Config, Network, Norms, Pass, Role, Weights, slots};

type Outcome<T> = Result<T, Box<dyn Error + Send + Sync>>;

struct Options {
    member: String,
    stage: usize,
    batch: usize,
    side: usize,
    steps: usize,
    rounds: usize,
    threads: usize,
    serve: bool,
}

impl Options {
    fn from_args() -> Outcome<Self> {
        let mut options = Self {
            member: "xs".into(),
            stage: 3,
            batch: 2,
            side: 128,
            steps: 4,
            rounds: 7,
            threads: 1,
            serve: false,
        };
        let mut args = std::env::args().skip(1);
        while let Some(name) = args.next() {
            if name == "--serve" {
                options.serve = true;
                continue;
            }
            let value = args.next().ok_or(format!("{name} wants a value"))?;
            match name.as_str() {
                "--member" => options.member = value,
                "--stage" => options.stage = value.parse()?,
                "--batch" => options.batch = value.parse()?,
                "--side" => options.side = value.parse()?,
                "--steps" => options.steps = value.parse()?,
                "--rounds" => options.rounds = value.parse()?,
                "--threads" => options.threads = value.parse()?,
                _ => return Err(format!("no option {name}").into()),
            }
        }
        Ok(options)
    }
}

struct Training {
    network: Network,
    adam: Adam,
    stage: usize,
    blur: Tensor,
    voxel: Tensor,
    sparse: Tensor,
    truth: Tensor,
}

impl Training {
    fn new(options: &Options) -> Outcome<Self> {
        let mut config = Config::member(&options.member)?;
        config.steps = options.steps;
        let stage = options.stage;
        let initial = Weights::initial(&config, 1, &Device::Cpu)?;
        let mut tensors = initial.tensors().clone();
        let mut vars = Vec::new();
        for slot in slots(&config)? {
            let trains = slot.name.starts_with("rdu.") || stage == 3;
            if slot.role == Role::Trained && trains && !slot.name.starts_with("efr.recon.") {
                let var = Var::from_tensor(&tensors[&slot.name])?;
                tensors.insert(slot.name.clone(), var.as_tensor().clone());
                vars.push((slot.name, var));
            }
        }
        let weights = Weights::from_tensors(&config, tensors, &Device::Cpu)?;
        let (b, t, side) = (options.batch, options.steps, options.side);
        let random = |low: f32, high: f32, channels: usize| {
            Tensor::rand(low, high, (b, t, channels, side, side), &Device::Cpu)
        };
        let truth = random(1.0, 80.0, 1)?;
        let returned = random(0.0, 1.0, 1)?.lt(0.03)?.to_dtype(truth.dtype())?;
        Ok(Self {
            network: Network::new(&config, &weights, Norms::Keep)?,
            adam: Adam::new(vars, AdamOptions::default())?,
            stage,
            blur: random(0.0, 1.0, 3)?.narrow(1, 0, 1)?.squeeze(1)?,
            voxel: random(-1.0, 1.0, config.bins)?,
            sparse: (&truth * returned)?,
            truth,
        })
    }

    /// Forward, loss, backward, update; returns the loss.
    fn step(&mut self) -> Outcome<f32> {
        let mut pass = if self.stage == 2 {
            Pass::training()
        } else {
            Pass::plain()
        };
        let clear = self.network.restore(&self.blur, &self.voxel, &mut pass)?;
        let outputs = self
            .network
            .complete(&clear, &self.voxel, &self.sparse, &mut pass)?;
        let loss = depth_loss(&outputs.depth, &self.truth, &self.sparse)?;
        let grads = loss.backward()?;
        self.adam.step(&grads, 1e-5, Some(1.0))?;
        Ok(loss.to_scalar()?)
    }
}

/// Sum over steps of the mean of `error` where `mask` is one, over all exposures of the batch.
fn masked_mean(error: &Tensor, mask: &Tensor) -> candle_core::Result<Tensor> {
    let by_step = |x: &Tensor| x.transpose(0, 1)?.contiguous()?.flatten_from(1)?.sum(1);
    (by_step(&(error * mask)?)? / by_step(mask)?.maximum(1f32)?)?.sum_all()
}

fn differences(x: &Tensor, dim: usize) -> candle_core::Result<Tensor> {
    let len = x.dim(dim)? - 1;
    x.narrow(dim, 1, len)? - x.narrow(dim, 0, len)?
}

/// Equations 12 to 15.
fn depth_loss(depth: &Tensor, truth: &Tensor, sparse: &Tensor) -> candle_core::Result<Tensor> {
    let known = truth.gt(0f32)?.to_dtype(truth.dtype())?;
    let both = (sparse.gt(0f32)?.to_dtype(truth.dtype())? * &known)?;
    let error = (depth - truth)?.abs()?;
    let mut extra = masked_mean(&error, &both)?;
    for dim in [4, 3] {
        let len = truth.dim(dim)? - 1;
        let mask = (both.narrow(dim, 0, len)? * known.narrow(dim, 1, len)?)?;
        let slope = (differences(depth, dim)? - differences(truth, dim)?)?.abs()?;
        extra = (extra + masked_mean(&slope, &mask)?)?;
    }
    masked_mean(&error, &known)? + (extra * 0.5)?
}

/// Milliseconds of one step.
fn timed(training: &mut Training) -> Outcome<f64> {
    let started = Instant::now();
    training.step()?;
    Ok(1e3 * started.elapsed().as_secs_f64())
}

fn run(options: &Options) -> Outcome<()> {
    let mut training = Training::new(options)?;
    if options.serve {
        for line in std::io::stdin().lines() {
            line?;
            println!("{:.3}", timed(&mut training)?);
        }
        return Ok(());
    }
    timed(&mut training)?;
    let mut times: Vec<f64> = (0..options.rounds.max(1))
        .map(|_| timed(&mut training))
        .collect::<Outcome<_>>()?;
    times.sort_by(f64::total_cmp);
    println!(
        "{} stage {}: {:.1} ms per step, least {:.1} ms, {} threads",
        options.member,
        options.stage,
        times[times.len() / 2],
        times[0],
        options.threads,
    );
    Ok(())
}

fn main() -> Outcome<()> {
    let options = Options::from_args()?;
    // On a thread of the pool operations need not be handed over to it one by one.
    let pool = rayon::ThreadPoolBuilder::new().num_threads(options.threads);
    pool.build_global()?;
    rayon::scope(|_| run(&options))
}

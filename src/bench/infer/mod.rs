//! How fast the networks are on this machine's processors, beside what the processors can do.
//!
//! Peak and bandwidth are measured in the same run, before and after; the best counts.

mod exposure;
mod machine;
mod report;

use std::time::Instant;

use candle_core::{Device, Tensor};
use noctule_erunet::{
    Config, Network, NetworkError, Norms, Plan, PlanError, PlanOptions, Weights, describe,
};
use noctule_kernels::{Isa, Precision};
use noctule_raster::RasterError;

use exposure::Exposure;
use machine::Machine;
pub use report::{InferBench, InferRow, LayerRow};

/// What to measure: every combination of the lists.
#[derive(Debug, Clone)]
pub struct InferPlan {
    /// Networks with their weights.
    pub networks: Vec<(Config, Weights)>,
    /// Numbers of threads.
    pub threads: Vec<usize>,
    /// How numbers are stored.
    pub precisions: Vec<Precision>,
    /// Sides of the picture, pixels.
    pub sizes: Vec<usize>,
    /// Depth maps per exposure.
    pub steps: Vec<usize>,
    /// Exposures timed per row, at least 1.
    pub rounds: usize,
    /// Whether to compare with candle.
    pub reference: bool,
    /// Whether to say where the time goes, layer by layer.
    pub layers: bool,
}

/// Why the benchmark could not run.
#[derive(Debug, thiserror::Error)]
pub enum InferBenchError {
    /// A plan.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// Candle's network.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// A configuration.
    #[error(transparent)]
    Config(#[from] noctule_erunet::ConfigError),
    /// A tensor.
    #[error("tensor operation failed: {0}")]
    Tensor(#[from] candle_core::Error),
    /// The exposure to run on.
    #[error(transparent)]
    Raster(#[from] RasterError),
    /// A size the world cannot be drawn in.
    #[error("{0} pixels is no multiple of 16 up to 2048")]
    Size(usize),
}

/// Depth maps of all steps.
type Maps = Vec<Vec<f32>>;

/// Times every combination on one exposure of the synthetic night; `say` tells what is going on.
///
/// # Errors
/// When a network cannot be built or run.
pub fn bench_infer(plan: &InferPlan, say: &dyn Fn(&str)) -> Result<InferBench, InferBenchError> {
    let isa = Isa::detect();
    say("measuring peaks");
    let mut machine = Machine::measure(isa);
    let mut rows = Vec::new();
    for &size in &plan.sizes {
        if size == 0 || size > 2048 || !size.is_multiple_of(16) {
            return Err(InferBenchError::Size(size));
        }
        for &steps in &plan.steps {
            say(&format!(
                "drawing an exposure of {steps} steps at {size} x {size}"
            ));
            let exposure = Exposure::draw(size, steps)?;
            for (config, weights) in &plan.networks {
                let config = config.clone().with_steps(steps);
                let reference = if plan.reference {
                    say(&format!("{} by candle", config.name));
                    Some(by_candle(&config, weights, &exposure)?)
                } else {
                    None
                };
                for (&precision, &threads) in plan
                    .precisions
                    .iter()
                    .flat_map(|p| plan.threads.iter().map(move |t| (p, t)))
                {
                    say(&format!("{} {precision:?}, {threads} threads", config.name));
                    let options = PlanOptions {
                        threads,
                        precision,
                        isa,
                    };
                    let work = Work {
                        config: &config,
                        weights,
                        exposure: &exposure,
                        reference: reference.as_ref(),
                        rounds: plan.rounds.max(1),
                        layers: plan.layers,
                    };
                    rows.push(work.row(options)?);
                }
            }
        }
    }
    machine.measure_again(isa);
    Ok(InferBench::new(machine, isa, rows))
}

/// One row's work.
struct Work<'a> {
    config: &'a Config,
    weights: &'a Weights,
    exposure: &'a Exposure,
    reference: Option<&'a Maps>,
    rounds: usize,
    layers: bool,
}

impl Work<'_> {
    fn row(&self, options: PlanOptions) -> Result<InferRow, InferBenchError> {
        let size = self.exposure.size;
        let mut plan = Plan::new(self.config, self.weights, size, size, options)?;
        let (mut all, mut first) = (Vec::new(), Vec::new());
        let mut maps = Maps::new();
        // The first round touches pages and fills caches; it is not counted.
        for round in 0..=self.rounds {
            let times = self.exposure.run(&mut plan, &mut maps)?;
            if round > 0 {
                first.push(times.first);
                all.push(times.all);
            }
        }
        let errors = self.reference.map(|reference| errors(&maps, reference));
        let layers = if self.layers {
            plan.profile(self.rounds.min(5))?
        } else {
            Vec::new()
        };
        let (arena_bytes, weight_bytes) = plan.memory_bytes();
        Ok(InferRow {
            config: self.config.name.clone(),
            precision: machine::precision_name(options.precision).into(),
            threads: options.threads,
            size,
            steps: self.config.steps,
            gmac: describe(self.config, size, size)?.gmac,
            seconds_median: median(&mut all),
            seconds_min: all.iter().copied().fold(f64::INFINITY, f64::min),
            first_step_seconds: median(&mut first),
            share_of_peak: 0.0,
            max_abs_err_m: errors.map(|e| e.max_m),
            mean_abs_err_m: errors.map(|e| e.mean_m),
            mean_err_share: errors.map(|e| e.mean_m / e.depth_m),
            arena_bytes,
            weight_bytes,
            layers: layers.into_iter().map(LayerRow::from).collect(),
        })
    }
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// How far depth maps are from candle's, metres.
#[derive(Clone, Copy)]
struct Errors {
    max_m: f64,
    mean_m: f64,
    /// Mean of candle's depth.
    depth_m: f64,
}

fn errors(maps: &Maps, reference: &Maps) -> Errors {
    let (mut max_m, mut sum, mut depth, mut count) = (0.0_f64, 0.0, 0.0, 0_u32);
    for (map, wanted) in maps.iter().zip(reference) {
        for (got, wanted) in map.iter().zip(wanted) {
            let error = f64::from((got - wanted).abs());
            // `max` would hide a NaN.
            max_m = if error <= max_m { max_m } else { error };
            sum += error;
            depth += f64::from(*wanted);
            count += 1;
        }
    }
    let count = f64::from(count.max(1));
    Errors {
        max_m,
        mean_m: sum / count,
        depth_m: depth / count,
    }
}

/// The definition's depth maps, in single precision.
fn by_candle(
    config: &Config,
    weights: &Weights,
    exposure: &Exposure,
) -> Result<Maps, InferBenchError> {
    let network = Network::new(config, weights, Norms::Fold)?;
    let size = exposure.size;
    let tensor = |values: &[f32], channels: usize| {
        Tensor::from_slice(values, (1, channels, size, size), &Device::Cpu)
    };
    let mut sequence = network.begin(&tensor(&exposure.blur, 3)?, exposure.ground.as_ref())?;
    let steps = exposure.steps().map(|(voxel, sparse)| {
        let step = sequence.step(&tensor(voxel, config.bins)?, &tensor(sparse, 1)?)?;
        Ok(step.depth.flatten_all()?.to_vec1()?)
    });
    steps.collect()
}

/// When depth maps were there, seconds from the picture.
struct Times {
    first: f64,
    all: f64,
}

impl Exposure {
    /// Runs the exposure once; `maps` receives the depth of every step.
    fn run(&self, plan: &mut Plan, maps: &mut Maps) -> Result<Times, PlanError> {
        let area = self.size * self.size;
        maps.resize_with(self.step_count(), || vec![0.0; area]);
        let mut trust = vec![0.0; area];
        let started = Instant::now();
        let mut first = None;
        plan.begin(&self.blur, self.ground.as_ref())?;
        for ((voxel, sparse), depth) in self.steps().zip(maps) {
            plan.step(voxel, sparse, depth, &mut trust)?;
            first.get_or_insert_with(|| started.elapsed().as_secs_f64());
        }
        let all = started.elapsed().as_secs_f64();
        Ok(Times {
            first: first.unwrap_or(all),
            all,
        })
    }
}

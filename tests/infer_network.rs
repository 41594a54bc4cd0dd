//! Networks behind the inference process's interface: the compiled plan against the definition.

#![cfg(feature = "model")]
#![allow(clippy::unwrap_used, reason = "tests")]

use std::path::Path;

use candle_core::{Device, Tensor};
use noctule::bench::{InferPlan, bench_infer};
use noctule::config::Config;
use noctule::frame::{BundlePlanes, ModelId};
use noctule::infer::{Engines, InferError, shipped_weights};
use noctule_erunet::{Config as Widths, Ground, Network, Norms, Weights};
use noctule_kernels::Precision;

/// Level ground seen from 1.5 m.
const GROUND: Option<Ground> = Some(Ground {
    per_column: 0.0,
    per_row: 0.01,
    first: -0.3,
});

/// A configuration for 64 x 96 pixels with weights of `xs` in `folder`, and those weights.
fn set_up(folder: &Path, extra: &str) -> (Config, Weights) {
    let weights = Weights::initial(&Widths::xs(), 5, &Device::Cpu).unwrap();
    let path = folder.join("xs.safetensors");
    weights.write(&path).unwrap();
    let text = format!(
        "[grid]\nwidth = 96\nheight = 64\n[infer]\nmodel = \"xs\"\n{extra}\n[infer.weights]\n\
         xs = \"{}\"\n",
        path.display()
    );
    (Config::parse(&text, "test").unwrap(), weights)
}

/// Numbers between 0 and 1 that repeat after a long while.
fn noise(len: usize, seed: usize) -> Vec<f32> {
    let value = |i: usize| ((i * 7919 + seed * 104_729) % 1009) as f32 / 1009.0;
    (0..len).map(value).collect()
}

struct Bundle {
    voxels: Vec<f32>,
    sparse: Vec<f32>,
    image: Vec<f32>,
}

impl Bundle {
    fn new(config: &Config) -> Self {
        let layout = config.bundle_layout();
        let voxels = noise(layout.voxels_len(), 1);
        let returns = noise(layout.sparse_len(), 2);
        Self {
            voxels: voxels.iter().map(|v| 2.0 * v - 1.0).collect(),
            sparse: returns
                .iter()
                .map(|v| if *v < 0.04 { 2.0 + 1000.0 * v } else { 0.0 })
                .collect(),
            image: noise(layout.image_len(), 3),
        }
    }

    fn planes(&self) -> BundlePlanes<'_> {
        BundlePlanes {
            voxels: &self.voxels,
            sparse: &self.sparse,
            image: &self.image,
        }
    }
}

fn by_engines(config: &Config, bundle: &Bundle) -> Vec<(Vec<f32>, Vec<f32>)> {
    let mut engines = Engines::load(config).unwrap();
    assert_eq!(
        engines.models(),
        [ModelId::Nearest, ModelId::Fill, ModelId::Xs]
    );
    let planes = bundle.planes();
    let mut run = engines
        .begin(ModelId::Xs, &planes, GROUND.as_ref())
        .unwrap();
    let area = config.bundle_layout().plane();
    let steps = (0..8).map(|step| {
        let (mut depth, mut trust) = (vec![f32::NAN; area], vec![f32::NAN; area]);
        run.step(&planes, step, &mut depth, &mut trust).unwrap();
        (depth, trust)
    });
    steps.collect()
}

fn by_candle(weights: &Weights, bundle: &Bundle) -> Vec<(Vec<f32>, Vec<f32>)> {
    let network = Network::new(&Widths::xs(), weights, Norms::Fold).unwrap();
    let area = 64 * 96;
    let tensor = |values: &[f32], channels| {
        Tensor::from_slice(values, (1, channels, 64, 96), &Device::Cpu).unwrap()
    };
    let flat = |t: Tensor| t.flatten_all().unwrap().to_vec1().unwrap();
    let mut sequence = network
        .begin(&tensor(&bundle.image, 3), GROUND.as_ref())
        .unwrap();
    let steps = bundle
        .voxels
        .chunks_exact(5 * area)
        .zip(bundle.sparse.chunks_exact(area));
    steps
        .map(|(voxel, sparse)| {
            let step = sequence
                .step(&tensor(voxel, 5), &tensor(sparse, 1))
                .unwrap();
            (flat(step.depth), flat(step.confidence))
        })
        .collect()
}

/// Mean difference of the depth maps over their mean.
fn mean_error(got: &[(Vec<f32>, Vec<f32>)], wanted: &[(Vec<f32>, Vec<f32>)]) -> f64 {
    let pairs = || {
        got.iter()
            .zip(wanted)
            .flat_map(|(g, w)| g.0.iter().zip(&w.0))
    };
    let error: f64 = pairs().map(|(g, w)| f64::from((g - w).abs())).sum();
    error / pairs().map(|(_, w)| f64::from(*w)).sum::<f64>()
}

#[test]
fn a_network_gives_what_its_definition_gives_whatever_the_threads() {
    let folder = tempfile::tempdir().unwrap();
    let (config, weights) = set_up(folder.path(), "threads = 1\nprecision = \"f32\"");
    let bundle = Bundle::new(&config);
    let wanted = by_candle(&weights, &bundle);
    let alone = by_engines(&config, &bundle);
    for ((depth, trust), (depth_wanted, trust_wanted)) in alone.iter().zip(&wanted) {
        for (got, wanted) in depth.iter().zip(depth_wanted) {
            assert!((got - wanted).abs() <= 1e-4 * wanted.abs().max(1.0));
        }
        for (got, wanted) in trust.iter().zip(trust_wanted) {
            assert!((got - wanted).abs() <= 1e-4);
        }
    }
    let (config, _) = set_up(folder.path(), "threads = 2\nprecision = \"f32\"");
    assert_eq!(by_engines(&config, &bundle), alone);
}

#[test]
fn brain_floats_are_asked_for_by_configuration() {
    let folder = tempfile::tempdir().unwrap();
    let (single, _) = set_up(folder.path(), "threads = 1\nprecision = \"f32\"");
    let (brain, _) = set_up(folder.path(), "threads = 1\nprecision = \"bf16\"");
    let bundle = Bundle::new(&single);
    let error = mean_error(&by_engines(&brain, &bundle), &by_engines(&single, &bundle));
    assert!(error > 0.0 && error < 0.1, "{error}");
}

/// The trained network on a night of the world: the compiled plan equals candle, and bfloat16 costs
/// less than half a percent of the depth.
#[test]
fn shipped_weights_survive_compilation_and_brain_floats() {
    let shipped = [ModelId::Xs, ModelId::S].map(|model| {
        let weights = Weights::from_bytes(shipped_weights(model).unwrap(), &Device::Cpu).unwrap();
        (weights.config().unwrap().clone(), weights)
    });
    let plan = InferPlan {
        networks: shipped.into(),
        threads: vec![1],
        precisions: vec![Precision::Single, Precision::Brain],
        sizes: vec![256],
        steps: vec![8],
        rounds: 1,
        reference: true,
        layers: false,
    };
    let bench = bench_infer(&plan, &|_| {}).unwrap();
    let shares: Vec<f64> = bench
        .rows
        .iter()
        .map(|r| r.mean_err_share.unwrap())
        .collect();
    eprintln!("mean error over mean depth, f32 and bf16 of each: {shares:?}");
    for (rows, shares) in bench.rows.chunks(2).zip(shares.chunks(2)) {
        assert!(rows[0].max_abs_err_m.unwrap() < 80.0 * 1e-4);
        assert!(shares[1] < 5e-3);
    }
}

#[test]
fn the_ladder_learns_the_times_of_what_can_run() {
    let folder = tempfile::tempdir().unwrap();
    let (config, _) = set_up(folder.path(), "threads = 1\nprecision = \"f32\"");
    let mut engines = Engines::load(&config).unwrap();
    let clock = std::cell::Cell::new(0);
    let now = || {
        clock.set(clock.get() + 10);
        clock.get()
    };
    let rungs = engines.measure(ModelId::Xs, &now).unwrap();
    let models: Vec<ModelId> = rungs.iter().map(|rung| rung.model).collect();
    assert_eq!(models, [ModelId::Nearest, ModelId::Fill, ModelId::Xs]);
    assert!(
        rungs
            .iter()
            .all(|rung| (rung.begin_ns, rung.step_ns) == (10, 10))
    );
}

#[test]
fn a_device_or_a_file_that_is_not_there_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let (config, _) = set_up(folder.path(), "device = \"cuda:63\"");
    let error = Engines::load(&config).err().unwrap();
    assert!(matches!(error, InferError::Device { index: 63, .. }));
    assert!(error.to_string().contains("cuda:63"), "{error}");

    let (mut config, _) = set_up(folder.path(), "");
    config
        .infer
        .weights
        .insert(ModelId::Xs, folder.path().join("none.safetensors"));
    let error = Engines::load(&config).err().unwrap();
    assert!(matches!(error, InferError::File { .. }));
    assert!(error.to_string().contains("none.safetensors"), "{error}");
}

//! A camera that pitches: the returns on the road put right what its calibration says of the ground.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

use candle_core::{Device, Tensor};
use noctule_erunet::{Config, Form, Ground, Network, Norms, Plan, PlanOptions, Weights};

const HEIGHT: usize = 64;
const WIDTH: usize = 48;

/// Level ground, its horizon in row 20.
const TRUTH: Ground = Ground {
    per_column: 0.0,
    per_row: 0.006,
    first: -0.12,
};

fn config() -> Config {
    Config {
        form: Form::Choice,
        ..Config::tiny()
    }
}

/// Rings on the road, every second column.
fn road() -> Vec<f32> {
    let mut sparse = vec![0.0; HEIGHT * WIDTH];
    for row in (24..HEIGHT - 10).step_by(4) {
        for column in (0..WIDTH).step_by(2) {
            sparse[row * WIDTH + column] = 1.0 / TRUTH.inverse_depth(0.0, row as f32);
        }
    }
    sparse
}

/// Posts, a return in every row: they stand where they stand, whatever the road does.
fn posts() -> Vec<f32> {
    let mut sparse = vec![0.0; HEIGHT * WIDTH];
    for row in 0..HEIGHT {
        (sparse[row * WIDTH + 5], sparse[row * WIDTH + 30]) = (9.0, 21.0);
    }
    sparse
}

/// First steps of an exposure over `told`, by the plan and by candle.
fn depths(weights: &Weights, told: Option<Ground>, sparse: &[f32]) -> [Vec<f32>; 2] {
    let config = config();
    let area = HEIGHT * WIDTH;
    let blur: Vec<f32> = (0..3 * area).map(|i| (i % 97) as f32 / 97.0).collect();
    let voxel: Vec<f32> = (0..config.bins * area)
        .map(|i| ((i % 31) as f32 - 15.0) / 16.0)
        .collect();
    let mut plan = Plan::new(&config, weights, HEIGHT, WIDTH, PlanOptions::default()).unwrap();
    let (mut depth, mut trust) = (vec![0.0; area], vec![0.0; area]);
    plan.begin(&blur, told.as_ref()).unwrap();
    plan.step(&voxel, sparse, &mut depth, &mut trust).unwrap();

    let network = Network::new(&config, weights, Norms::Fold).unwrap();
    let tensor = |values: &[f32], channels| {
        Tensor::from_slice(values, (1, channels, HEIGHT, WIDTH), &Device::Cpu).unwrap()
    };
    let mut sequence = network.begin(&tensor(&blur, 3), told.as_ref()).unwrap();
    let step = sequence.step(&tensor(&voxel, config.bins), &tensor(sparse, 1));
    let graph = step.unwrap().depth.flatten_all().unwrap();
    [depth, graph.to_vec1().unwrap()]
}

#[test]
fn a_pitch_that_the_road_gives_away_changes_nothing() {
    let weights = Weights::initial(&config(), 4, &Device::Cpu).unwrap();
    let wanted = depths(&weights, Some(TRUTH), &road());
    let without = depths(&weights, None, &road());
    for rows in [-6.0, -2.0, 0.5, 2.5] {
        let told = Some(TRUTH.lowered(rows));
        let found = depths(&weights, told, &road());
        for (found, (wanted, without)) in found.iter().zip(wanted.iter().zip(&without)) {
            let farthest = |others: &[f32]| {
                let apart = found.iter().zip(others).map(|(a, b)| (a - b).abs() / b);
                apart.fold(0.0, f32::max)
            };
            assert!(farthest(wanted) < 1e-4, "{} at {rows}", farthest(wanted));
            assert!(farthest(without) > 1e-2, "the ground counts for something");
        }
    }
}

#[test]
fn without_a_road_the_calibration_holds() {
    let weights = Weights::initial(&config(), 4, &Device::Cpu).unwrap();
    let [plan, graph] = depths(&weights, Some(TRUTH), &posts());
    let [plan_off, graph_off] = depths(&weights, Some(TRUTH.lowered(3.0)), &posts());
    assert_ne!(plan, plan_off);
    assert_ne!(graph, graph_off);
}

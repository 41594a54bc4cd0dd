//! A window of an exposure's steps, as training cuts it out: the whole exposure's values, and
//! gradients from within the window alone.
#![allow(clippy::unwrap_used, reason = "a test may fail by panicking")]

use candle_core::{Device, Tensor, Var};
use noctule_erunet::{Config, Network, NetworkError, Norms, Pass, Weights};

const STEPS: usize = 4;
const SIDE: usize = 32;

/// Values without pattern, from -1 to 1.
fn noise(shape: &[usize], seed: u32) -> Tensor {
    let len: usize = shape.iter().product();
    let mut state = seed;
    let values: Vec<f32> = (0..len)
        .map(|_| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / 8_388_608.0 - 1.0
        })
        .collect();
    Tensor::from_vec(values, shape, &Device::Cpu).unwrap()
}

fn network() -> Network {
    let config = Config::tiny().with_steps(STEPS);
    let weights = Weights::initial(&config, 3, &Device::Cpu).unwrap();
    Network::new(&config, &weights, Norms::Fold).unwrap()
}

fn values(tensor: &Tensor) -> Vec<f32> {
    tensor.flatten_all().unwrap().to_vec1().unwrap()
}

#[test]
fn a_windows_features_are_those_of_the_whole_exposure() {
    let network = network();
    let blur = noise(&[1, 3, SIDE, SIDE], 1).abs().unwrap();
    let voxel = noise(&[1, STEPS, 5, SIDE, SIDE], 2);
    let mut pass = Pass::plain();
    let whole = network.restore(&blur, &voxel, &mut pass).unwrap();
    for first in 0..STEPS {
        for steps in first + 1..=STEPS {
            let voxel = voxel.narrow(1, 0, steps).unwrap();
            let window = network.restore_window(&blur, &voxel, first, &mut pass);
            let window = window.unwrap();
            assert_eq!(window.len(), steps - first);
            for (ours, wanted) in window.iter().zip(&whole[first..]) {
                assert_eq!(values(ours), values(wanted), "steps {first}..{steps}");
            }
        }
    }
}

#[test]
fn no_gradient_reaches_the_steps_before_the_window() {
    let network = network();
    let blur = noise(&[1, 3, SIDE, SIDE], 1).abs().unwrap();
    let voxel = Var::from_tensor(&noise(&[1, STEPS, 5, SIDE, SIDE], 2)).unwrap();
    let first = 2;
    let window = network
        .restore_window(&blur, &voxel, first, &mut Pass::plain())
        .unwrap();
    let sum = window.last().unwrap().sum_all().unwrap();
    let gradient = sum.backward().unwrap().remove(&voxel).unwrap();
    let moved = |t: usize| {
        values(&gradient.narrow(1, t, 1).unwrap())
            .iter()
            .any(|g| *g != 0.0)
    };
    let reached: Vec<bool> = (0..STEPS).map(moved).collect();
    assert_eq!(reached, [false, false, true, true]);
}

#[test]
fn a_window_without_steps_is_refused() {
    let blur = noise(&[1, 3, SIDE, SIDE], 1);
    let voxel = noise(&[1, 2, 5, SIDE, SIDE], 2);
    let refused = network().restore_window(&blur, &voxel, 2, &mut Pass::plain());
    assert!(matches!(
        refused,
        Err(NetworkError::Shape { input: "voxel", .. })
    ));
}

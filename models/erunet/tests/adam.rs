//! The optimiser: its arithmetic, what it leaves alone, and going on from a stored state.
#![allow(clippy::unwrap_used, reason = "a test may fail by panicking")]

use candle_core::{Device, Tensor, Var};
use noctule_erunet::{Adam, AdamError, AdamOptions};

fn var(values: &[f32]) -> Var {
    Var::new(values, &Device::Cpu).unwrap()
}

fn read(tensor: &Tensor) -> Vec<f32> {
    tensor.to_vec1().unwrap()
}

/// `3 x^2 / 2 + y`, whose gradient is `(3 x, 1)`.
fn loss(x: &Var, y: &Var) -> Tensor {
    let square = (x.sqr().unwrap().sum_all().unwrap() * 1.5).unwrap();
    (square + y.sum_all().unwrap()).unwrap()
}

fn adam(named: &[(&str, &Var)]) -> Adam {
    let vars = named
        .iter()
        .map(|(name, var)| ((*name).into(), (*var).clone()));
    Adam::new(vars.collect(), AdamOptions::default()).unwrap()
}

/// The algorithm in double precision, step by step.
#[test]
fn steps_are_those_of_the_published_algorithm() {
    let (x, y) = (var(&[2.0, -0.5]), var(&[1.0]));
    let mut optimiser = adam(&[("x", &x), ("y", &y)]);
    let mut wanted = [2.0f64, -0.5, 1.0];
    let (mut m, mut v) = ([0.0f64; 3], [0.0f64; 3]);
    for step in 1..=20 {
        let mut g = [3.0 * wanted[0], 3.0 * wanted[1], 1.0];
        let norm = g.iter().map(|g| g * g).sum::<f64>().sqrt();
        g = g.map(|g| g * (2.0 / norm).min(1.0));
        for i in 0..3 {
            m[i] = 0.9 * m[i] + 0.1 * g[i];
            v[i] = 0.999 * v[i] + 0.001 * g[i] * g[i];
            let (m, v) = (
                m[i] / (1.0 - 0.9f64.powi(step)),
                v[i] / (1.0 - 0.999f64.powi(step)),
            );
            wanted[i] -= 0.05 * m / (v.sqrt() + 1e-8);
        }
        let grads = loss(&x, &y).backward().unwrap();
        let got = optimiser.step(&grads, 0.05, Some(2.0)).unwrap();
        assert!((got - norm).abs() < 1e-4 * norm, "{got} {norm}");
        for (got, wanted) in read(&x).iter().chain(&read(&y)).zip(wanted) {
            assert!(
                (f64::from(*got) - wanted).abs() < 1e-4,
                "step {step}: {got} {wanted}"
            );
        }
    }
    assert_eq!(optimiser.steps(), 20);
}

#[test]
fn variables_without_gradients_stay_as_they_are() {
    let (x, y, idle) = (var(&[2.0]), var(&[1.0]), var(&[7.0]));
    let mut optimiser = adam(&[("x", &x), ("idle", &idle)]);
    let grads = loss(&x, &y).backward().unwrap();
    optimiser.step(&grads, 0.1, None).unwrap();
    assert_eq!((read(&idle), read(&y)), (vec![7.0], vec![1.0]));
    assert!((read(&x)[0] - 1.9).abs() < 1e-5);
    let moments = optimiser.state().unwrap().moments;
    assert_eq!(read(&moments["v/idle"]), [0.0]);
}

#[test]
fn a_gradient_that_is_not_finite_changes_nothing() {
    let (x, y) = (var(&[f32::INFINITY, 1.0]), var(&[1.0]));
    let mut optimiser = adam(&[("x", &x), ("y", &y)]);
    let grads = loss(&x, &y).backward().unwrap();
    assert!(!optimiser.step(&grads, 0.1, Some(1.0)).unwrap().is_finite());
    assert_eq!((read(&x)[1], read(&y)[0], optimiser.steps()), (1.0, 1.0, 0));
}

#[test]
fn a_restored_optimiser_goes_on_bit_for_bit() {
    let (x, y) = (var(&[2.0, -1.0]), var(&[1.0]));
    let mut first = adam(&[("x", &x), ("y", &y)]);
    let step = |optimiser: &mut Adam| {
        let grads = loss(&x, &y).backward().unwrap();
        optimiser.step(&grads, 0.1, None).unwrap();
    };
    (0..3).for_each(|_| step(&mut first));
    let (state, kept) = (first.state().unwrap(), x.copy().unwrap());
    (0..3).for_each(|_| step(&mut first));
    let wanted = read(&x);
    x.set(&kept).unwrap();
    let mut second = adam(&[("x", &x), ("y", &y)]);
    second.restore(&state).unwrap();
    (0..3).for_each(|_| step(&mut second));
    assert_eq!((read(&x), second.steps()), (wanted, 6));
}

#[test]
fn a_state_that_does_not_fit_is_refused_by_name() {
    let (x, y) = (var(&[2.0, -1.0]), var(&[1.0]));
    let mut optimiser = adam(&[("x", &x)]);
    let error = |optimiser: &mut Adam, other: &Adam| {
        optimiser.restore(&other.state().unwrap()).unwrap_err()
    };
    let missing = error(&mut optimiser, &adam(&[("y", &y)]));
    assert!(matches!(missing, AdamError::Missing { name } if name == "m/x"));
    let shape = error(&mut optimiser, &adam(&[("x", &y)]));
    assert!(matches!(shape, AdamError::Shape { actual, .. } if actual == [1]));
    let unknown = error(&mut optimiser, &adam(&[("x", &x), ("y", &y)]));
    assert!(matches!(unknown, AdamError::Unknown { name } if name == "m/y"));
}

//! Gradients: that they reach everything that trains, and that they are the reference's.
#![allow(clippy::unwrap_used, reason = "a test may fail by panicking")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use candle_core::backprop::GradStore;
use candle_core::{Device, Tensor, Var};
use noctule_erunet::{Config, Network, Norms, Pass, Role, Weights, fixture_config, slots};

/// Which names of the weights train in each stage of the paper's schedule.
fn trains(stage: usize, name: &str) -> bool {
    match stage {
        1 => name.starts_with("efr."),
        2 => name.starts_with("rdu."),
        _ => !name.starts_with("efr.recon."),
    }
}

struct Scene {
    config: Config,
    weights: Weights,
    inputs: BTreeMap<String, Tensor>,
    reference: BTreeMap<String, Tensor>,
}

fn scene(name: &str) -> Scene {
    let dir: PathBuf = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("tests/fixtures")
        .join(name);
    let read = |file: &str| Weights::read(&dir.join(file), &Device::Cpu).unwrap();
    Scene {
        config: fixture_config(&dir).unwrap(),
        weights: read("weights.safetensors"),
        inputs: read("inputs.safetensors").tensors().clone(),
        reference: read("grads.safetensors").tensors().clone(),
    }
}

/// Makes variables of what trains in `stage`, and a network over them.
fn trainable(scene: &Scene, stage: usize) -> (BTreeMap<String, Var>, Network) {
    let mut tensors = scene.weights.tensors().clone();
    let mut vars = BTreeMap::new();
    for slot in slots(&scene.config).unwrap() {
        if slot.role == Role::Trained && trains(stage, &slot.name) {
            let var = Var::from_tensor(&tensors[&slot.name]).unwrap();
            tensors.insert(slot.name.clone(), var.as_tensor().clone());
            vars.insert(slot.name, var);
        }
    }
    let weights = Weights::from_tensors(&scene.config, tensors, &Device::Cpu).unwrap();
    (
        vars,
        Network::new(&scene.config, &weights, Norms::Keep).unwrap(),
    )
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

/// One backward pass of `stage`; stage 1 takes a squared error of the restored pictures.
fn backward(scene: &Scene, network: &Network, stage: usize) -> GradStore {
    let input = |name: &str| &scene.inputs[name];
    let mut pass = Pass::plain();
    let clear = network
        .restore(input("blur"), input("vox"), &mut pass)
        .unwrap();
    let loss = if stage == 1 {
        let pictures = network.reconstruct(&clear, input("blur")).unwrap().unwrap();
        (pictures - input("gt_rgb"))
            .unwrap()
            .sqr()
            .unwrap()
            .mean_all()
            .unwrap()
    } else {
        let sparse = input("sparse");
        let outputs = network
            .complete(&clear, input("vox"), sparse, &mut pass)
            .unwrap();
        depth_loss(&outputs.depth, input("gt_depth"), sparse).unwrap()
    };
    loss.backward().unwrap()
}

fn values(tensor: &Tensor) -> Vec<f32> {
    tensor.flatten_all().unwrap().to_vec1().unwrap()
}

/// The counts are those of the reference's own check.
#[test]
fn every_trained_tensor_gets_a_finite_gradient_that_is_not_zero() {
    let scene = scene("tiny");
    for (stage, count) in [(1, 80), (2, 223), (3, 299)] {
        let (vars, network) = trainable(&scene, stage);
        assert_eq!(vars.len(), count);
        let gradients = backward(&scene, &network, stage);
        for (name, var) in &vars {
            let gradient = gradients
                .get(var)
                .unwrap_or_else(|| panic!("{stage}: no {name}"));
            let gradient = values(gradient);
            assert!(
                gradient.iter().all(|g| g.is_finite()),
                "stage {stage}: {name}"
            );
            assert!(
                gradient.iter().any(|g| *g != 0.0),
                "stage {stage}: {name} is zero"
            );
        }
    }
}

/// Depth loss of stage 2 in double precision, with the batch's own statistics; and its gradients.
fn batch_loss(scene: &Scene, network: &Network) -> (f64, GradStore) {
    let input = |name: &str| &scene.inputs[name];
    let mut pass = Pass::training();
    let (voxel, sparse) = (input("vox"), input("sparse"));
    let clear = network.restore(input("blur"), voxel, &mut pass).unwrap();
    let outputs = network.complete(&clear, voxel, sparse, &mut pass).unwrap();
    let loss = depth_loss(&outputs.depth, input("gt_depth"), sparse).unwrap();
    let value = f64::from(loss.to_scalar::<f32>().unwrap());
    (value, loss.backward().unwrap())
}

/// Statistics of the batch are part of what is differentiated: a small step along the gradient of
/// each part of the network changes the loss by the gradient's square.
#[test]
fn gradients_through_batch_statistics_are_those_of_finite_differences() {
    let scene = scene("batch");
    let (vars, network) = trainable(&scene, 2);
    let (_, gradients) = batch_loss(&scene, &network);
    for part in [
        "rdu.guide",
        "rdu.event",
        "rdu.depth",
        "rdu.bott",
        "rdu.dec2",
        "rdu.dec0",
    ] {
        let ours: Vec<(&Var, Tensor, Tensor)> = vars
            .iter()
            .filter(|(name, _)| name.starts_with(part))
            .map(|(name, var)| {
                let gradient = gradients.get(var).unwrap_or_else(|| panic!("no {name}"));
                assert!(values(gradient).iter().all(|g| g.is_finite()), "{name}");
                (var, var.copy().unwrap(), gradient.clone())
            })
            .collect();
        let square: f64 = ours
            .iter()
            .flat_map(|(_, _, gradient)| values(gradient))
            .map(|g| f64::from(g).powi(2))
            .sum();
        let losses = [-1.0, 1.0].map(|side| {
            // A change of two thousandths of the loss, well above rounding.
            let step = side * 0.02 / square;
            for (var, start, gradient) in &ours {
                var.set(&(start + (gradient * step).unwrap()).unwrap())
                    .unwrap();
            }
            batch_loss(&scene, &network).0
        });
        for (var, start, _) in &ours {
            var.set(start).unwrap();
        }
        let change = (losses[1] - losses[0]) / 0.04;
        println!("{part}: {change}");
        assert!(
            (change - 1.0).abs() < 0.05,
            "{part}: {change} of the gradient's square"
        );
    }
}

/// Within a thousandth of the largest value of each gradient, the reference's own tolerance.
#[test]
fn gradients_of_the_depth_losses_are_the_references() {
    for (name, stage) in [("tiny", 2), ("tiny", 3), ("batch", 3)] {
        let scene = scene(name);
        let (vars, network) = trainable(&scene, stage);
        let gradients = backward(&scene, &network, stage);
        let prefix = format!("stage{stage}/");
        let mut compared = 0;
        for (key, wanted) in &scene.reference {
            let Some(key) = key.strip_prefix(&prefix) else {
                continue;
            };
            let (ours, wanted) = (values(gradients.get(&vars[key]).unwrap()), values(wanted));
            let scale = wanted.iter().fold(0f32, |scale, w| scale.max(w.abs()));
            for (g, w) in ours.iter().zip(&wanted) {
                assert!(
                    (g - w).abs() <= 1e-3 * scale,
                    "{name} {prefix}{key}: {g} {w} of {scale}"
                );
            }
            compared += 1;
        }
        assert_eq!(compared, if stage == 2 { 4 } else { 7 });
    }
}

/// The differentiable route and the inference route compute the same network.
#[test]
fn a_tracked_pass_has_the_values_of_an_untracked_one() {
    let scene = scene("tiny");
    let (_, tracked) = trainable(&scene, 3);
    let plain = Network::new(&scene.config, &scene.weights, Norms::Fold).unwrap();
    let [a, b] = [tracked, plain].map(|network| {
        let input = |name: &str| &scene.inputs[name];
        let outputs = network
            .forward(input("blur"), input("vox"), input("sparse"))
            .unwrap();
        values(&outputs.depth)
    });
    for (a, b) in a.iter().zip(&b) {
        assert!((a - b).abs() < 1e-4, "{a} {b}");
    }
}

/// A change of a variable shows in the next pass of a network built before it.
#[test]
fn a_network_follows_its_variables() {
    let scene = scene("tiny");
    let (vars, network) = trainable(&scene, 2);
    let input = |name: &str| &scene.inputs[name];
    let depth = || {
        let outputs = network
            .forward(input("blur"), input("vox"), input("sparse"))
            .unwrap();
        values(&outputs.depth)
    };
    let before = depth();
    let bias = &vars["rdu.head2.bias"];
    bias.set(&bias.affine(1.0, 0.5).unwrap()).unwrap();
    assert!(
        depth()
            .iter()
            .zip(&before)
            .all(|(after, before)| after > before)
    );
}

/// Picture level a normalisation of the depth network works at, from its name.
fn level(name: &str) -> u32 {
    match name {
        name if name.contains("bott") => 4,
        name if name.contains("stem") => 0,
        name => name.chars().find_map(|c| c.to_digit(10)).unwrap(),
    }
}

/// Normalising with a batch's statistics equals storing those statistics and using them.
#[test]
fn batch_statistics_stored_as_running_ones_give_the_same_depth() {
    let scene = scene("tiny");
    let input = |name: &str| &scene.inputs[name];
    let run = |weights: &Weights, pass: &mut Pass| {
        let network = Network::new(&scene.config, weights, Norms::Keep).unwrap();
        let clear = network.restore(input("blur"), input("vox"), pass).unwrap();
        let outputs = network
            .complete(&clear, input("vox"), input("sparse"), pass)
            .unwrap();
        values(&outputs.depth)
    };
    let mut pass = Pass::training();
    let batch = run(&scene.weights, &mut pass);
    assert_ne!(batch, run(&scene.weights, &mut Pass::plain()));

    let norms = scene
        .weights
        .tensors()
        .keys()
        .filter(|name| name.ends_with("running_var"));
    assert_eq!(pass.moments().count(), norms.count());
    // Largest change of depth when `share` of Bessel's correction is taken back before storing.
    let change = |share: f64| {
        let mut tensors = scene.weights.tensors().clone();
        for (name, moments) in pass.moments() {
            let pixels = f64::from(3 * 32 * 32 / 4u32.pow(level(name)));
            let variance = (&moments.variance * (1.0 - share / pixels)).unwrap();
            tensors
                .insert(format!("{name}.running_mean"), moments.mean.clone())
                .unwrap();
            tensors
                .insert(format!("{name}.running_var"), variance)
                .unwrap();
        }
        let stored = Weights::from_tensors(&scene.config, tensors, &Device::Cpu).unwrap();
        let depth = run(&stored, &mut Pass::plain());
        batch
            .iter()
            .zip(depth)
            .map(|(a, b)| (a - b).abs())
            .fold(0f32, f32::max)
    };
    let (right, wrong) = (change(1.0), change(0.0));
    println!("{right} {wrong}");
    assert!(
        right < 1e-2 && wrong > 10.0 * right,
        "{right} m, uncorrected {wrong} m"
    );
}

#[test]
fn a_folded_network_refuses_batch_statistics() {
    let scene = scene("tiny");
    let network = Network::new(&scene.config, &scene.weights, Norms::Fold).unwrap();
    let input = |name: &str| &scene.inputs[name];
    let mut pass = Pass::training();
    let clear = network
        .restore(input("blur"), input("vox"), &mut pass)
        .unwrap();
    let error = network
        .complete(&clear, input("vox"), input("sparse"), &mut pass)
        .unwrap_err();
    assert!(error.to_string().contains("folded norms"), "{error}");
}

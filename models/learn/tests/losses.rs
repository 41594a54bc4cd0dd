//! Losses and their gradients are those of the PyTorch reference, on its fixtures.
#![allow(clippy::unwrap_used, reason = "a test may fail by panicking")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use candle_core::{Device, Tensor, Var};
use noctule_erunet::{Config, Network, Norms, Pass, Role, Weights, fixture_config, slots};
use noctule_learn::{Domain, Inputs, Kind, Loss, Pictures, batch_loss, depth_loss, picture_loss};

struct Fixture {
    config: Config,
    weights: Weights,
    inputs: BTreeMap<String, Tensor>,
    outputs: BTreeMap<String, Tensor>,
    gradients: BTreeMap<String, Tensor>,
    losses: serde_json::Value,
}

/// `tiny` or `batch`, kept beside the network's own tests.
fn fixture(name: &str) -> Fixture {
    let folder: PathBuf = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../erunet/tests/fixtures")
        .join(name);
    let read = |file: &str| Weights::read(&folder.join(file), &Device::Cpu).unwrap();
    let meta = std::fs::read_to_string(folder.join("meta.json")).unwrap();
    let meta: serde_json::Value = serde_json::from_str(&meta).unwrap();
    Fixture {
        config: fixture_config(&folder).unwrap(),
        weights: read("weights.safetensors"),
        inputs: read("inputs.safetensors").tensors().clone(),
        outputs: read("outputs.safetensors").tensors().clone(),
        gradients: read("grads.safetensors").tensors().clone(),
        losses: meta["losses"].clone(),
    }
}

/// The reference averages encoded values.
fn weights() -> Loss {
    Loss {
        reblur_domain: Domain::Encoded,
        ..Loss::default()
    }
}

fn inputs(fixture: &Fixture) -> Inputs {
    let input = |name: &str| fixture.inputs[name].clone();
    Inputs {
        blur: input("blur"),
        voxel: input("vox"),
        sparse: input("sparse"),
        depth: input("gt_depth"),
        edges: None,
        movers: None,
        pictures: Some(Pictures {
            sharp: input("gt_rgb"),
            event_grey: input("ev_gray"),
        }),
        first_step: 0,
        grounds: Vec::new(),
    }
}

#[test]
fn every_term_has_the_references_value() {
    for name in ["tiny", "batch"] {
        let fixture = fixture(name);
        let inputs = inputs(&fixture);
        let pictures = inputs.pictures.as_ref().unwrap();
        let restored = &fixture.outputs["I_recon"];
        let picture = picture_loss(
            restored,
            &pictures.sharp,
            &inputs.blur,
            &pictures.event_grey,
            &weights(),
        )
        .unwrap();
        let dense = &fixture.outputs["D_dense"];
        let depth = depth_loss(
            dense,
            &inputs.depth,
            &inputs.sparse,
            [None, None],
            &weights(),
        )
        .unwrap();
        for (key, ours) in [
            ("stage1", &picture.total),
            ("char", &picture.charbonnier),
            ("ssim", &picture.ssim),
            ("edge", &picture.edge),
            ("reblur", &picture.reblur),
            ("grad", &picture.gradient),
            ("stage2_and_3", &depth.total),
            ("dense", &depth.dense),
            ("sparse", &depth.sparse),
            ("sparse_grad", &depth.sparse_gradient),
        ] {
            let wanted = fixture.losses[key].as_f64().unwrap();
            let ours = f64::from(ours.to_scalar::<f32>().unwrap());
            assert!(
                (ours - wanted).abs() <= 1e-4 * wanted.abs(),
                "{name} {key}: {ours}, reference {wanted}"
            );
        }
    }
}

/// Within a thousandth of the largest value of each gradient, the reference's own tolerance.
#[test]
fn gradients_are_the_references_in_every_stage() {
    let kinds = [
        ("stage1/", Kind::Restore),
        ("stage2/", Kind::Complete),
        ("stage3/", Kind::Together),
    ];
    for name in ["tiny", "batch"] {
        let fixture = fixture(name);
        for (prefix, kind) in kinds {
            let (vars, network) = trainable(&fixture, kind);
            let loss = batch_loss(
                &network,
                kind,
                &inputs(&fixture),
                &weights(),
                &mut Pass::plain(),
            );
            let gradients = loss.unwrap().total.backward().unwrap();
            let mut compared = 0;
            for (key, wanted) in &fixture.gradients {
                let Some(key) = key.strip_prefix(prefix) else {
                    continue;
                };
                let ours = values(gradients.get(&vars[key]).unwrap());
                let wanted = values(wanted);
                let scale = wanted.iter().fold(0f32, |scale, w| scale.max(w.abs()));
                for (g, w) in ours.iter().zip(&wanted) {
                    assert!(
                        (g - w).abs() <= 1e-3 * scale,
                        "{name} {prefix}{key}: {g} {w}"
                    );
                }
                compared += 1;
            }
            assert!(compared >= 3, "{name} {prefix}: {compared} compared");
        }
    }
}

fn trainable(fixture: &Fixture, kind: Kind) -> (BTreeMap<String, Var>, Network) {
    let mut tensors = fixture.weights.tensors().clone();
    let mut vars = BTreeMap::new();
    for slot in slots(&fixture.config).unwrap() {
        if slot.role == Role::Trained && kind.trains(&slot.name) {
            let var = Var::from_tensor(&tensors[&slot.name]).unwrap();
            tensors.insert(slot.name.clone(), var.as_tensor().clone());
            vars.insert(slot.name, var);
        }
    }
    let weights = Weights::from_tensors(&fixture.config, tensors, &Device::Cpu).unwrap();
    let network = Network::new(&fixture.config, &weights, Norms::Keep).unwrap();
    (vars, network)
}

fn values(tensor: &Tensor) -> Vec<f32> {
    tensor.flatten_all().unwrap().to_vec1().unwrap()
}

/// A window of fewer steps is compared with its own light, not with the whole exposure's.
#[test]
fn blurring_again_in_light_differs_from_averaging_codes() {
    let fixture = fixture("tiny");
    let inputs = inputs(&fixture);
    let pictures = inputs.pictures.as_ref().unwrap();
    let reblur = |reblur_domain| {
        let weights = Loss {
            reblur_domain,
            ..Loss::default()
        };
        let (sharp, grey) = (&pictures.sharp, &pictures.event_grey);
        let loss = picture_loss(sharp, sharp, &inputs.blur, grey, &weights).unwrap();
        loss.reblur.to_scalar::<f32>().unwrap()
    };
    assert!(
        reblur(Domain::Encoded) < 1e-6,
        "codes average to the fixture's blur"
    );
    assert!(
        reblur(Domain::Linear) > 1e-3,
        "light averages to something brighter"
    );
}

/// Two exposures of two steps: of what moves there are three pixels, one, none, and one without truth.
#[test]
fn every_map_has_its_own_mean_over_what_moves() {
    let maps = |values: [f32; 16]| {
        let shape = (2, 2, 1, 2, 2);
        Tensor::from_slice(&values, shape, &Device::Cpu).unwrap()
    };
    let truth = maps([
        9., 9., 9., 9., 9., 9., 9., 9., // first exposure
        9., 9., 9., 9., 0., 9., 9., 9.,
    ]);
    let depth = maps([
        10., 11., 12., 9., 9., 9., 15., 9., // 1 m, 2 m, 3 m; 6 m
        9., 9., 9., 9., 1., 9., 9., 9.,
    ]);
    let movers = maps([
        1., 1., 1., 0., 0., 0., 1., 0., //
        0., 0., 0., 0., 1., 0., 0., 0.,
    ]);
    let nothing = maps([0.0; 16]);
    let total = |mover_mean: f64| -> f64 {
        let weights = Loss {
            mover_mean,
            ..Loss::default()
        };
        let loss = depth_loss(&depth, &truth, &nothing, [None, Some(&movers)], &weights).unwrap();
        f64::from(loss.total.to_scalar::<f32>().unwrap())
    };
    // Steps add up: means of 2 m and of nothing, and of 6 m and of nothing.
    let own = (2.0 + 0.0) / 2.0 + (6.0 + 0.0) / 2.0;
    assert!((total(3.0) - total(0.0) - 3.0 * own).abs() < 1e-5);
}

/// Two pixels of four are known; errors of 1 m and 3 m, the latter on an edge and a mover.
#[test]
fn extra_weights_add_what_they_say() {
    let map =
        |values: [f32; 4]| Tensor::from_slice(&values, (1, 1, 1, 2, 2), &Device::Cpu).unwrap();
    let (depth, truth) = (map([3.0, 5.0, 1.0, 1.0]), map([2.0, 8.0, 0.0, 0.0]));
    let nothing = map([0.0; 4]);
    let mask = map([0.0, 1.0, 1.0, 0.0]);
    let total = |weights: &Loss| -> f64 {
        let masks = [Some(&mask), Some(&mask)];
        let loss = depth_loss(&depth, &truth, &nothing, masks, weights).unwrap();
        f64::from(loss.total.to_scalar::<f32>().unwrap())
    };
    let plain = Loss::default();
    assert!((total(&plain) - 2.0).abs() < 1e-6, "the mean of 1 and 3");
    let edges = Loss {
        depth_edges: 0.5,
        ..plain
    };
    assert!((total(&edges) - (2.0 + 0.5 * 3.0)).abs() < 1e-6);
    let movers = Loss {
        depth_movers: 4.0,
        ..plain
    };
    assert!((total(&movers) - (2.0 + 4.0 * 3.0 / 2.0)).abs() < 1e-6);
    let logarithms = Loss {
        log_depth: 10.0,
        ..plain
    };
    let mean = (1.5f64.ln() + 1.6f64.ln()) / 2.0;
    assert!((total(&logarithms) - (2.0 + 10.0 * mean)).abs() < 1e-5);
}

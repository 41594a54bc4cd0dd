//! The network against the PyTorch reference, on the fixtures the reference exported.
#![allow(clippy::unwrap_used, reason = "a test may fail by panicking")]

use std::path::{Path, PathBuf};

use candle_core::Device;
use noctule_erunet::{Norms, ParityError, Weights, parity, parity_on};

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("tests/fixtures")
        .join(name)
}

/// One exposure of three steps, 32 x 32 pixels.
#[test]
fn tiny_network_agrees_with_the_reference_feature_by_feature() {
    let report = parity(&fixture("tiny")).unwrap();
    println!("{report}");
    // F_static, 5 per step, 4 per level, I_recon, D_dense.
    assert_eq!(report.tensors.len(), 1 + 5 * 3 + 4 * 4 + 2);
    assert!(report.is_within(), "\n{report}");
}

/// Two exposures whose pictures are not square; blocks and widths differ from level to level.
#[test]
fn uneven_network_agrees_with_the_reference_over_a_batch() {
    let report = parity(&fixture("batch")).unwrap();
    println!("{report}");
    assert_eq!(
        report.tensors.len(),
        1 + 5 * report.config.steps + 4 * 4 + 2
    );
    assert!(report.is_within(), "\n{report}");
}

#[test]
fn norms_left_unfolded_agree_as_well() {
    for name in ["tiny", "batch"] {
        let report = parity_on(&fixture(name), &Device::Cpu, Norms::Keep).unwrap();
        assert!(report.is_within(), "{name}\n{report}");
    }
}

/// The comparison can fail: one weight off by a thousandth shows, and shows downstream only.
#[test]
fn a_disturbed_weight_is_found_out() {
    let dir = tempfile::tempdir().unwrap();
    for file in ["meta.json", "inputs.safetensors", "outputs.safetensors"] {
        std::fs::copy(fixture("tiny").join(file), dir.path().join(file)).unwrap();
    }
    let read = Weights::read(&fixture("tiny/weights.safetensors"), &Device::Cpu).unwrap();
    let mut tensors = read.tensors().clone();
    let name = "rdu.dec1.conf.bias";
    let moved = tensors[name].affine(1.0, 1e-3).unwrap();
    tensors.insert(name.into(), moved);
    let config = noctule_erunet::fixture_config(dir.path()).unwrap();
    let weights = Weights::from_tensors(&config, tensors, &Device::Cpu).unwrap();
    weights
        .write(&dir.path().join("weights.safetensors"))
        .unwrap();
    let report = parity(dir.path()).unwrap();
    let outside: Vec<&str> = report
        .tensors
        .iter()
        .filter(|t| !t.is_within())
        .map(|t| t.name.as_str())
        .collect();
    assert!(
        outside.contains(&"C.1") && outside.contains(&"F_gate.1"),
        "{outside:?}"
    );
    let downstream = ["C.1", "F_ref.1", "F_gate.1", "D_dense"];
    assert!(
        outside
            .iter()
            .all(|name| downstream.contains(name) || name.ends_with(".0")),
        "{outside:?}"
    );
    assert!(report.to_string().contains("OUTSIDE"));
}

#[test]
fn an_incomplete_fixture_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let error = parity(dir.path()).unwrap_err();
    assert!(error.to_string().contains("meta.json"), "{error}");
    std::fs::write(dir.path().join("meta.json"), "{\"config\": {\"cd\": 0}}").unwrap();
    assert!(matches!(parity(dir.path()), Err(ParityError::Meta { .. })));
    for file in ["meta.json", "outputs.safetensors", "weights.safetensors"] {
        std::fs::copy(fixture("tiny").join(file), dir.path().join(file)).unwrap();
    }
    let outputs = fixture("tiny/outputs.safetensors");
    std::fs::copy(outputs, dir.path().join("inputs.safetensors")).unwrap();
    let error = parity(dir.path()).unwrap_err();
    assert_eq!(error.to_string(), "inputs.safetensors has no tensor blur");
}

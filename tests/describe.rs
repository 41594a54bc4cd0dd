//! `noctule weights`: what other programs are told about the networks.

#![cfg(feature = "model")]
#![allow(clippy::unwrap_used, reason = "tests")]

use std::path::Path;
use std::process::{Command, Output};

use candle_core::{Device, Tensor};
use noctule::frame::ModelId;
use noctule::infer::shipped_weights;
use noctule_erunet::Weights;
use sha2::{Digest, Sha256};

fn weights(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_noctule"))
        .arg("weights")
        .args(arguments)
        .output()
        .unwrap()
}

/// The fields by which the widths are handed to other implementations, and nothing else.
const FIELDS: [&str; 22] = [
    "name", "c", "n_sp", "n1", "n2", "k", "n_t", "cd", "g", "e", "d", "n_g", "n_e", "n_d", "n_b",
    "n_u", "M", "bins", "freqs", "T", "d_max", "variant",
];

#[test]
fn every_member_is_described_in_the_shared_form() {
    let output = weights(&["--describe", "--json"]);
    assert!(output.status.success(), "{output:?}");
    let family: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let mut names = Vec::new();
    for member in family.as_array().unwrap() {
        let config = member["config"].as_object().unwrap();
        let mut fields: Vec<&str> = config.keys().map(String::as_str).collect();
        let mut wanted = FIELDS.to_vec();
        fields.sort_unstable();
        wanted.sort_unstable();
        assert_eq!(fields, wanted);
        let form = member["form"].as_str().unwrap();
        names.push((config["name"].as_str().unwrap(), form));
        assert!(member["params"].as_u64().unwrap() > 0);
    }
    assert_eq!(
        names,
        [
            ("full", "direct"),
            ("s", "choice"),
            ("xs", "choice"),
            ("tiny", "direct")
        ]
    );
}

#[test]
fn one_thing_at_a_time_is_asked_for() {
    for arguments in [
        &["--json"][..],
        &["--describe", "--parity", "somewhere"],
        &["--mix", "xs", "xs"],
        &["--describe", "--out", "somewhere"],
    ] {
        let output = weights(arguments);
        assert_eq!(output.status.code(), Some(2), "{output:?}");
    }
}

/// A network mixed with itself is itself, but for rounding; two networks are not mixed, and both
/// are named.
#[test]
fn weights_are_mixed_into_a_file() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("mean.safetensors");
    let out = out.to_str().unwrap();
    let output = weights(&["--mix", "xs", "xs", "--share", "0.25", "--out", out]);
    assert!(output.status.success(), "{output:?}");
    let mean = Weights::read(Path::new(out), &Device::Cpu).unwrap();
    let shipped = Weights::from_bytes(shipped_weights(ModelId::Xs).unwrap(), &Device::Cpu).unwrap();
    assert_eq!(mean.config(), shipped.config());
    for (name, tensor) in shipped.tensors() {
        let flat = |tensor: &Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        for (mean, own) in flat(&mean.tensors()[name]).iter().zip(flat(tensor)) {
            assert!((mean - own).abs() <= 1e-6 * own.abs(), "{name}");
        }
    }
    let other = folder.path().join("other.safetensors");
    let output = weights(&["--mix", "xs", "s", "--out", other.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("xs and s: cannot mix"), "{said}");
    assert!(!other.exists());
}

#[test]
fn each_card_names_the_weights_that_ship() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("models/weights");
    for (name, model) in [("xs", ModelId::Xs), ("s", ModelId::S)] {
        let digest = Sha256::digest(shipped_weights(model).unwrap());
        let hex: String = digest.iter().map(|byte| format!("{byte:02x}")).collect();
        let card = std::fs::read_to_string(folder.join(format!("{name}.md"))).unwrap();
        assert!(
            card.contains(&format!("SHA-256 `{hex}`")),
            "{name}.md does not name {hex}: its figures are those of other weights"
        );
    }
}

//! `noctule weights`: what other programs are told about the networks.

#![cfg(feature = "model")]
#![allow(clippy::unwrap_used, reason = "tests")]

use std::process::{Command, Output};

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
    for arguments in [&["--json"][..], &["--describe", "--parity", "somewhere"]] {
        let output = weights(arguments);
        assert_eq!(output.status.code(), Some(2), "{output:?}");
    }
}

//! `noctule eval` as a user runs it: from any folder, with the program's own weights.

#![cfg(feature = "model")]
#![allow(clippy::unwrap_used, reason = "tests")]

use std::process::{Command, Output};

fn eval(arguments: &[&str]) -> Output {
    let elsewhere = tempfile::tempdir().unwrap();
    Command::new(env!("CARGO_BIN_EXE_noctule"))
        .arg("eval")
        .args(arguments)
        .current_dir(elsewhere.path())
        .env_remove("RUST_BACKTRACE")
        .output()
        .unwrap()
}

#[test]
fn the_programs_own_network_stands_beside_what_needs_no_learning() {
    let data = ["--data", "world:B:200000..200001", "--table", "json"];
    let output = eval(&[&["--weights", "xs"][..], &data].concat());
    assert!(output.status.success(), "{output:?}");
    let table: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let rows = table["rows"].as_array().unwrap();
    let methods: Vec<&str> = rows.iter().map(|r| r["method"].as_str().unwrap()).collect();
    let baselines = [
        "nearest",
        "fill",
        "median constant",
        "truth of step 1 reused",
    ];
    assert_eq!(methods, [&["xs"][..], &baselines].concat());
    let value = |row: usize, key: &str| rows[row][key].as_f64().unwrap();
    for key in ["rmse_mm", "mae_mm", "irmse_per_km", "edge_mae_mm"] {
        assert!(value(0, key) > 0.0, "{key}");
        assert!(value(0, key) < value(1, key), "{key}: worse than nearest");
    }
}

#[test]
fn a_network_that_is_not_there_is_named() {
    let output = eval(&["--weights", "full", "--data", "world:B:200000..200001"]);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("full") && said.contains("\"xs\""), "{said}");
}

/// A sheet of one exposure holds seven tiles side by side, and one more for each further row of
/// methods.
#[test]
fn what_was_scored_is_drawn() {
    let folder = tempfile::tempdir().unwrap();
    let draw = |inputs: &str| {
        let path = folder.path().join("sheet.png");
        let data = ["--weights", "xs", "--data", "world:A:200000..200001"];
        let drawn = ["--pictures", path.to_str().unwrap(), "--inputs", inputs];
        let output = eval(&[&data[..], &drawn].concat());
        assert!(output.status.success(), "{output:?}");
        let decoder =
            png::Decoder::new(std::io::BufReader::new(std::fs::File::open(path).unwrap()));
        decoder.read_info().unwrap().info().width
    };
    let (one, two) = (draw("full"), draw("full,no-events"));
    assert!(one > 7 * 256 && two > one + 256, "{one} {two}");
}

//! What users type: the demo from nothing to pictures, and what comes of mistakes.
#![allow(clippy::unwrap_used, reason = "a test may stop where it stands")]

use std::fs;
use std::path::Path;
use std::process::Command;

use noctule_hil_tests::{Ended, Stage, Started, program};

fn run(arguments: &[&str]) -> Ended {
    Started::new(Command::new(program()).args(arguments)).wait()
}

fn files(folder: &Path, extension: &str) -> usize {
    let entries = fs::read_dir(folder).unwrap().map(Result::unwrap);
    entries
        .filter(|e| e.path().extension().is_some_and(|x| x == extension))
        .count()
}

#[test]
fn the_demo_goes_from_nothing_to_pictures_and_a_report() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let demo = || {
        run(&[
            "demo",
            "--seconds",
            "1",
            "--out",
            out.to_str().unwrap(),
            "--report",
            "json",
        ])
    };
    let first = demo();
    assert_eq!(first.code, Some(0), "{}", first.stderr);
    let report = first.report();
    let sent = report["host"]["bundles"]["sent"].as_u64().unwrap();
    assert!(sent >= 3, "{sent} bundles");
    assert!(report["infer"]["frames_sent"].as_u64().unwrap() >= 8);
    // The night's road is level and its camera where the calibration says.
    let seen = report["infer"]["roads_seen"].as_i64().unwrap();
    let half_rows = report["infer"]["road_half_rows_down"].as_i64().unwrap();
    assert!(
        seen >= 1 && half_rows.abs() <= seen,
        "{half_rows} in {seen}"
    );
    assert!(report["scores"]["exposures"].as_u64().unwrap() >= 1);
    assert_eq!(report["residue"].as_u64(), Some(0));
    let stages: Vec<&str> = report["stages"]
        .as_array()
        .unwrap()
        .iter()
        .map(|s| s["stage"].as_str().unwrap())
        .collect();
    assert!(stages.contains(&"close -> bundle sent") && stages.contains(&"close -> last depth"));

    let sheets = out.join("sheets");
    assert!(files(&sheets, "png") >= 1);
    for sheet in fs::read_dir(&sheets).unwrap() {
        let bytes = fs::read(sheet.unwrap().path()).unwrap();
        assert!(bytes.starts_with(b"\x89PNG\r\n\x1a\n") && bytes.len() > 10_000);
    }
    let maps = fs::read_dir(out.join("depth"))
        .unwrap()
        .next()
        .unwrap()
        .unwrap()
        .path();
    assert!((1..=8).contains(&files(&maps, "png")));
    let saved = fs::read_to_string(out.join("report.json")).unwrap();
    let saved: serde_json::Value = serde_json::from_str(&saved).unwrap();
    assert_eq!(saved["digest"], report["digest"]);
    assert!(
        fs::read_to_string(out.join("report.txt"))
            .unwrap()
            .contains("deadline misses")
    );

    // The second time the drive is there already.
    let second = demo();
    assert_eq!(second.code, Some(0), "{}", second.stderr);
    assert!(second.stderr.contains("using "), "{}", second.stderr);
}

#[test]
fn exit_codes_say_who_is_at_fault() {
    let drive = Stage::shared().drive();
    let drive = drive.to_str().unwrap();
    for arguments in [
        &[][..],
        &["fly"],
        &["replay"],
        &["replay", drive, "--pace", "fast"],
        &["replay", drive, "--pace", "0"],
        &["replay", drive, "--model", "huge"],
        &["replay", drive, "--unknown"],
        &["world", "--tier", "Z", "--out", "/no/such/folder"],
    ] {
        let ended = run(arguments);
        assert_eq!(ended.code, Some(2), "{arguments:?}: {}", ended.stderr);
        assert!(
            ended.stdout.is_empty() && !ended.stderr.is_empty(),
            "{arguments:?}"
        );
    }
    for arguments in [
        &["replay", "/no/such/drive"][..],
        &["replay", "/no/such/drive.raw"],
        &["replay", drive, "--config", "/no/such/noctule.toml"],
        &["host", "--replay", "/no/such/drive.pcap"],
        &["check", "/no/such/noctule.toml"],
    ] {
        let ended = run(arguments);
        assert_eq!(ended.code, Some(1), "{arguments:?}: {}", ended.stderr);
        assert!(
            ended.stderr.contains("/no/such/"),
            "{arguments:?}: {}",
            ended.stderr
        );
        assert!(ended.stdout.is_empty(), "{arguments:?}: {}", ended.stdout);
    }
    let ended = run(&["replay", drive, "--instance", "a/b"]);
    assert_eq!(ended.code, Some(1));
    assert!(ended.stderr.contains("a/b"), "{}", ended.stderr);
    assert_eq!(run(&["--help"]).code, Some(0));
}

#[test]
fn inference_without_a_host_says_so() {
    let ended = run(&["infer", "--instance", "hil-nobody"]);
    assert_eq!(ended.code, Some(1));
    assert!(ended.stderr.contains("hil-nobody"), "{}", ended.stderr);
}

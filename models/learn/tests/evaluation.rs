//! Evaluation: numbers that an independent computation confirms, and parts that make the whole.
#![allow(clippy::unwrap_used, reason = "a test may fail by panicking")]

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use candle_core::Device;
use noctule_depth::Completer;
use noctule_erunet::{Config, PlanOptions, Weights};
use noctule_learn::{
    EvalError, Method, Row, Scene, Scenes, Scores, Share, Withheld, WorldScenes, csv, evaluate,
    markdown,
};
use noctule_world::Tier;

const SIDE: usize = 32;
const AREA: usize = SIDE * SIDE;

fn scenes() -> WorldScenes {
    WorldScenes {
        tier: Tier::B,
        seeds: 200_003..200_006,
        size: SIDE,
    }
}

/// A network that has learnt nothing, as a weights file.
fn weights_file(folder: &Path) -> PathBuf {
    let path = folder.join("xs.safetensors");
    let weights = Weights::initial(&Config::xs(), 3, &Device::Cpu).unwrap();
    weights.write(&path).unwrap();
    path
}

fn network(path: &Path, withheld: &str) -> Method {
    let withheld: Withheld = withheld.parse().unwrap();
    Method::network("xs", path, withheld, PlanOptions::default()).unwrap()
}

fn run(methods: &mut [Method], share: Share) -> Scores {
    let stop = AtomicBool::new(false);
    evaluate(&scenes(), methods, share, &stop, &mut |_| Ok(())).unwrap()
}

/// Wall-clock time aside.
fn timeless(rows: Vec<Row>) -> Vec<Row> {
    let mut rows = rows;
    for row in &mut rows {
        row.seconds = 0.0;
        row.per_step.iter_mut().for_each(|step| step.seconds = 0.0);
    }
    rows
}

/// Mean absolute and root mean square error of one map in millimetres, written out.
fn by_hand(pred: &[f32], truth: &[f32]) -> Option<(f64, f64)> {
    let errors: Vec<f64> = pred
        .iter()
        .zip(truth)
        .filter(|(_, t)| **t > 0.0 && **t <= 80.0)
        .map(|(p, t)| 1000.0 * (f64::from(p.clamp(0.1, 80.0)) - f64::from(*t)))
        .collect();
    let count = errors.len() as f64;
    let mae = errors.iter().map(|e| e.abs()).sum::<f64>() / count;
    let mse = errors.iter().map(|e| e * e).sum::<f64>() / count;
    (count > 0.0).then_some((mae, mse.sqrt()))
}

#[test]
fn the_baselines_have_the_errors_that_a_plain_loop_finds() {
    let rows = run(&mut Method::baselines(), Share::WHOLE).rows();
    let names: Vec<&str> = rows.iter().map(|row| row.method.as_str()).collect();
    assert_eq!(
        names,
        [
            "nearest",
            "fill",
            "median constant",
            "truth of step 1 reused"
        ]
    );
    let (mut nearest, mut reused) = (Vec::new(), Vec::new());
    let mut completer = Completer::new(SIDE, SIDE).unwrap();
    let (mut map, mut aside) = (vec![0.0; AREA], vec![0.0; AREA]);
    for index in 0..scenes().count() {
        let scene = scenes().scene(index).unwrap();
        for step in 0..8 {
            let truth = &scene.depth[step * AREA..][..AREA];
            completer
                .nearest(&scene.sparse[step * AREA..][..AREA], &mut map, &mut aside)
                .unwrap();
            nearest.extend(by_hand(&map, truth));
            let sky_far = |d: &f32| if *d > 0.0 { *d } else { 80.0 };
            let first: Vec<f32> = scene.depth[..AREA].iter().map(sky_far).collect();
            reused.extend(by_hand(&first, truth));
        }
    }
    for (row, expected) in [(&rows[0], nearest), (&rows[3], reused)] {
        let count = expected.len() as f64;
        let mae = expected.iter().map(|e| e.0).sum::<f64>() / count;
        let rmse = expected.iter().map(|e| e.1).sum::<f64>() / count;
        assert_eq!(row.images, expected.len() as u64);
        assert!(
            (row.mae_mm - mae).abs() < 1e-6 * mae,
            "{} {mae}",
            row.mae_mm
        );
        assert!(
            (row.rmse_mm - rmse).abs() < 1e-6 * rmse,
            "{} {rmse}",
            row.rmse_mm
        );
    }
    // The truth of the first step is exact there and worse later.
    let steps = &rows[3].per_step;
    assert_eq!(steps[0].mae_mm, 0.0);
    assert!(steps[7].mae_mm > steps[1].mae_mm && steps[1].mae_mm > 0.0);
    assert!(rows[0].temporal_mm.is_some() && rows[0].edge_mae_mm.is_some());
}

#[test]
fn parts_merge_to_exactly_the_whole() {
    let folder = tempfile::tempdir().unwrap();
    let path = weights_file(folder.path());
    let mut methods = vec![network(&path, "full"), network(&path, "no-events+no-image")];
    methods.extend(Method::baselines());
    let whole = run(&mut methods, Share::WHOLE);
    let mut merged = Scores::default();
    for part in ["1/2", "0/2"] {
        let part = run(&mut methods, part.parse().unwrap());
        merged
            .merge_csv(&part.per_image_csv(), Path::new("part.csv"))
            .unwrap();
    }
    assert_eq!(timeless(merged.rows()), timeless(whole.rows()));
    let again = merged.merge_csv(&whole.per_image_csv(), Path::new("whole.csv"));
    assert!(matches!(again, Err(EvalError::Twice { .. })));
    // One line per image and method; the names survive their commas.
    assert_eq!(whole.per_image_csv().lines().count(), 1 + 6 * 24);
    assert_eq!(merged.rows()[1].method, "xs, no events, no image");
}

#[test]
fn a_damaged_table_is_named_with_its_line() {
    let text = run(&mut Method::baselines(), "0/3".parse().unwrap()).per_image_csv();
    let merge = |text: &str| {
        Scores::default()
            .merge_csv(text, Path::new("t.csv"))
            .unwrap_err()
    };
    let error = merge("a,b\n").to_string();
    assert_eq!(error, "t.csv, line 1: is no table of single images");
    let short = text.replacen(",B:200003,", ",", 1);
    assert!(
        merge(&short).to_string().contains("line 2: 16 columns"),
        "{}",
        merge(&short)
    );
    let words = text.replacen("\"nearest\",0,", "\"nearest\",zero,", 1);
    assert!(merge(&words).to_string().contains("zero is no number"));
}

#[test]
fn what_is_withheld_is_not_seen() {
    let folder = tempfile::tempdir().unwrap();
    let path = weights_file(folder.path());
    let mut methods: Vec<Method> = ["full", "no-events", "no-image", "no-lidar", "no-ground"]
        .iter()
        .map(|withheld| network(&path, withheld))
        .collect();
    let rows = run(&mut methods, "0/3".parse().unwrap()).rows();
    assert_eq!(rows.len(), 5);
    for (i, a) in rows.iter().enumerate() {
        assert!(a.params > 10_000 && a.gmac > 0.1);
        assert!(
            rows[i + 1..].iter().all(|b| b.rmse_mm != a.rmse_mm),
            "{}",
            a.method
        );
    }
    assert!(
        rows[3].mae_mm > rows[0].mae_mm,
        "depth without LiDAR is a guess"
    );
}

#[test]
fn tables_have_a_line_per_method() {
    let rows = run(&mut Method::baselines(), "0/3".parse().unwrap()).rows();
    let lines = |text: &str| text.lines().count();
    assert_eq!(lines(&markdown(&rows)), 2 + 4);
    assert_eq!(lines(&csv(&rows)), 1 + 4 * 9);
    let json = serde_json::to_value(&rows[0]).unwrap();
    for key in [
        "method",
        "rmse_mm",
        "mae_mm",
        "irmse_per_km",
        "rel",
        "delta1",
        "edge_mae_mm",
        "mover_mae_mm",
        "thin_mae_mm",
    ] {
        assert!(json.get(key).is_some(), "{key}");
    }
    assert_eq!(json["per_step"].as_array().unwrap().len(), 8);
    assert!(json["per_step"][0].get("per_step").is_none());
}

/// A set whose fields do not fit.
struct Broken;

impl Scenes for Broken {
    fn count(&self) -> usize {
        1
    }
    fn scene(&self, _: usize) -> Result<Scene, EvalError> {
        let mut scene = scenes().scene(0)?;
        scene.voxel.pop();
        Ok(scene)
    }
}

#[test]
fn a_scene_that_does_not_fit_is_named() {
    let stop = AtomicBool::new(false);
    let run = |scenes: &dyn Scenes, stop: &AtomicBool| {
        evaluate(
            scenes,
            &mut Method::baselines(),
            Share::WHOLE,
            stop,
            &mut |_| Ok(()),
        )
        .unwrap_err()
    };
    let error = run(&Broken, &stop).to_string();
    assert!(
        error.contains("B:200003: voxel has 40959 values, wanted 40960"),
        "{error}"
    );
    stop.store(true, std::sync::atomic::Ordering::Relaxed);
    assert!(matches!(run(&scenes(), &stop), EvalError::Interrupted));
}

/// Weights of a network for three steps serve eight; a file that says nothing of itself is refused.
#[test]
fn the_number_of_steps_is_the_datas_and_the_network_the_files() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tiny.safetensors");
    let weights = Weights::initial(&Config::tiny(), 3, &Device::Cpu).unwrap();
    weights.write(&path).unwrap();
    let open = || Method::network("tiny", &path, Withheld::default(), PlanOptions::default());
    let rows = run(&mut [open().unwrap()], "0/3".parse().unwrap()).rows();
    assert_eq!(rows[0].per_step.len(), 8);
    let unnamed = candle_core::safetensors::save(
        &weights
            .tensors()
            .clone()
            .into_iter()
            .collect::<std::collections::HashMap<_, _>>(),
        &path,
    );
    unnamed.unwrap();
    let error = open().err().unwrap().to_string();
    assert!(error.contains("do not say what network"), "{error}");
}

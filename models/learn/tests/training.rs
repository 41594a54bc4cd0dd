//! Whole runs of a small network on small nights: stages, stopping and going on, learning.
#![allow(clippy::unwrap_used, reason = "a test may fail by panicking")]

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use candle_core::Device;
use noctule_erunet::{Config, Weights};
use noctule_learn::{Cache, Kind, Run, Settings, Start, TrainError};

mod sitting;
use sitting::train;

/// Two exposures to train on, one to validate on, 32 x 32 pixels.
fn settings(root: &Path, stages: &str) -> Settings {
    let text = format!(
        r#"
        member = "tiny"
        seed = 5
        average = 0.9
        [data]
        cache = "{}"
        size = 32
        loaders = 2
        train = [{{ tier = "A", seeds = [7, 9] }}]
        validation = [{{ tier = "A", seeds = [100000, 100001] }}]
        [augment]
        flip = 0.5
        event_drop_max = 0.2
        return_drop_max = 0.2
        gain = [0.8, 1.25]
        {stages}
        "#,
        root.join("nights").display()
    );
    Settings::from_toml(&text).unwrap()
}

fn stage(kind: &str, steps: u64, more: &str) -> String {
    format!(
        r#"
        [[stages]]
        kind = "{kind}"
        steps = {steps}
        batch = 2
        crop = 32
        window = 3
        rate = [3e-3, 1e-4]
        validate_every = 4
        checkpoint_every = 3
        {more}
        "#
    )
}

fn three_stages() -> String {
    [
        stage("1", 4, "go_on_collapsed = true"),
        stage("2", 5, "warm_up = 2"),
        stage("3", 4, "clip_norm = 1.0"),
    ]
    .concat()
}

fn start(folder: PathBuf) -> Start {
    Start {
        folder,
        resume: false,
        only: None,
    }
}

fn open(settings: &Settings, start: Start) -> Result<Run, TrainError> {
    let cache = Cache::new(&settings.data.cache, settings.data.size).unwrap();
    let nights = [settings.train().unwrap(), settings.validation().unwrap()].concat();
    cache
        .prepare(&nights, &AtomicBool::new(false), &mut |_| {})
        .unwrap();
    Run::new(settings.clone(), start, &cache)
}

/// Everything in a table but the wall-clock seconds at the end of its rows.
fn table(path: &Path) -> Vec<String> {
    let text = fs::read_to_string(path).unwrap();
    let rows = text.lines().map(|row| row.rsplit_once(',').unwrap().0);
    rows.map(str::to_owned).collect()
}

#[test]
fn a_run_stopped_anywhere_goes_on_to_the_same_bits() {
    let root = tempfile::tempdir().unwrap();
    let settings = settings(root.path(), &three_stages());
    let whole = root.path().join("whole");
    let (losses, _, outcome) = train(&mut open(&settings, start(whole.clone())).unwrap(), None);
    outcome.unwrap();
    assert_eq!(losses.len(), 13);

    // In stage 1; at its end, where a validation is due; in stages 2 and 3.
    let stopped = root.path().join("stopped");
    let mut all = Vec::new();
    for (sitting, stop_at) in [Some(2), Some(4), Some(7), Some(11), None]
        .into_iter()
        .enumerate()
    {
        let start = Start {
            resume: sitting > 0,
            ..start(stopped.clone())
        };
        let (losses, _, outcome) = train(&mut open(&settings, start).unwrap(), stop_at);
        all.extend(losses);
        match stop_at {
            Some(_) => assert!(matches!(outcome, Err(TrainError::Interrupted(_)))),
            None => outcome.unwrap(),
        }
    }
    assert_eq!(all, losses);
    for file in [
        "checkpoint",
        "last",
        "best",
        "stage-1",
        "stage-2",
        "stage-3",
    ] {
        let read = |folder: &Path| fs::read(folder.join(format!("{file}.safetensors"))).unwrap();
        assert!(read(&whole) == read(&stopped), "{file} differs");
    }
    for file in ["curves.csv", "validation.csv"] {
        assert_eq!(
            table(&whole.join(file)),
            table(&stopped.join(file)),
            "{file}"
        );
    }
    for file in ["curves.png", "grid.png", "settings.toml"] {
        assert!(stopped.join(file).exists(), "{file}");
    }
}

/// A run that was killed has rows beyond its last checkpoint; they are work that is done again.
#[test]
fn rows_after_the_checkpoint_are_dropped() {
    let root = tempfile::tempdir().unwrap();
    let settings = settings(root.path(), &three_stages());
    let folder = root.path().join("run");
    let _ = train(
        &mut open(&settings, start(folder.clone())).unwrap(),
        Some(5),
    );
    let before = table(&folder.join("curves.csv"));
    let text = fs::read_to_string(folder.join("curves.csv")).unwrap();
    let lost = "2,2,6,1e-3,1.0,1.0,,,0.1\n";
    fs::write(folder.join("curves.csv"), text + lost).unwrap();
    let start = Start {
        resume: true,
        ..start(folder.clone())
    };
    open(&settings, start).unwrap();
    assert_eq!(table(&folder.join("curves.csv")), before);
}

#[test]
fn a_run_is_not_overwritten_and_not_resumed_with_other_settings() {
    let root = tempfile::tempdir().unwrap();
    let ours = settings(root.path(), &stage("2", 2, ""));
    let folder = root.path().join("run");
    let resume = Start {
        resume: true,
        ..start(folder.clone())
    };
    let nothing = open(&ours, resume.clone()).err().unwrap();
    assert!(
        matches!(nothing, TrainError::NothingToResume(_)),
        "{nothing}"
    );
    train(&mut open(&ours, start(folder.clone())).unwrap(), None)
        .2
        .unwrap();
    let exists = open(&ours, start(folder.clone())).err().unwrap();
    assert!(matches!(exists, TrainError::Exists(_)), "{exists}");
    let mut other = ours.clone();
    other.stages[0].rate[0] = 1e-2;
    let differs = open(&other, resume.clone()).err().unwrap();
    assert!(differs.to_string().contains("in stages"), "{differs}");
    let mut same = ours;
    same.threads = 4;
    open(&same, resume).unwrap();
}

#[test]
fn a_collapsed_first_stage_ends_the_run() {
    let root = tempfile::tempdir().unwrap();
    // At so small a rate restoration stays at its input.
    let stages = stage("1", 2, "").replace("3e-3, 1e-4", "1e-9, 0.0") + &stage("2", 2, "");
    let settings = settings(root.path(), &stages);
    let folder = root.path().join("run");
    let (losses, validations, outcome) =
        train(&mut open(&settings, start(folder.clone())).unwrap(), None);
    assert_eq!(losses.len(), 2, "no step of stage 2");
    let Err(TrainError::Collapsed { share, spread, .. }) = outcome else {
        panic!("{outcome:?}");
    };
    assert!(
        (share - 1.0).abs() < 1e-3 && spread < 1e-4,
        "{share} {spread}"
    );
    let pictures = validations.last().unwrap().pictures.unwrap();
    assert!(pictures.blurred > 0.0 && (pictures.share() - share).abs() < 1e-12);
    // Told to go on, it goes on.
    let mut told = settings;
    told.stages[0].go_on_collapsed = true;
    let start = Start {
        resume: true,
        ..start(folder)
    };
    let (losses, _, outcome) = train(&mut open(&told, start).unwrap(), None);
    outcome.unwrap();
    assert_eq!(losses.len(), 2);
}

#[test]
fn one_stage_can_run_alone_from_given_weights() {
    let root = tempfile::tempdir().unwrap();
    let mut settings = settings(root.path(), &three_stages());
    let first = Start {
        only: Some(Kind::Complete),
        ..start(root.path().join("first"))
    };
    let (losses, _, outcome) = train(&mut open(&settings, first).unwrap(), None);
    outcome.unwrap();
    assert_eq!(losses.len(), 5);
    settings.init = Some(root.path().join("first/stage-2.safetensors"));
    let then = Start {
        only: Some(Kind::Together),
        ..start(root.path().join("then"))
    };
    let (losses, validations, outcome) = train(&mut open(&settings, then).unwrap(), None);
    outcome.unwrap();
    assert_eq!(losses.len(), 4);
    assert!(validations.iter().all(|found| found.depth.is_some()));
    let absent = Start {
        only: Some(Kind::Joint),
        ..start(root.path().join("absent"))
    };
    let error = open(&settings, absent).err().unwrap();
    assert!(matches!(error, TrainError::NoStage(_)), "{error}");
}

/// Learns one exposure by heart: far below what the nearest returns give.
#[test]
fn one_exposure_is_learnt_by_heart() {
    use candle_core::{Device, Tensor};
    use noctule_depth::Completer;
    use noctule_learn::{Batch, Example, Loss, depth_loss};
    use noctule_world::{STEPS, Tier};

    let root = tempfile::tempdir().unwrap();
    let stages = stage("joint", 120, "clip_norm = 5.0")
        .replace("batch = 2", "batch = 1")
        .replace("window = 3", "window = 8")
        .replace("every = 4", "every = 120")
        .replace("every = 3", "every = 120");
    let mut settings = settings(root.path(), &stages);
    settings.member = "xs".into();
    settings.data.train[0].seeds = [7, 8];
    settings.augment = noctule_learn::Augment::default();
    settings.average = 0.0;
    let (losses, _, outcome) = train(
        &mut open(&settings, start(root.path().join("run"))).unwrap(),
        None,
    );
    outcome.unwrap();

    let example = Example::render(7, Tier::A, 32).unwrap();
    let inputs = Batch::whole(&example, None, 80.0).unwrap();
    let inputs = inputs.to_device(&Device::Cpu).unwrap();
    let mut completer = Completer::new(32, 32).unwrap();
    let (mut nearest, mut aside) = (vec![0.0; STEPS * 1024], vec![0.0; 1024]);
    for (step, map) in nearest.chunks_exact_mut(1024).enumerate() {
        let sparse = example.step(&example.sparse, step);
        completer.nearest(sparse, map, &mut aside).unwrap();
    }
    let nearest = Tensor::from_vec(nearest, (1, STEPS, 1, 32, 32), &Device::Cpu).unwrap();
    let loss = depth_loss(
        &nearest,
        &inputs.depth,
        &inputs.sparse,
        [None, None],
        &Loss::default(),
    );
    let nearest = f64::from(loss.unwrap().total.to_scalar::<f32>().unwrap());
    let ours = losses[losses.len() - 1];
    println!("first {}, last {ours}, nearest {nearest}", losses[0]);
    assert!(ours < 0.5 * nearest, "{ours}, nearest {nearest}");
}

#[test]
fn a_stage_trains_and_is_validated_on_its_own_loss() {
    let root = tempfile::tempdir().unwrap();
    let run = |name: &str, stages: &str| {
        let settings = settings(root.path(), stages);
        let start = start(root.path().join(name));
        let (losses, found, outcome) = train(&mut open(&settings, start).unwrap(), None);
        outcome.unwrap();
        (losses, found[0].pictures.map(|p| p.loss))
    };
    let plain = stage("1", 4, "go_on_collapsed = true");
    let own = "[stages.loss]\ncharbonnier = 3.0";
    let other = run("own", &format!("{plain}{own}"));
    let all = format!("[loss]\ncharbonnier = 3.0\n{plain}");
    assert_eq!(other, run("all", &all));
    let usual = run("usual", &plain);
    assert!(other.0[0] > 1.5 * usual.0[0]);
    assert!(other.1.unwrap() > 1.5 * usual.1.unwrap());
    // One exposure: blurred, and three steps restored and sharp.
    let sheet = noctule_depth::Canvas::load_png(root.path().join("own/grid.png")).unwrap();
    assert!(sheet.width() > 7 * 32 && sheet.height() > 32);
    // Masks that only this stage's loss asks for.
    let plain = stage("joint", 2, "");
    let usual = run("usual-depth", &plain);
    for (name, weight) in [
        ("pixels", "depth_edges = 3.0\ndepth_movers = 1.0"),
        ("mean", "mover_mean = 1.0"),
    ] {
        let own = format!("{plain}[stages.loss]\n{weight}");
        let other = run(&format!("own-{name}"), &own);
        let all = format!("[loss]\n{weight}\n{plain}");
        assert_eq!(other, run(&format!("all-{name}"), &all));
        assert!(other.0[0] > usual.0[0]);
    }
}

#[test]
fn a_run_grows_what_it_starts_from_where_it_is_told_to() {
    let root = tempfile::tempdir().unwrap();
    let small = root.path().join("xs.safetensors");
    let xs = Weights::initial(&Config::xs(), 1, &Device::Cpu).unwrap();
    xs.write(&small).unwrap();
    let mut settings = settings(root.path(), &stage("joint", 1, ""));
    settings.member = "s".into();
    settings.init = Some(small);
    let start = |name: &str| start(root.path().join(name));
    let refused = open(&settings, start("refused")).err().unwrap().to_string();
    assert!(refused.contains("xs.safetensors"), "{refused}");
    settings.grow = true;
    let (_, _, outcome) = train(&mut open(&settings, start("grown")).unwrap(), None);
    outcome.unwrap();
    let grown = root.path().join("grown/last.safetensors");
    let grown = Weights::read(&grown, &Device::Cpu).unwrap();
    grown.check(&Config::s()).unwrap();
    // One small step from where it started: what it had is still there.
    let name = "rdu.depth.down1.conv.weight";
    let had = grown.tensors()[name].narrow(1, 0, 8).unwrap();
    let apart = (had - &xs.tensors()[name]).unwrap().abs().unwrap();
    let apart = apart.max_all().unwrap().to_scalar::<f32>().unwrap();
    assert!(apart < 0.01, "{apart}");
}

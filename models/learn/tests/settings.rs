//! Settings: the shipped files are right, and what is wrong is named.
#![allow(clippy::unwrap_used, reason = "a test may fail by panicking")]

use std::path::Path;

use noctule_erunet::Form;
use noctule_learn::{Kind, Settings, SettingsError};

const GOOD: &str = r#"
member = "xs"
seed = 1
[data]
cache = "nights"
train = [{ tier = "A", seeds = [0, 16] }, { tier = "C", seeds = [0, 16] }]
validation = [{ tier = "B", seeds = [100000, 100004] }]
[[stages]]
kind = "2"
steps = 10
batch = 4
crop = 128
window = 4
rate = [1e-3, 1e-5]
validate_every = 5
checkpoint_every = 5
"#;

fn error(from: &str, to: &str) -> String {
    assert!(GOOD.contains(from), "{from}");
    Settings::from_toml(&GOOD.replace(from, to))
        .unwrap_err()
        .to_string()
}

#[test]
fn every_shipped_file_is_read() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/train");
    let mut count = 0;
    for file in std::fs::read_dir(folder).unwrap() {
        let path = file.unwrap().path();
        let settings = Settings::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        assert!(settings.stages.iter().all(|stage| stage.steps > 0));
        count += 1;
    }
    assert!(count > 0);
}

#[test]
fn settings_survive_their_own_text() {
    let settings = Settings::from_toml(GOOD).unwrap();
    assert_eq!(settings.stages[0].kind, Kind::Complete);
    assert_eq!(Settings::from_toml(&settings.to_toml()).unwrap(), settings);
}

/// The paper's network takes the form that `s` has and nothing else changes; the member's own form
/// stands where none is asked for.
#[test]
fn the_form_may_be_another_than_the_members() {
    let settings = |text: &str| Settings::from_toml(text).unwrap();
    let full = GOOD.replace("\"xs\"", "\"full\"");
    let own = settings(&full).network().unwrap();
    assert_eq!(own.form, Form::Direct);
    let asked = full.replace("seed = 1", "seed = 1\nform = \"choice\"");
    let asked = settings(&asked);
    assert_eq!(asked.network().unwrap(), own.with_form(Form::Choice));
    assert_eq!(settings(&asked.to_toml()), asked);
    let odd = error("seed = 1", "seed = 1\nform = \"chosen\"");
    assert!(odd.contains("chosen") && odd.contains("choice"), "{odd}");
}

#[test]
fn a_stage_may_minimise_something_of_its_own() {
    let text = GOOD.replace("[[stages]]", "[loss]\nssim = 0.5\n[[stages]]");
    let own = "checkpoint_every = 5\n[stages.loss]\nedge = 0.25";
    let settings = Settings::from_toml(&text.replace("checkpoint_every = 5", own)).unwrap();
    let loss = settings.loss_of(&settings.stages[0]);
    // What it does not name is the paper's, not the settings'.
    assert_eq!((loss.edge, loss.ssim), (0.25, 0.05));
    assert_eq!(Settings::from_toml(&settings.to_toml()).unwrap(), settings);
    let plain = Settings::from_toml(&text).unwrap();
    assert_eq!(plain.loss_of(&plain.stages[0]).ssim, 0.5);
}

#[test]
fn seeds_of_validation_and_test_are_not_trained_on() {
    let wrong = |seeds: &str| error("\"A\", seeds = [0, 16]", &format!("\"A\", seeds = {seeds}"));
    let beyond = wrong("[99990, 100001]");
    assert!(
        beyond.contains("data.train[0].seeds is 99990..100001, wanted a range within 0..100000"),
        "{beyond}"
    );
    assert!(wrong("[200000, 200016]").contains("data.train[0].seeds"));
    assert!(wrong("[5, 5]").contains("5..5"));
    let tested = error("[100000, 100004]", "[200000, 200004]");
    assert!(tested.contains("within 100000..200000"), "{tested}");
    let twice = error("\"C\"", "\"A\"");
    assert!(twice.contains("no seed twice"), "{twice}");
}

#[test]
fn each_wrong_number_is_named() {
    for (from, to, text) in [
        ("\"xs\"", "\"xl\"", "xl"),
        ("\"A\"", "\"Z\"", "tier is \"Z\""),
        ("steps = 10", "steps = 0", "stages[0].steps is 0"),
        (
            "crop = 128",
            "crop = 120",
            "stages[0].crop is 120, wanted a multiple of 16 up to 256",
        ),
        ("crop = 128", "crop = 512", "stages[0].crop is 512"),
        (
            "window = 4",
            "window = 9",
            "stages[0].window is 9, wanted 1 to 8",
        ),
        ("batch = 4", "batch = 0", "stages[0].batch is 0"),
        ("[1e-3, 1e-5]", "[1e-5, 1e-3]", "not rising"),
        ("[1e-3, 1e-5]", "[nan, 1e-5]", "stages[0].rate"),
        ("validate_every = 5", "validate_every = 0", "validate_every"),
        ("seed = 1", "seed = 1\naverage = 1.0", "average is 1"),
        ("seed = 1", "seed = 1\nthreads = 0", "threads is 0"),
        (
            "seed = 1",
            "seed = 1\ndevice = \"gpu\"",
            "device is gpu, wanted cpu, cuda:0",
        ),
        ("seed = 1", "sede = 1", "sede"),
        ("kind = \"2\"", "kind = \"4\"", "4"),
        (
            "[[stages]]",
            "[loss]\nssim = -1.0\n[[stages]]",
            "loss.ssim is -1",
        ),
        (
            "checkpoint_every = 5",
            "checkpoint_every = 5\n[stages.loss]\nedge = 2e3",
            "stages[0].loss.edge is 2000",
        ),
        (
            "[[stages]]",
            "[augment]\nflip = 1.5\n[[stages]]",
            "augment.flip is 1.5",
        ),
        (
            "[[stages]]",
            "[augment]\nover_movers = -0.1\n[[stages]]",
            "augment.over_movers is -0.1",
        ),
        (
            "[[stages]]",
            "[augment]\ngain = [2.0, 1.0]\n[[stages]]",
            "augment.gain",
        ),
        (
            "[[stages]]",
            "[augment]\nzoom_max = 0.5\n[[stages]]",
            "augment.zoom_max is 0.5, wanted 1 to 8",
        ),
        (
            "[[stages]]",
            "[augment]\nevent_lag_us_max = nan\n[[stages]]",
            "augment.event_lag_us_max is NaN",
        ),
        (
            "[[stages]]",
            "[augment]\nring_stride_max = 0\n[[stages]]",
            "augment.ring_stride_max is 0, wanted 1 to 64",
        ),
        (
            "[[stages]]",
            "[augment]\npicture_bits_min = 9\n[[stages]]",
            "augment.picture_bits_min is 9",
        ),
    ] {
        let error = error(from, to);
        assert!(error.contains(text), "{to}: {error}");
    }
    let absent = Settings::read(Path::new("/nonexistent/x.toml")).unwrap_err();
    assert!(matches!(absent, SettingsError::File { .. }));
}

const KITTI: &str =
    "[data.kitti]\nroot = \"kitti\"\nframes = [0, 5]\nvalidation = [6, 7]\nshare = 0.5\n[[stages]]";

#[test]
fn real_drives_are_asked_for_by_frames() {
    let text = GOOD.replace("[[stages]]", KITTI);
    let settings = Settings::from_toml(&text).unwrap();
    let kitti = settings.data.kitti.clone().unwrap();
    assert_eq!(
        (kitti.frames, kitti.cuts, kitti.drives.len()),
        ([0, 5], 12, 0)
    );
    assert_eq!(Settings::from_toml(&settings.to_toml()).unwrap(), settings);
    for (from, to, fault) in [
        (
            "[0, 5]",
            "[0, 2]",
            "data.kitti.frames is [0, 2], wanted first and last frame",
        ),
        ("[0, 5]", "[5, 0]", "data.kitti.frames is [5, 0]"),
        (
            "[6, 7]",
            "[5, 7]",
            "data.kitti.validation is [5, 7], wanted none of the frames",
        ),
        ("[6, 7]", "[7, 6]", "data.kitti.validation is [7, 6]"),
        (
            "share = 0.5",
            "share = 0",
            "data.kitti.share is 0, wanted above 0",
        ),
        ("share = 0.5", "share = 1.5", "data.kitti.share is 1.5"),
        (
            "share = 0.5",
            "share = 1.0",
            "data.train is 2 ranges, wanted none",
        ),
        (
            "share = 0.5",
            "share = 0.5\ncuts = 0",
            "data.kitti.cuts is 0, wanted 1 to 256",
        ),
        (
            "share = 0.5",
            "share = 0.5\nframe = 3",
            "unknown field `frame`",
        ),
        ("share = 0.5", "", "missing field `share`"),
        ("root = \"kitti\"", "", "missing field `root`"),
    ] {
        assert!(text.contains(from), "{from}");
        let error = Settings::from_toml(&text.replacen(from, to, 1)).unwrap_err();
        assert!(error.to_string().contains(fault), "{to}: {error}");
    }
    // Alone they need no nights, and nights to validate on only without frames for it.
    let alone = text.replace("share = 0.5", "share = 1.0");
    let train = alone.find("train = ").unwrap();
    let kitti = alone.find("[data.kitti]").unwrap();
    let without = |from: usize| format!("{}{}", &alone[..from], &alone[kitti..]);
    Settings::from_toml(&without(train)).unwrap();
    let nothing = without(train).replace("validation = [6, 7]\n", "");
    let error = Settings::from_toml(&nothing).unwrap_err().to_string();
    assert!(error.contains("data.validation is empty"), "{error}");
    let none = GOOD.replace("train = [{", "#");
    let error = Settings::from_toml(&none).unwrap_err().to_string();
    assert!(error.contains("data.train is empty"), "{error}");
}

#[test]
fn a_network_without_restoration_has_no_first_stage() {
    let text = GOOD
        .replace("seed = 1", "seed = 1\nvariant = \"no_efr\"")
        .replace("kind = \"2\"", "kind = \"1\"");
    let error = Settings::from_toml(&text).unwrap_err().to_string();
    assert!(error.contains("restores nothing"), "{error}");
}

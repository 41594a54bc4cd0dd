//! Every file that ships is accepted; what no rig can run with is refused by the key's name.
#![allow(clippy::unwrap_used, reason = "a test may stop where it stands")]

use std::fs;
use std::path::{Path, PathBuf};

use noctule::config::{Config, ConfigError, DEFAULT_TOML};
use noctule_recording::Calibration;

fn toml_files(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            toml_files(&path, found);
        } else if path.extension().is_some_and(|e| e == "toml") {
            found.push(path);
        }
    }
}

#[test]
fn every_shipped_file_is_accepted() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("config");
    let calibrations = root.join("calibration");
    let mut files = Vec::new();
    toml_files(&root, &mut files);
    assert!(files.contains(&root.join("noctule.toml")));
    assert!(files.iter().any(|f| f.starts_with(&calibrations)));
    for file in files {
        let refused = if file.starts_with(&calibrations) {
            Calibration::load(&file).err().map(|e| e.to_string())
        } else if file.starts_with(root.join("train")) {
            training_refused(&file)
        } else {
            Config::load(&file).err().map(|e| e.to_string())
        };
        assert_eq!(refused, None, "{}", file.display());
    }
}

#[cfg(feature = "model")]
fn training_refused(file: &Path) -> Option<String> {
    let settings = noctule_learn::Settings::read(file);
    settings.err().map(|e| e.to_string())
}

/// A build without networks cannot read what only trains them.
#[cfg(not(feature = "model"))]
fn training_refused(_file: &Path) -> Option<String> {
    None
}

#[test]
fn an_empty_file_is_all_defaults() {
    assert_eq!(Config::parse("", "empty").unwrap(), Config::default());
}

#[test]
fn keys_nobody_knows_and_values_of_the_wrong_type_are_refused_by_name() {
    for (text, key) in [
        ("instanse = \"a\"", "instanse"),
        ("[grids]\nwidth = 256", "grids"),
        ("[grid]\nwidht = 256", "widht"),
        ("[strobe]\nopen_delay_ns = 0", "open_delay_ns"),
        ("[strobe]\nactive = \"up\"", "active"),
        ("[strobe]\nchannel = 256", "channel"),
        ("[budget]\nbundle_ms = -1", "bundle_ms"),
        ("[budget]\nframe_ms = 1", "frame_ms"),
        ("[lanes]\nimages = 1.5", "images"),
        ("[lanes]\nevents = 8", "events"),
        ("[lidar]\nport = 65536", "port"),
        ("[lidar]\nip = \"10.0.0.1\"", "ip"),
        ("[infer]\nmodel = \"huge\"", "model"),
        ("[infer]\nladders = true", "ladders"),
        ("[infer]\nthreads = -1", "threads"),
        ("[infer]\nprecision = \"f16\"", "f16"),
        ("[infer]\ndevice = \"gpu\"", "gpu"),
        ("[infer]\ndevice = \"cuda:\"", "cuda:"),
        ("[infer.weights]\nhuge = \"x.safetensors\"", "huge"),
        ("[can]\nbitrate = 500000", "bitrate"),
        ("[can.speed]\nid = 1\ncolour = 2", "colour"),
        ("[can]\nage_ms_max = 50", "speed"),
    ] {
        let error = Config::parse(text, "rig.toml").unwrap_err();
        assert!(
            matches!(error, ConfigError::Syntax { .. }),
            "{text}: {error}"
        );
        let message = error.to_string();
        assert!(
            message.contains(key) && message.contains("rig.toml"),
            "{text}: {message}"
        );
    }
}

#[test]
fn values_out_of_range_and_contradictions_are_refused_by_name() {
    for (text, key) in [
        ("instance = \"\"", "instance"),
        ("instance = \"a/b\"", "instance"),
        (
            "instance = \"a-name-of-more-than-thirty-two-letters\"",
            "instance",
        ),
        ("[grid]\nwidth = 0", "grid"),
        ("[grid]\nsteps = 0", "grid"),
        ("[grid]\nsteps = 17", "grid"),
        ("[grid]\nbins = 0", "grid"),
        ("[grid]\nwidth = 4294967295\nheight = 4294967295", "grid"),
        ("[grid]\ndepth_m_max = 0.5", "grid.depth_m_max"),
        ("[grid]\ndepth_m_max = nan", "grid.depth_m_max"),
        ("[grid]\ndepth_m_max = inf", "grid.depth_m_max"),
        (
            "[strobe]\nvirtual_period_ms = 0",
            "strobe.virtual_period_ms",
        ),
        (
            "[strobe]\nvirtual_period_ms = 60001",
            "strobe.virtual_period_ms",
        ),
        ("[strobe]\nvirtual_width_ms = 0", "strobe.virtual_width_ms"),
        (
            "[strobe]\nvirtual_period_ms = 50\nvirtual_width_ms = 51",
            "strobe.virtual_width_ms",
        ),
        ("[strobe]\nopen_delay_us = 10001", "strobe.open_delay_us"),
        ("[strobe]\nclose_delay_us = -10001", "strobe.close_delay_us"),
        ("[budget]\nbundle_ms = 0", "budget.bundle_ms"),
        (
            "[budget]\nbundle_ms = 10001\ndepth_ms = 20000",
            "budget.bundle_ms",
        ),
        ("[budget]\nbundle_ms = 400", "budget.depth_ms"),
        (
            "[budget]\nbundle_ms = 100\ndepth_ms = 100",
            "budget.depth_ms",
        ),
        ("[budget]\ndepth_ms = 60001", "budget.depth_ms"),
        ("[lanes]\nevent_blocks = 7", "lanes.event_blocks"),
        ("[lanes]\nevent_blocks = 65537", "lanes.event_blocks"),
        ("[lanes]\nlidar_packets = 7", "lanes.lidar_packets"),
        ("[lanes]\nimages = 1", "lanes.images"),
        ("[lanes]\nmotion = 0", "lanes.motion"),
        ("[lanes]\nhistory_events = 100000", "lanes.history_events"),
        ("[lanes]\nhistory_events = 32768", "lanes.history_events"),
        (
            "[lanes]\nhistory_events = 536870912",
            "lanes.history_events",
        ),
        ("[lidar]\nmodel = \"vlp16\"", "lidar.model"),
        ("[infer]\nmodel = \"full\"", "infer.model"),
        ("[infer]\nthreads = 65", "infer.threads"),
        (
            "[infer]\nmodel = \"full\"\n[infer.weights]\nxs = \"xs.safetensors\"",
            "infer.model",
        ),
        (
            "[infer.weights]\nfill = \"fill.safetensors\"",
            "infer.weights",
        ),
    ] {
        let error = Config::parse(text, "rig.toml").unwrap_err();
        let ConfigError::Value {
            key: named, origin, ..
        } = &error
        else {
            panic!("{text}: {error}");
        };
        assert!(named.starts_with(key), "{text}: {error}");
        assert_eq!(origin, "rig.toml");
        assert!(error.to_string().contains(key), "{text}: {error}");
    }
}

#[test]
fn signals_that_no_bus_carries_are_refused() {
    for (from, to, words) in [
        ("unit = \"km/h\"", "unit = \"knots\"", "knots"),
        ("length_bits = 16", "length_bits = 0", "speed"),
        ("start_bit = 0", "start_bit = 60", "speed"),
        ("start_bit = 7", "start_bit = 63", "yaw_rate"),
        ("id = 0x201", "id = 0x200", "share"),
    ] {
        let text = DEFAULT_TOML.replacen(from, to, 1);
        assert_ne!(text, DEFAULT_TOML, "{from}");
        let error = Config::parse(&text, "rig.toml").unwrap_err();
        assert!(
            matches!(&error, ConfigError::Value { key: "can", .. }),
            "{to}: {error}"
        );
        assert!(error.to_string().contains(words), "{to}: {error}");
    }
}

#[test]
fn a_file_that_is_not_there_is_named() {
    let error = Config::load(Path::new("/no/such/noctule.toml")).unwrap_err();
    assert!(
        error.to_string().contains("/no/such/noctule.toml"),
        "{error}"
    );
}

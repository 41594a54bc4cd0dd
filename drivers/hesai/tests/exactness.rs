//! Captures of four sensors decode to the expected counts, times and coordinates.
//!
//! Expected values and clouds come with the captures; the clouds were made by another decoder.
#![allow(clippy::unwrap_used, reason = "a failure is a failed test")]

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::BufReader;
use std::path::Path;

use noctule_hesai::pcap::Reader;
use noctule_hesai::{Decoder, FireTimes, Model, Options, ReturnSink, Returns, Survey};
use noctule_sensor::Return;
use serde_json::Value;

mod captures;

/// A return with what tests need to know beside it.
#[derive(Debug, Clone, Copy)]
struct Point {
    r: Return,
    sweep: u32,
    packet: usize,
}

impl Point {
    fn distance_m(&self) -> f64 {
        let [x, y, z] = [self.r.x_m, self.r.y_m, self.r.z_m].map(f64::from);
        (x * x + y * y + z * z).sqrt()
    }
}

fn options(folder: &Path, table: &str, model: Model, returns: Returns) -> Options {
    let correction = captures::correction(folder, table, model);
    Options {
        correction,
        returns,
        ..Options::new(model)
    }
}

fn decode(folder: &Path, name: &str, options: Options) -> (Vec<Point>, Decoder) {
    let mut decoder = Decoder::new(options).unwrap();
    let mut points = Vec::new();
    for (packet, payload) in captures::payloads(folder.join(format!("{name}.pcap")))
        .iter()
        .enumerate()
    {
        let mut sink = |r: Return, sweep| points.push(Point { r, sweep, packet });
        decoder.decode(payload, &mut sink).unwrap();
    }
    (points, decoder)
}

/// The settings behind the clouds: a range gate; of equal returns of a firing the last; an earlier
/// one closer than 0.1 m to another dropped.
fn strict(points: &[Point], gate_m: (f64, f64), echoes: usize) -> Vec<Point> {
    let firing = |p: &Point| (p.packet, usize::from(p.r.block) / echoes, p.r.channel);
    let mut kept = Vec::new();
    for group in points.chunk_by(|a, b| firing(a) == firing(b)) {
        for (i, point) in group.iter().enumerate() {
            let d = point.distance_m();
            let others = group.iter().enumerate();
            let near = |(j, o): (usize, &Point)| i < j && (d - o.distance_m()).abs() < 0.1 - 1e-6;
            if (gate_m.0 - 1e-6..=gate_m.1 + 1e-6).contains(&d) && !others.into_iter().any(near) {
                kept.push(*point);
            }
        }
    }
    kept
}

fn expected(folder: &Path, name: &str, filter: &str) -> Value {
    let path = folder.join(format!("expected/{name}.{filter}.json"));
    serde_json::from_str(&fs::read_to_string(path).unwrap()).unwrap()
}

fn check_axis(points: &[Point], axis: impl Fn(&Return) -> f32, expected: &Value, what: &str) {
    let values = || points.iter().map(|p| f64::from(axis(&p.r)));
    let n = f64::from(u32::try_from(points.len()).unwrap());
    let found = [
        values().fold(f64::INFINITY, f64::min),
        values().fold(f64::NEG_INFINITY, f64::max),
        values().sum::<f64>() / n,
    ];
    for (found, expected) in found.iter().zip(expected.as_array().unwrap()) {
        let error = (found - expected.as_f64().unwrap()).abs();
        assert!(error < 1e-5, "{what}: {found} for {expected}");
    }
}

fn check(points: &[Point], expected: &Value, name: &str) {
    assert_eq!(expected["points"], points.len(), "{name}");
    let mut sweeps: BTreeMap<u32, Vec<Point>> = BTreeMap::new();
    for point in points {
        sweeps.entry(point.sweep).or_default().push(*point);
    }
    let expected = expected["scans"].as_object().unwrap();
    assert_eq!(sweeps.len(), expected.len(), "{name}");
    for (number, points) in &sweeps {
        let expected = &expected[&number.to_string()];
        let what = format!("{name}, sweep {number}");
        assert_eq!(expected["points"], points.len(), "{what}");
        let intensity: u64 = points.iter().map(|p| u64::from(p.r.intensity)).sum();
        assert_eq!(expected["intensity_sum"], intensity, "{what}");
        let times = || points.iter().map(|p| p.r.t.as_nanos());
        assert_eq!(expected["t_first_ns"], times().min().unwrap(), "{what}");
        assert_eq!(expected["t_last_ns"], times().max().unwrap(), "{what}");
        let mut per_ring = vec![0; expected["per_ring"].as_array().unwrap().len()];
        points
            .iter()
            .for_each(|p| per_ring[usize::from(p.r.channel)] += 1);
        assert_eq!(expected["per_ring"], Value::from(per_ring), "{what}");
        check_axis(points, |r| r.x_m, &expected["x"], &what);
        check_axis(points, |r| r.y_m, &expected["y"], &what);
        check_axis(points, |r| r.z_m, &expected["z"], &what);
    }
}

#[test]
fn every_return_and_every_sweep_is_as_expected() {
    let Some(folder) = captures::folder("every_return") else {
        return;
    };
    for (name, table, model) in captures::SENSORS {
        let (points, decoder) = decode(&folder, name, options(&folder, table, model, Returns::All));
        let expected = expected(&folder, name, "all");
        check(&points, &expected, name);
        let counts = decoder.counts();
        assert_eq!(expected["packets"], counts.packets);
        assert_eq!(counts.returns, u64::try_from(points.len()).unwrap());
        let faults = [
            counts.lost,
            counts.late,
            counts.duplicate,
            counts.clock_steps,
        ];
        assert_eq!((faults, counts.rejected.total()), ([0; 4], 0), "{name}");
    }
}

#[test]
fn the_clouds_of_another_decoder_are_met_point_by_point_in_order() {
    let Some(folder) = captures::folder("the_clouds") else {
        return;
    };
    let gates = [(0.1, 60.0), (0.3, 50.0), (0.05, 120.0), (0.3, 200.0)];
    for ((name, table, model), gate) in captures::SENSORS.into_iter().zip(gates) {
        let (points, _) = decode(&folder, name, options(&folder, table, model, Returns::All));
        let points = strict(&points, gate, 2);
        let expected = expected(&folder, name, "strict");
        check(&points, &expected, name);
        let sweep = expected["ground_truth"]["scan"].as_u64().unwrap();
        let cloud = cloud(&folder.join(format!("{name}_gt.pcd")));
        let points: Vec<_> = points
            .iter()
            .filter(|p| u64::from(p.sweep) == sweep)
            .collect();
        assert_eq!(points.len(), cloud.len(), "{name}");
        let mut worst = 0.0f32;
        for (point, truth) in points.iter().zip(&cloud) {
            let found = [point.r.x_m, point.r.y_m, point.r.z_m];
            for (a, b) in found.iter().zip(truth) {
                worst = worst.max((a - b).abs());
            }
        }
        eprintln!("{name}: worst coordinate {worst:e} m off");
        assert!(worst < 1e-5, "{name}: {worst}");
    }
}

/// x, y, z of a binary PCD of three floats.
fn cloud(path: &Path) -> Vec<[f32; 3]> {
    let bytes = fs::read(path).unwrap();
    let marker = b"DATA binary\n";
    let start = bytes
        .windows(marker.len())
        .position(|w| w == marker)
        .unwrap()
        + marker.len();
    let (points, rest) = bytes[start..].as_chunks::<12>();
    assert!(rest.is_empty());
    let float = |p: &[u8; 12], i: usize| f32::from_le_bytes(core::array::from_fn(|k| p[i + k]));
    points
        .iter()
        .map(|p| [float(p, 0), float(p, 4), float(p, 8)])
        .collect()
}

#[test]
fn times_of_single_returns_are_exact_to_the_nanosecond() {
    let Some(folder) = captures::folder("times_of_single_returns") else {
        return;
    };
    let mut options = options(&folder, "PandarQT64.csv", Model::Qt64, Returns::All);
    let text = fs::read_to_string(folder.join("PandarQT_firetime_us.csv")).unwrap();
    options.fire_times = FireTimes::from_csv(Model::Qt64, &text).unwrap();
    let (points, _) = decode(&folder, "qt64", options);
    let points = strict(&points, (0.1, 60.0), 2);
    let head = fs::read_to_string(folder.join("expected/qt64_scan_head.csv")).unwrap();
    let mut rows = 0;
    let found = points.iter().filter(|p| p.sweep == 3);
    for (line, point) in head.lines().skip(1).zip(found) {
        let fields: Vec<f64> = line.split(',').map(|f| f.parse().unwrap()).collect();
        let t: u64 = line.rsplit(',').next().unwrap().parse().unwrap();
        let Point { r, packet, .. } = point;
        assert_eq!(r.t.as_nanos(), t, "{line}");
        let integers = [r.intensity, r.channel, r.block].map(f64::from);
        assert_eq!(integers, [fields[3], fields[4], fields[5]], "{line}");
        assert_eq!(*packet as f64, fields[6], "{line}");
        for (a, b) in [r.x_m, r.y_m, r.z_m].into_iter().zip(&fields) {
            assert!((f64::from(a) - b).abs() < 1e-5, "{line}");
        }
        assert!((point.distance_m() - fields[7]).abs() < 1e-5, "{line}");
        rows += 1;
    }
    assert_eq!(rows, 2_000);
}

#[test]
fn a_survey_needs_to_be_told_nothing() {
    let Some(folder) = captures::folder("a_survey") else {
        return;
    };
    // Sweeps touched and complete, by hand from the first and last azimuths of each capture.
    let sweeps = [(5, 2), (3, 1), (3, 1), (3, 1)];
    for ((name, _, model), (touched, complete)) in captures::SENSORS.into_iter().zip(sweeps) {
        let file = File::open(folder.join(format!("{name}.pcap"))).unwrap();
        let mut survey = Survey::new();
        survey
            .read(&mut Reader::new(BufReader::new(file)).unwrap())
            .unwrap();
        let summary = survey.summary();
        let expected = expected(&folder, name, "all");
        assert_eq!((summary.model, summary.port), (Some(model), Some(2368)));
        assert_eq!(expected["points"], summary.counts.returns, "{name}");
        assert_eq!(
            (summary.counts.sweeps, summary.counts.sweeps_complete),
            (touched, complete)
        );
        let scans = expected["scans"].as_object().unwrap();
        let first = scans
            .values()
            .map(|s| s["t_first_ns"].as_u64().unwrap())
            .min();
        let last = scans
            .values()
            .map(|s| s["t_last_ns"].as_u64().unwrap())
            .max();
        assert_eq!(summary.first.map(|t| t.as_nanos()), first, "{name}");
        assert_eq!(summary.last.map(|t| t.as_nanos()), last, "{name}");
        eprintln!("{name}: {summary:?}");
    }
}

#[test]
fn unique_returns_are_those_that_differ() {
    let Some(folder) = captures::folder("unique_returns") else {
        return;
    };
    for (name, table, model) in captures::SENSORS {
        let (all, _) = decode(&folder, name, options(&folder, table, model, Returns::All));
        let chosen = options(&folder, table, model, Returns::Unique);
        let (unique, decoder) = decode(&folder, name, chosen);
        let firing = |p: &Point| (p.packet, p.r.block / 2, p.r.channel);
        let pairs = all.chunk_by(|a, b| firing(a) == firing(b));
        let equal = |a: &Point, b: &Point| {
            a.r.intensity == b.r.intensity && a.distance_m().to_bits() == b.distance_m().to_bits()
        };
        let repeated = pairs
            .filter(|p| p.len() == 2 && equal(&p[0], &p[1]))
            .count();
        assert!(repeated > 0, "{name}");
        assert_eq!(unique.len(), all.len() - repeated, "{name}");
        assert_eq!(
            decoder.counts().points,
            u64::try_from(unique.len()).unwrap(),
            "{name}"
        );
        assert_eq!(
            decoder.counts().returns,
            u64::try_from(all.len()).unwrap(),
            "{name}"
        );
    }
}

/// Asserted here because a sink is a closure everywhere else.
#[test]
fn a_sink_is_any_type_that_says_so() {
    struct Counter(usize);
    impl ReturnSink for Counter {
        fn on_return(&mut self, _: Return, _: u32) {
            self.0 += 1;
        }
    }
    let mut counter = Counter(0);
    let mut decoder = Decoder::new(Options::new(Model::Qt64)).unwrap();
    assert!(decoder.decode(&[0; 40], &mut counter).is_err());
    assert_eq!((counter.0, decoder.counts().rejected.total()), (0, 1));
}

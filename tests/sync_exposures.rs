//! Exposures and images against a simulated camera, strobe and event camera: no image may ever be
//! attached to a wrong exposure, whatever goes missing, doubles, inverts, jumps or restarts.
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::print_stdout,
    clippy::unwrap_used,
    reason = "simulated instants are positive and small; a test may stop where it stands"
)]

use std::collections::HashMap;

use noctule::sync::{
    ClockReading, EnvelopeConfig, ExposureCounts, ExposureEvent, ExposureTracker, ImageStamp,
    Observation, SensorClock, StampedAt, Timeline, TimelineConfig, TrackerConfig,
};
use noctule_sensor::{Evk4, Stamp, TriggerEdge};

mod sync_simulation;
use sync_simulation::{Chance, MS, Oscillator, S, host, ticks};

/// How one run goes wrong.
#[derive(Clone, Copy)]
struct Faults {
    missed: f64,
    doubled: f64,
    inverted: f64,
    images_dropped: f64,
    packets_lost: f64,
    /// Constant USB delay that calibration does not know, nanoseconds.
    usb_fixed: f64,
    /// At half time the counter is changed: this is added to what it shows, nanoseconds.
    jump: f64,
    is_polarity_wrong: bool,
    /// The exposure wanders between 60 and 160 ms instead of keeping to one width.
    is_width_varied: bool,
}

const RIG: Faults = Faults {
    missed: 0.02,
    doubled: 0.02,
    inverted: 0.01,
    images_dropped: 0.02,
    packets_lost: 0.01,
    usb_fixed: 1.5 * MS,
    jump: 0.0,
    is_polarity_wrong: false,
    is_width_varied: false,
};

enum Input {
    Transfer {
        newest: Stamp<Evk4>,
        edges: Vec<TriggerEdge>,
    },
    Image(ImageStamp),
    Clocks(ClockReading),
}

/// A run: its inputs by arrival, and where each image's shutter truly opened and closed.
struct Run {
    inputs: Vec<(f64, Input)>,
    /// By sequence: open and close on the counter (as it showed them), nanoseconds.
    truth: HashMap<u64, (f64, f64)>,
}

fn simulate(seed: u64, seconds: f64, stamped_at: StampedAt, faults: &Faults) -> Run {
    let mut chance = Chance::new(seed);
    let clock = Oscillator::any(&mut chance);
    let half = seconds / 2.0 * S;
    let counter = |t: f64| clock.shows(t) + if t > half { faults.jump } else { 0.0 };
    let period = 200.0 * MS;
    let phase = chance.uniform() * period;
    let mut width = (60.0 + 100.0 * chance.uniform()) * MS;
    let mut run = Run {
        inputs: Vec::new(),
        truth: HashMap::new(),
    };
    let mut edges: Vec<(f64, bool)> = Vec::new();
    for sequence in 0..(seconds * S / period) as u64 - 1 {
        let open = phase + sequence as f64 * period;
        if faults.is_width_varied {
            width = (width + (chance.uniform() - 0.5) * 10.0 * MS).clamp(60.0 * MS, 160.0 * MS);
        }
        let close = open + width;
        for (t, rising) in [(open, true), (close, false)] {
            if chance.is(faults.missed) {
                continue;
            }
            let seen = rising != (chance.is(faults.inverted) ^ faults.is_polarity_wrong);
            edges.push((t, seen));
            if chance.is(faults.doubled) {
                edges.push((t + chance.uniform() * 0.3 * MS, seen));
            }
        }
        run.truth.insert(sequence, (counter(open), counter(close)));
        if chance.is(faults.images_dropped) {
            continue;
        }
        let stamped = if stamped_at == StampedAt::Start {
            open
        } else {
            close
        };
        let driver = host(stamped + chance.normal(20e3));
        let arrival = close + 12.0 * MS + chance.exponential(0.2 * MS);
        let exposure_ns = Some(width as i64);
        let image = ImageStamp {
            sequence,
            driver,
            stamped_at,
            exposure_ns,
            arrival: host(arrival),
        };
        run.inputs.push((arrival, Input::Image(image)));
    }
    edges.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (mut next, mut arrived) = (0, 0.0_f64);
    for millis in 1..=(seconds * 1000.0) as u64 {
        let t = millis as f64 * MS;
        let mut carried = Vec::new();
        while next < edges.len() && edges[next].0 < t {
            let (at, rising) = edges[next];
            carried.push(TriggerEdge {
                t: ticks(counter(at)),
                channel: 0,
                rising,
            });
            next += 1;
        }
        arrived = arrived.max(t + faults.usb_fixed + chance.exponential(MS));
        if !chance.is(faults.packets_lost) {
            let newest = ticks(counter(t - 500.0));
            run.inputs.push((
                arrived,
                Input::Transfer {
                    newest,
                    edges: carried,
                },
            ));
        }
        if millis % 1000 == 1 {
            let reading = ClockReading {
                realtime: host(t),
                monotonic: host(t),
                tai_offset_ns: 37_000_000_000,
            };
            run.inputs.push((t, Input::Clocks(reading)));
        }
    }
    run.inputs.sort_by(|a, b| a.0.total_cmp(&b.0));
    run
}

/// Drives tracker and timeline as a host does; gives everything that was said.
fn drive(run: &Run) -> (Vec<ExposureEvent>, ExposureCounts) {
    let mut timeline = Timeline::new(TimelineConfig {
        evk4: SensorClock::Arrivals(EnvelopeConfig::usb()),
        ..TimelineConfig::free_running()
    });
    let mut tracker = ExposureTracker::new(TrackerConfig::default());
    let mut said = Vec::new();
    for (arrival, input) in &run.inputs {
        let before = said.len();
        let map = timeline.evk4_to_monotonic();
        match input {
            Input::Clocks(reading) => {
                timeline.clocks(*reading);
            }
            Input::Transfer { newest, edges } => {
                let outcome = timeline.evk4_arrival(*newest, host(*arrival));
                if matches!(outcome, Observation::NewEpoch(_)) {
                    tracker.clock_changed(&mut |e| said.push(e));
                }
                let map = timeline.evk4_to_monotonic();
                for edge in edges {
                    tracker.edge(*edge, map.as_ref(), &mut |e| said.push(e));
                }
                if outcome == Observation::Used {
                    tracker.advance(*newest, map.as_ref(), &mut |e| said.push(e));
                }
            }
            Input::Image(image) => tracker.image(*image, map.as_ref(), &mut |e| said.push(e)),
        }
        for event in &said[before..] {
            if let ExposureEvent::Imaged {
                pair: Some(pair), ..
            } = event
            {
                timeline.strobe_pair(pair.edge, pair.driver);
            }
        }
    }
    tracker.finish(timeline.evk4_to_monotonic().as_ref(), &mut |e| said.push(e));
    (said, tracker.counts())
}

/// Checks every life from opening to its last word, and every image against the truth. Gives the
/// number of images attached.
fn assert_right(run: &Run, said: &[ExposureEvent], name: &str) -> usize {
    let mut lives: HashMap<u64, u32> = HashMap::new();
    let mut imaged = HashMap::new();
    for event in said {
        let (id, from, to) = match *event {
            ExposureEvent::Opened { id, .. } => (id, 0, 1),
            ExposureEvent::Closed(x) => (x.id, 1, 2),
            ExposureEvent::Discarded { id, .. } => (id, 1, 3),
            ExposureEvent::ImageMissing(x) => (x.id, 2, 3),
            ExposureEvent::Imaged { exposure, .. } => {
                let sequence = exposure.image.expect("an imaged exposure names its image");
                let (open, close) = run.truth[&sequence];
                let off_open = exposure.open.as_nanos() as f64 - open;
                let off_close = exposure.close.as_nanos() as f64 - close;
                assert!(
                    off_open.abs() < 3.0 * MS && off_close.abs() < 3.0 * MS,
                    "{name}: image {sequence} attached {off_open} ns from its opening and \
                     {off_close} ns from its close: {exposure:?}"
                );
                assert_eq!(
                    imaged.insert(sequence, exposure.id),
                    None,
                    "{name}: attached twice"
                );
                (exposure.id, 2, 3)
            }
            ExposureEvent::ImageLeftOut { .. } => continue,
        };
        let state = lives.entry(id).or_insert(0);
        assert_eq!(*state, from, "{name}: {event:?}");
        *state = to;
    }
    assert!(
        lives.values().all(|&state| state == 3),
        "{name}: every exposure has its last word"
    );
    imaged.len()
}

#[test]
fn no_image_is_ever_attached_to_a_wrong_exposure() {
    let cases = [
        ("rig", RIG, 0.90),
        (
            "varied width",
            Faults {
                is_width_varied: true,
                ..RIG
            },
            0.85,
        ),
        (
            "rough",
            Faults {
                missed: 0.1,
                doubled: 0.1,
                inverted: 0.05,
                ..RIG
            },
            0.45,
        ),
        (
            "counter jumps one period",
            Faults {
                jump: 200.0 * MS,
                ..RIG
            },
            0.85,
        ),
        (
            "counter falls back one period",
            Faults {
                jump: -200.0 * MS,
                ..RIG
            },
            0.85,
        ),
        (
            "counter jumps three periods",
            Faults {
                jump: 600.0 * MS,
                ..RIG
            },
            0.85,
        ),
        (
            "uncalibrated 8 ms of USB",
            Faults {
                usb_fixed: 8.0 * MS,
                ..RIG
            },
            0.90,
        ),
    ];
    for (name, faults, share_min) in cases {
        let (mut attached, mut offered) = (0, 0);
        for seed in 1..=12 {
            for stamped_at in [StampedAt::Start, StampedAt::End] {
                let run = simulate(seed, 40.0, stamped_at, &faults);
                let (said, counts) = drive(&run);
                attached += assert_right(&run, &said, name);
                offered += counts.images;
                assert_eq!(counts.images_matched + left_out(&counts), counts.images);
                assert_eq!(counts.opened, counts.closed + counts.discarded);
            }
        }
        let share = attached as f64 / offered as f64;
        println!(
            "{name}: {attached} of {offered} images attached, {:.1} %",
            share * 100.0
        );
        assert!(
            share >= share_min,
            "{name}: only {share} of the images attached"
        );
    }
}

fn left_out(counts: &ExposureCounts) -> u64 {
    counts.left_out_no_exposure
        + counts.left_out_ambiguous
        + counts.left_out_width
        + counts.left_out_duplicate
        + counts.left_out_no_map
        + counts.left_out_clock
}

#[test]
fn a_strobe_wired_the_wrong_way_round_attaches_nothing_and_shows_in_the_counts() {
    for seed in 1..=6 {
        let faults = Faults {
            is_polarity_wrong: true,
            ..RIG
        };
        for stamped_at in [StampedAt::Start, StampedAt::End] {
            let run = simulate(seed, 30.0, stamped_at, &faults);
            let (said, counts) = drive(&run);
            assert_eq!(assert_right(&run, &said, "polarity"), 0);
            assert_eq!(left_out(&counts), counts.images);
        }
    }
}

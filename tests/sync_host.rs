//! Timeline, tracker and closer driven together as a host drives them: streams that fall silent,
//! restart and jump, and inputs that make no sense at all.
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::print_stdout,
    clippy::unwrap_used,
    reason = "simulated instants are positive and small; a test may stop where it stands"
)]

use noctule::sync::{
    BundleCloser, BundleConfig, BundleDecision, ClockReading, ClosedBy, ExposureEvent,
    ExposureTracker, ImageStamp, Observation, StampedAt, Stream, Streams, Timeline, TimelineConfig,
    TrackerConfig,
};
use noctule_sensor::{Evk4, Lidar, Realtime, Stamp, TriggerEdge};
use proptest::prelude::*;

mod sync_simulation;
use sync_simulation::{Chance, MS, Oscillator, S, host, ticks};

#[derive(Debug, Clone)]
enum Input {
    Clocks(ClockReading),
    Transfer(Stamp<Evk4>, Vec<TriggerEdge>),
    Image(ImageStamp),
    Packet(Stamp<Lidar>),
    Motion,
}

/// The joints of a host, without its data.
struct Host {
    timeline: Timeline,
    tracker: ExposureTracker,
    closer: BundleCloser,
    said: Vec<ExposureEvent>,
    decisions: Vec<BundleDecision>,
    now: Stamp<Realtime>,
}

impl Host {
    fn new() -> Self {
        Self {
            timeline: Timeline::new(TimelineConfig::free_running()),
            tracker: ExposureTracker::new(TrackerConfig::default()),
            closer: BundleCloser::new(BundleConfig::default()),
            said: Vec::new(),
            decisions: Vec::new(),
            now: Stamp::ZERO,
        }
    }

    fn take(&mut self, arrival: Stamp<Realtime>, input: &Input) {
        self.now = arrival;
        let heard = self.said.len();
        let said = &mut self.said;
        let decisions = &mut self.decisions;
        let mut events_until = None;
        match input {
            Input::Clocks(reading) => {
                self.timeline.clocks(*reading);
            }
            Input::Transfer(newest, edges) => {
                let outcome = self.timeline.evk4_arrival(*newest, arrival);
                if matches!(outcome, Observation::NewEpoch(_)) {
                    self.tracker.clock_changed(&mut |e| said.push(e));
                    self.closer
                        .restarted(Stream::Events, arrival, &mut |d| decisions.push(d));
                }
                let map = self.timeline.evk4_to_monotonic();
                for edge in edges {
                    self.tracker
                        .edge(*edge, map.as_ref(), &mut |e| said.push(e));
                }
                if outcome == Observation::Used {
                    self.tracker
                        .advance(*newest, map.as_ref(), &mut |e| said.push(e));
                    events_until = Some(*newest);
                }
            }
            Input::Image(image) => {
                let map = self.timeline.evk4_to_monotonic();
                self.tracker
                    .image(*image, map.as_ref(), &mut |e| said.push(e));
            }
            Input::Packet(stamp) => match self.timeline.lidar_arrival(*stamp, arrival) {
                Observation::NewEpoch(_) => {
                    self.closer
                        .restarted(Stream::Lidar, arrival, &mut |d| decisions.push(d));
                }
                Observation::Used => {
                    if let Some(map) = self.timeline.lidar_to_tai() {
                        let until = map.apply(*stamp);
                        let emit = &mut |d| decisions.push(d);
                        self.closer.passed(Stream::Lidar, until, arrival, emit);
                    }
                }
                Observation::Late | Observation::Suspect => {}
            },
            Input::Motion => {
                if let Some(map) = self.timeline.realtime_to_tai() {
                    let until = map.apply(arrival);
                    self.closer
                        .passed(Stream::Motion, until, arrival, &mut |d| decisions.push(d));
                }
            }
        }
        let map = self.timeline.evk4_to_tai().map(|(map, _)| map);
        for event in &said[heard..] {
            if let ExposureEvent::Imaged {
                pair: Some(pair), ..
            } = event
            {
                self.timeline.strobe_pair(pair.edge, pair.driver);
            }
            self.closer
                .exposure(event, map.as_ref(), arrival, &mut |d| decisions.push(d));
        }
        if let Some(newest) = events_until {
            self.closer
                .events_passed(newest, arrival, &mut |d| decisions.push(d));
        }
        self.closer.arrival(arrival, &mut |d| decisions.push(d));
    }

    fn finish(&mut self) {
        let heard = self.said.len();
        let (said, decisions) = (&mut self.said, &mut self.decisions);
        let map = self.timeline.evk4_to_monotonic();
        self.tracker.finish(map.as_ref(), &mut |e| said.push(e));
        let map = self.timeline.evk4_to_tai().map(|(map, _)| map);
        for event in &said[heard..] {
            self.closer
                .exposure(event, map.as_ref(), self.now, &mut |d| decisions.push(d));
        }
        self.closer.finish(&mut |d| decisions.push(d));
    }

    /// Every exposure announced was either taken back or bundled exactly once, in order.
    fn assert_accounted(&self) {
        let mut expected: Vec<u64> = Vec::new();
        for event in &self.said {
            if let ExposureEvent::Opened { id, .. } = event {
                expected.push(*id);
            }
        }
        let mut bundled: Vec<u64> = self.decisions.iter().map(|d| d.exposure.id).collect();
        assert!(bundled.is_sorted(), "out of order: {bundled:?}");
        let count = bundled.len();
        bundled.dedup();
        assert_eq!(bundled.len(), count, "bundled twice");
        let discarded = usize::try_from(self.closer.counts().discarded).unwrap();
        assert_eq!(count + discarded, expected.len());
    }
}

/// One drive; `is_up(stream, t)` says whether a stream delivers at `t`, `counter_step(t)` is added
/// to what the event camera shows.
fn drive(
    seed: u64,
    seconds: f64,
    is_up: impl Fn(Stream, f64) -> bool,
    counter_step: impl Fn(f64) -> f64,
) -> Host {
    let mut chance = Chance::new(seed);
    let (camera, lidar) = (Oscillator::any(&mut chance), Oscillator::any(&mut chance));
    let counter = |t: f64| ticks(camera.shows(t) + counter_step(t));
    let mut inputs: Vec<(f64, Input)> = Vec::new();
    let mut arrived = 0.0_f64;
    for millis in 1..=(seconds * 1000.0) as u64 {
        let t = millis as f64 * MS;
        let in_period = millis % 200;
        let mut edges = Vec::new();
        for (at, rising) in [(50, true), (150, false)] {
            if in_period == at && !chance.is(0.02) {
                edges.push(TriggerEdge {
                    t: counter(t - 1e5),
                    channel: 0,
                    rising,
                });
            }
        }
        arrived = arrived.max(t + chance.exponential(MS));
        if is_up(Stream::Events, t) {
            inputs.push((arrived, Input::Transfer(counter(t - 1e3), edges)));
        }
        if in_period == 150 && is_up(Stream::Images, t) {
            let image = ImageStamp {
                sequence: millis / 200,
                driver: host(t - 1e5 + chance.normal(20e3)),
                stamped_at: StampedAt::End,
                exposure_ns: Some(100_000_000),
                arrival: host(t + 10.0 * MS),
            };
            inputs.push((t + 10.0 * MS, Input::Image(image)));
        }
        if is_up(Stream::Lidar, t) && !chance.is(0.01) {
            let stamp = Stamp::from_nanos(lidar.shows(t) as u64);
            inputs.push((t + chance.exponential(30e3), Input::Packet(stamp)));
        }
        if millis % 10 == 0 && is_up(Stream::Motion, t) {
            inputs.push((t, Input::Motion));
        }
        if millis % 1000 == 1 {
            let tai_offset_ns = 37_000_000_000;
            let reading = ClockReading {
                realtime: host(t),
                monotonic: host(t),
                tai_offset_ns,
            };
            inputs.push((t, Input::Clocks(reading)));
        }
    }
    inputs.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut all = Host::new();
    for (arrival, input) in &inputs {
        all.take(host(*arrival), input);
    }
    all.finish();
    all.assert_accounted();
    all
}

/// Decisions of exposures whose closing instant lies in `from..to` seconds of the drive.
fn between(all: &Host, from: f64, to: f64) -> Vec<&BundleDecision> {
    let second = |d: &BundleDecision| d.closed_at.diff_nanos(host(0.0)) as f64 / S;
    all.decisions
        .iter()
        .filter(|d| (from..to).contains(&second(d)))
        .collect()
}

fn share(decisions: &[&BundleDecision], is: impl Fn(&BundleDecision) -> bool) -> f64 {
    decisions.iter().filter(|d| is(d)).count() as f64 / decisions.len() as f64
}

#[test]
fn a_healthy_drive_is_complete_once_its_clocks_are_known() {
    for seed in 1..=4 {
        let all = drive(seed, 30.0, |_, _| true, |_| 0.0);
        let late = between(&all, 3.0, 29.9);
        assert!(late.len() > 125, "{}", late.len());
        let complete = share(&late, |d| d.closed_by == ClosedBy::Complete);
        assert!(complete > 0.9, "{complete}");
    }
}

#[test]
fn a_silent_stream_makes_bundles_partial_and_holds_up_nothing() {
    for silent in Stream::ALL {
        let all = drive(
            7,
            30.0,
            |s, t| s != silent || !(10.0..18.0).contains(&(t / S)),
            |_| 0.0,
        );
        // An exposure left open is given its longest width before it is due.
        let begin = if silent == Stream::Events { 11.5 } else { 10.6 };
        let during = between(&all, begin, 17.9);
        if silent == Stream::Events {
            assert!(during.is_empty(), "without a strobe there are no exposures");
        } else {
            assert!(during.len() >= 33, "{silent:?}: {}", during.len());
            let only = |d: &BundleDecision| d.missing == Streams::NONE.with(silent);
            assert!(share(&during, only) > 0.9, "{silent:?}");
        }
        let after = between(&all, 22.0, 29.9);
        let complete = share(&after, |d| d.closed_by == ClosedBy::Complete);
        assert!(
            complete > 0.9,
            "{silent:?}: {complete} complete once it is back"
        );
    }
}

#[test]
fn a_restarted_event_camera_recovers_and_maps_stay_honest() {
    for step in [-3.0 * S, 0.2 * S, 2000.0 * S] {
        let all = drive(
            9,
            40.0,
            |_, _| true,
            |t| if t > 15.03 * S { step } else { 0.0 },
        );
        let after = between(&all, 18.0, 39.9);
        assert!(share(&after, |d| d.closed_by == ClosedBy::Complete) > 0.9);
        let counts = all.timeline.counts().evk4;
        assert_eq!(counts.backwards + counts.steps, 1);
        for decision in between(&all, 16.0, 39.9) {
            // Truth: the shutter closes at 150 ms of each 200 ms, 0.1 ms before the transfer.
            let Some(close) = decision.close_tai else {
                continue;
            };
            let in_period = (close.as_nanos() - host::<Realtime>(0.0).as_nanos()) % 200_000_000;
            let error = in_period.abs_diff(149_900_000);
            assert!(
                error < 60_000,
                "{error} ns, claimed {}",
                decision.uncertainty_ns
            );
        }
    }
}

#[test]
fn shutter_times_on_tai_hold_to_microseconds_and_say_so() {
    let (mut errors, mut claims) = (Vec::new(), Vec::new());
    for seed in 1..=40 {
        let all = drive(seed, 60.0, |_, _| true, |_| 0.0);
        for decision in between(&all, 1.0, 59.9) {
            // Once the strobe's own fit has settled, a repaired edge being none.
            let settled = decision.uncertainty_ns < 6_000 && decision.exposure.flags.bits() == 0;
            let Some(close) = decision.close_tai.filter(|_| settled) else {
                continue;
            };
            if decision.closed_at < host(40.0 * S) {
                continue;
            }
            let begin = host::<Realtime>(0.0).as_nanos() + 37_000_000_000;
            errors.push(((close.as_nanos() - begin) % 200_000_000).abs_diff(149_900_000));
            claims.push(decision.uncertainty_ns);
        }
    }
    let held = errors.iter().zip(&claims).filter(|(e, c)| e <= c).count();
    let held = held as f64 / errors.len() as f64;
    let claim = claims.iter().sum::<u64>() as f64 / claims.len() as f64;
    errors.sort_unstable();
    let p99 = errors[errors.len() * 99 / 100] as f64;
    println!(
        "shutter on TAI: n {}, p99 error {p99} ns, mean claim {claim:.0} ns, held {held:.4}",
        errors.len()
    );
    assert!(errors.len() > 2_500, "{}", errors.len());
    assert!(p99 <= 5_000.0 && held >= 0.99 && claim <= 3.0 * p99);
}

/// Any stamp: near the drive, near the ends of the representable, or anywhere.
fn stamp() -> impl Strategy<Value = u64> {
    prop_oneof![
        6 => 0_u64..5_000_000_000,
        1 => Just(0_u64),
        1 => Just(u64::MAX),
        1 => any::<u64>(),
    ]
}

fn input() -> impl Strategy<Value = Input> {
    let edge = (stamp(), any::<bool>(), 0_u8..2).prop_map(|(t, rising, channel)| TriggerEdge {
        t: Stamp::from_nanos(t),
        channel,
        rising,
    });
    let image = (
        any::<u64>(),
        stamp(),
        any::<bool>(),
        proptest::option::of(any::<i64>()),
        stamp(),
    );
    prop_oneof![
        (stamp(), stamp(), any::<i64>()).prop_map(|(realtime, monotonic, tai_offset_ns)| {
            Input::Clocks(ClockReading {
                realtime: Stamp::from_nanos(realtime),
                monotonic: Stamp::from_nanos(monotonic),
                tai_offset_ns,
            })
        }),
        (stamp(), proptest::collection::vec(edge, 0..6))
            .prop_map(|(t, edges)| Input::Transfer(Stamp::from_nanos(t), edges)),
        image.prop_map(|(sequence, driver, is_start, exposure_ns, arrival)| {
            Input::Image(ImageStamp {
                sequence,
                driver: Stamp::from_nanos(driver),
                stamped_at: if is_start {
                    StampedAt::Start
                } else {
                    StampedAt::End
                },
                exposure_ns,
                arrival: Stamp::from_nanos(arrival),
            })
        }),
        stamp().prop_map(|t| Input::Packet(Stamp::from_nanos(t))),
        Just(Input::Motion),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn nonsense_neither_panics_nor_loses_an_exposure(
        inputs in proptest::collection::vec((stamp(), input()), 0..250),
    ) {
        let runs = [0, 1].map(|_| {
            let mut all = Host::new();
            for (arrival, input) in &inputs {
                all.take(Stamp::from_nanos(*arrival), input);
            }
            all.finish();
            all.assert_accounted();
            (all.said, all.decisions)
        });
        prop_assert!(runs[0] == runs[1], "the same inputs, different decisions");
    }
}

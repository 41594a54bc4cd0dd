//! Bundles under any interleaving: every exposure once, in order, never after its deadline, and
//! the same decisions for the same inputs.
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::unwrap_used,
    reason = "simulated instants are positive and small; a test may stop where it stands"
)]

use noctule::sync::{
    BundleCloser, BundleConfig, BundleDecision, ClosedBy, DiscardReason, Exposure, ExposureEvent,
    ExposureFlags, Stream, Streams,
};
use noctule_sensor::{ClockMap, Evk4, Realtime, Stamp, Tai};
use proptest::prelude::*;

const MS: i64 = 1_000_000;

/// What a closer can be told.
#[derive(Debug, Clone, Copy)]
enum Word {
    Exposure(ExposureEvent),
    EventsPassed(i64),
    Passed(Stream, i64),
    Lost(Stream, u64),
    Restarted(Stream),
    Arrival,
}

fn at<C: noctule_sensor::Clock>(ns: i64) -> Stamp<C> {
    Stamp::from_nanos(1_000_000_000_000).offset_nanos(ns)
}

fn map() -> ClockMap<Evk4, Tai> {
    ClockMap {
        uncertainty_ns: 700,
        ..ClockMap::exact(at(0), at(37_000 * MS))
    }
}

fn tai(ns: i64) -> Stamp<Tai> {
    at(37_000 * MS + ns)
}

fn exposure(id: u64) -> Exposure {
    let open = id as i64 * 200 * MS;
    Exposure {
        id,
        open: at(open),
        close: at(open + 100 * MS),
        image: None,
        flags: ExposureFlags::NONE,
    }
}

fn say(closer: &mut BundleCloser, word: Word, now: Stamp<Realtime>, out: &mut Vec<BundleDecision>) {
    let emit = &mut |d| out.push(d);
    match word {
        Word::Exposure(event) => closer.exposure(&event, Some(&map()), now, emit),
        Word::EventsPassed(t) => closer.events_passed(at(t), now, emit),
        Word::Passed(stream, t) => closer.passed(stream, tai(t), now, emit),
        Word::Lost(stream, count) => closer.lost(stream, count),
        Word::Restarted(stream) => closer.restarted(stream, now, emit),
        Word::Arrival => closer.arrival(now, emit),
    }
}

fn opened(id: u64) -> Word {
    let Exposure {
        open, close, flags, ..
    } = exposure(id);
    Word::Exposure(ExposureEvent::Opened {
        id,
        open,
        close_predicted: Some(close),
        flags,
    })
}

fn closed(id: u64) -> Word {
    Word::Exposure(ExposureEvent::Closed(exposure(id)))
}

fn imaged(id: u64) -> Word {
    let exposure = Exposure {
        image: Some(id + 500),
        ..exposure(id)
    };
    Word::Exposure(ExposureEvent::Imaged {
        exposure,
        pair: None,
    })
}

/// Runs words at their instants (nanoseconds) and gives the decisions.
fn run(words: &[(i64, Word)]) -> (Vec<BundleDecision>, BundleCloser) {
    let mut closer = BundleCloser::new(BundleConfig::default());
    let mut out = Vec::new();
    for &(now, word) in words {
        say(&mut closer, word, at(now), &mut out);
    }
    (out, closer)
}

#[test]
fn a_bundle_is_complete_with_the_last_word_it_needs() {
    let words = [
        (1, opened(0)),
        (101 * MS, closed(0)),
        (102 * MS, Word::Passed(Stream::Lidar, 100 * MS)),
        (103 * MS, Word::Passed(Stream::Motion, 105 * MS)),
        (110 * MS, imaged(0)),
        (111 * MS, Word::EventsPassed(99 * MS)),
        (112 * MS, Word::EventsPassed(100 * MS)),
    ];
    assert!(run(&words[..6]).0.is_empty());
    let (decisions, closer) = run(&words);
    let [decision] = decisions[..] else {
        panic!("{decisions:?}")
    };
    assert_eq!(decision.closed_by, ClosedBy::Complete);
    assert_eq!(decision.closed_at, at(112 * MS));
    assert_eq!(decision.exposure.image, Some(500));
    assert_eq!(decision.close_tai, Some(tai(100 * MS)));
    assert_eq!(
        (decision.uncertainty_ns, decision.missing),
        (700, Streams::NONE)
    );
    assert_eq!((closer.counts().complete, closer.pending_count()), (1, 0));
}

#[test]
fn a_silent_stream_costs_the_deadline_and_no_more() {
    let words = [
        (1, opened(0)),
        (100 * MS, closed(0)),
        (100 * MS, Word::EventsPassed(101 * MS)),
        (101 * MS, Word::Passed(Stream::Motion, 101 * MS)),
        (101 * MS, imaged(0)),
        (200 * MS, opened(1)),
        (250 * MS - 1, Word::Arrival),
        (250 * MS, Word::Arrival),
    ];
    assert!(run(&words[..7]).0.is_empty());
    let (decisions, closer) = run(&words);
    let [decision] = decisions[..] else {
        panic!("{decisions:?}")
    };
    assert_eq!(decision.closed_by, ClosedBy::Deadline);
    assert_eq!(decision.missing, Streams::NONE.with(Stream::Lidar));
    assert_eq!(closer.counts().by_deadline, 1);
}

#[test]
fn a_lost_image_does_not_hold_the_bundle_up() {
    let missing = Exposure {
        flags: ExposureFlags::IMAGE_MISSING,
        ..exposure(0)
    };
    let (decisions, _) = run(&[
        (1, opened(0)),
        (100 * MS, closed(0)),
        (100 * MS, Word::EventsPassed(101 * MS)),
        (101 * MS, Word::Passed(Stream::Motion, 101 * MS)),
        (102 * MS, Word::Passed(Stream::Lidar, 101 * MS)),
        (
            103 * MS,
            Word::Exposure(ExposureEvent::ImageMissing(missing)),
        ),
    ]);
    let [decision] = decisions[..] else {
        panic!("{decisions:?}")
    };
    assert_eq!(decision.closed_by, ClosedBy::NothingMissingCanCome);
    assert!(decision.is_partial() && decision.missing.contains(Stream::Images));
    assert_eq!(decision.closed_at, at(103 * MS));
}

#[test]
fn a_restarted_stream_is_not_waited_for_and_its_new_watermark_proves_nothing() {
    let (decisions, _) = run(&[
        (1, opened(0)),
        (100 * MS, closed(0)),
        (100 * MS, Word::EventsPassed(101 * MS)),
        (101 * MS, Word::Passed(Stream::Motion, 101 * MS)),
        (102 * MS, imaged(0)),
        (103 * MS, Word::Restarted(Stream::Lidar)),
    ]);
    let [decision] = decisions[..] else {
        panic!("{decisions:?}")
    };
    assert_eq!(decision.closed_by, ClosedBy::NothingMissingCanCome);
    assert_eq!(decision.restarted, Streams::NONE.with(Stream::Lidar));
    assert_eq!(decision.missing, Streams::NONE.with(Stream::Lidar));
}

#[test]
fn a_host_clock_set_back_by_an_hour_moves_the_deadline_with_it() {
    let hour = 3_600_000 * MS;
    let (decisions, closer) = run(&[
        (hour, opened(0)),
        (hour + 100 * MS, closed(0)),
        (0, Word::Arrival),
        (149 * MS, Word::Arrival),
        (150 * MS, Word::Arrival),
    ]);
    assert_eq!(decisions.len(), 1);
    assert_eq!(decisions[0].closed_at, at(150 * MS));
    assert_eq!(closer.counts().arrival_steps, 1);
}

#[test]
fn losses_are_charged_once_each() {
    let (decisions, _) = run(&[
        (0, Word::Lost(Stream::Lidar, 3)),
        (1, opened(0)),
        (2, Word::Lost(Stream::Lidar, 4)),
        (100 * MS, closed(0)),
        (102 * MS, Word::Passed(Stream::Lidar, 101 * MS)),
        (103 * MS, Word::Lost(Stream::Lidar, 50)),
        (200 * MS, opened(1)),
        (300 * MS, closed(1)),
        (900 * MS, Word::Arrival),
    ]);
    let lost: Vec<u64> = decisions
        .iter()
        .map(|d| d.lost[Stream::Lidar.index()])
        .collect();
    assert_eq!(lost, [7, 50]);
}

/// What happens to one exposure, in order.
fn life(id: u64) -> impl Strategy<Value = Vec<Word>> {
    let missing = Word::Exposure(ExposureEvent::ImageMissing(exposure(id)));
    let discarded = ExposureEvent::Discarded {
        id,
        reason: DiscardReason::Glitch,
    };
    prop_oneof![
        6 => Just(vec![opened(id), closed(id), imaged(id)]),
        2 => Just(vec![opened(id), closed(id), missing]),
        1 => Just(vec![opened(id), closed(id)]),
        1 => Just(vec![opened(id), Word::Exposure(discarded)]),
        1 => Just(vec![opened(id)]),
    ]
}

/// A stream's words: watermarks that mostly move on, but may jump, fall silent or restart.
fn stream_words(stream: Stream) -> impl Strategy<Value = Vec<Word>> {
    let passed = move |t: i64| match stream {
        Stream::Events => Word::EventsPassed(t),
        _ => Word::Passed(stream, t),
    };
    let step = prop_oneof![
        10 => (0_i64..400).prop_map(Some),
        1 => (-50_000_i64..50_000).prop_map(Some),
        1 => Just(None),
    ];
    (proptest::collection::vec((step, 0_u64..3), 0..25)).prop_map(move |steps| {
        let (mut t, mut words) = (0, Vec::new());
        for (step, lost) in steps {
            if lost > 0 {
                words.push(Word::Lost(stream, lost));
            }
            match step {
                Some(ms) => {
                    t += ms * MS;
                    words.push(passed(t));
                }
                None => words.push(Word::Restarted(stream)),
            }
        }
        words
    })
}

/// Several ordered streams merged in an arbitrary way, with arbitrary waits between the words.
fn interleaved() -> impl Strategy<Value = Vec<(i64, Word)>> {
    let exposures = (0_u64..14).prop_flat_map(|n| (0..n).map(life).collect::<Vec<_>>());
    let exposures = exposures.prop_map(|lives| lives.concat());
    let streams = (
        exposures,
        stream_words(Stream::Events),
        stream_words(Stream::Lidar),
        stream_words(Stream::Motion),
    );
    let order = proptest::collection::vec((0_usize..4, 0_i64..120), 150);
    (streams, order).prop_map(|((a, b, c, d), order)| {
        let mut streams = [a, b, c, d].map(Vec::into_iter);
        let (mut now, mut merged) = (0, Vec::new());
        for (pick, wait) in order {
            now += wait * MS;
            merged.push((now, streams[pick].next().unwrap_or(Word::Arrival)));
        }
        for stream in streams {
            merged.extend(stream.map(|word| (now, word)));
        }
        merged
    })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_interleaving_gives_each_exposure_once_in_order_and_in_time(words in interleaved()) {
        let config = BundleConfig::default();
        let mut closer = BundleCloser::new(config);
        let mut out: Vec<BundleDecision> = Vec::new();
        let mut opened_ids = Vec::new();
        let mut discarded = Vec::new();
        let mut lost = [0_u64; 4];
        for &(now, word) in &words {
            let before = out.len();
            say(&mut closer, word, at(now), &mut out);
            match word {
                Word::Exposure(ExposureEvent::Opened { id, .. }) => opened_ids.push(id),
                Word::Exposure(ExposureEvent::Discarded { id, .. })
                    if !out.iter().any(|d| d.exposure.id == id) => discarded.push(id),
                Word::Lost(stream, count) => lost[stream.index()] += count,
                _ => {}
            }
            // Nothing stays pending past its deadline once anything at all has arrived
            // (a loss alone carries no arrival stamp).
            if !matches!(word, Word::Lost(..)) {
                prop_assert!(closer.next_deadline().is_none_or(|d| d > at(now)));
            }
            for decision in &out[before..] {
                prop_assert_eq!(decision.closed_at, at(now));
                if decision.closed_by == ClosedBy::Complete {
                    prop_assert!(decision.missing.is_empty());
                    prop_assert!(decision.exposure.image.is_some());
                }
            }
        }
        closer.finish(&mut |d| out.push(d));
        let bundled: Vec<u64> = out.iter().map(|d| d.exposure.id).collect();
        let expected: Vec<u64> =
            opened_ids.iter().copied().filter(|id| !discarded.contains(id)).collect();
        prop_assert_eq!(bundled, expected);
        for (i, decision) in out.iter().enumerate() {
            prop_assert_eq!(decision.sequence, i as u64);
        }
        for stream in Stream::ALL {
            let charged: u64 = out.iter().map(|d| d.lost[stream.index()]).sum();
            prop_assert!(charged <= lost[stream.index()]);
        }
        prop_assert_eq!(closer.counts().lost, lost);
    }

    /// Watermarks of different streams that arrive at one instant may come in any order.
    #[test]
    fn the_order_of_streams_within_one_instant_does_not_change_what_is_bundled(
        words in interleaved(),
        swaps in proptest::collection::vec(0_usize..200, 30),
    ) {
        let is_watermark = |w: &Word| matches!(w, Word::EventsPassed(_) | Word::Passed(..));
        let mut other = words.clone();
        for i in swaps {
            if i + 1 < other.len() && other[i].0 == other[i + 1].0
                && is_watermark(&other[i].1) && is_watermark(&other[i + 1].1)
                && core::mem::discriminant(&other[i].1) != core::mem::discriminant(&other[i + 1].1)
            {
                other.swap(i, i + 1);
            }
        }
        prop_assert_eq!(run(&words).0, run(&other).0);
    }
}

//! What is encoded decodes to the same, in canonical order.

use noctule_evk4::{EncodeError, Evt3Decoder, Evt3Encoder, Geometry};
use noctule_sensor::{Event, Stamp, TriggerEdge};
use proptest::collection::vec;
use proptest::prelude::*;

use crate::model::{Item, Items};

/// A microsecond and what happens in it: events, an edge or none, events.
#[derive(Debug, Clone)]
pub struct Step {
    /// When.
    pub t_us: u64,
    before: Vec<(u16, u16, bool)>,
    edge: Option<(u8, bool)>,
    after: Vec<(u16, u16, bool)>,
}

/// Few rows and short runs of columns, so that vectors of every density come about.
fn pixels() -> impl Strategy<Value = Vec<(u16, u16, bool)>> {
    let run = (
        0_u16..2048,
        0_u16..2048,
        any::<bool>(),
        any::<u64>(),
        0_u32..3,
    );
    vec(run, 0..3).prop_map(|runs| {
        let expanded = runs.into_iter().flat_map(|(x, y, on, mask, thin)| {
            let mask = mask & mask.rotate_left(17 * thin);
            let set = (0..64_u16).filter(move |bit| mask >> bit & 1 == 1);
            set.map(move |bit| ((x + bit) % 2048, y, on))
        });
        expanded.collect()
    })
}

/// Steps of all sizes, up to past the 24-bit wrap.
pub fn timeline() -> impl Strategy<Value = Vec<Step>> {
    let gap_us = prop_oneof![
        4 => 1_u64..4,
        3 => 1_u64..40,
        2 => 1_u64..9000,
        1 => Just(4096),
        1 => 1_u64..20_000_000,
    ];
    let edge = prop_oneof![
        3 => Just(None),
        1 => (0_u8..16, any::<bool>()).prop_map(Some),
    ];
    let few = prop_oneof![3 => pixels(), 1 => Just(vec![])];
    vec((gap_us, few, edge, pixels()), 0..12).prop_map(|steps| {
        let mut t_us = 0;
        let step = |(gap_us, before, edge, after)| {
            t_us += gap_us;
            Step {
                t_us,
                before,
                edge,
                after,
            }
        };
        steps.into_iter().map(step).collect()
    })
}

fn events(t_us: u64, pixels: &[(u16, u16, bool)]) -> Vec<Event> {
    let event = |&(x, y, on)| Event {
        t: Stamp::from_micros(t_us),
        x,
        y,
        on,
    };
    pixels.iter().map(event).collect()
}

/// Encodes a timeline from the sensor's start.
pub fn encode(steps: &[Step]) -> Vec<u8> {
    let (mut encoder, mut bytes) = (Evt3Encoder::new(), Vec::new());
    for step in steps {
        let t = Stamp::from_micros(step.t_us);
        for event in events(step.t_us, &step.before) {
            encoder.event(event, &mut bytes).expect("in order");
        }
        if let Some((channel, rising)) = step.edge {
            let edge = TriggerEdge { t, channel, rising };
            encoder.trigger(edge, &mut bytes).expect("in order");
        }
        for event in events(step.t_us, &step.after) {
            encoder.event(event, &mut bytes).expect("in order");
        }
    }
    encoder.flush(&mut bytes);
    bytes
}

/// The canonical order of a timeline.
fn canonical(steps: &[Step]) -> Items {
    let mut items = Items::default();
    for step in steps {
        let (mut parts, edge) = (vec![step.before.clone()], step.edge);
        match edge {
            Some(_) => parts.push(step.after.clone()),
            None => parts[0].extend(&step.after),
        }
        for (i, mut part) in parts.into_iter().enumerate() {
            if let (1, Some((channel, rising))) = (i, edge) {
                let t = Stamp::from_micros(step.t_us);
                items.0.push(Item::Edge(TriggerEdge { t, channel, rising }));
            }
            part.sort_by_key(|&(x, y, on)| (y, on, x));
            let part = events(step.t_us, &part);
            items.0.extend(part.into_iter().map(Item::Event));
        }
    }
    items
}

const WHOLE: Geometry = Geometry {
    width: 2048,
    height: 2048,
};

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(200) })]

    #[test]
    fn decoding_what_was_encoded_gives_it_back(steps in timeline()) {
        let bytes = encode(&steps);
        let (mut decoder, mut items) = (Evt3Decoder::new(WHOLE), Items::default());
        decoder.decode(&bytes, &mut items);
        prop_assert_eq!(items, canonical(&steps));
        prop_assert!(decoder.errors().is_clean(), "{:?}", decoder.errors());
    }

    #[test]
    fn no_4096_us_go_by_without_time_high(steps in timeline()) {
        let bytes = encode(&steps);
        let highs = bytes.chunks_exact(2).filter(|word| word[1] >> 4 == 8);
        let highs = highs.map(|word| u16::from_le_bytes([word[0], word[1]]) & 0xfff);
        let mut last = 4095;
        for high in highs {
            prop_assert!(high == last || high == (last + 1) % 4096, "{last} then {high}");
            last = high;
        }
    }

    #[test]
    fn nothing_follows_that_is_older_than_the_watermark(steps in timeline()) {
        let bytes = encode(&steps);
        let mut decoder = Evt3Decoder::new(WHOLE);
        for word in bytes.chunks(2) {
            let (mark, mut items) = (decoder.watermark(), Items::default());
            decoder.decode(word, &mut items);
            for item in items.0 {
                let t = match item {
                    Item::Event(event) => event.t,
                    Item::Edge(edge) => edge.t,
                };
                prop_assert!(mark.is_none_or(|mark| mark <= t), "{mark:?} then {t}");
            }
        }
    }
}

#[test]
fn dense_rows_become_vectors_and_lone_pixels_do_not() {
    let (mut encoder, mut bytes) = (Evt3Encoder::new(), Vec::new());
    for x in 0..1280 {
        let t = Stamp::from_micros(5);
        let event = Event {
            t,
            x,
            y: 9,
            on: true,
        };
        encoder.event(event, &mut bytes).expect("in order");
    }
    encoder.flush(&mut bytes);
    // Two time words, one row, one base, and three words for each 32 pixels.
    assert_eq!(bytes.len(), 2 * (2 + 1 + 1 + 3 * 40));

    bytes.clear();
    let t = Stamp::from_micros(6);
    for x in [3, 200, 700] {
        let event = Event {
            t,
            x,
            y: 9,
            on: false,
        };
        encoder.event(event, &mut bytes).expect("in order");
    }
    encoder.flush(&mut bytes);
    assert_eq!(
        bytes.len(),
        2 * (1 + 3),
        "one time word, the same row, three pixels"
    );
}

#[test]
fn what_does_not_fit_is_refused_and_changes_nothing() {
    let (mut encoder, mut bytes) = (Evt3Encoder::new(), Vec::new());
    let event = |t_us, x, y| Event {
        t: Stamp::from_micros(t_us),
        x,
        y,
        on: true,
    };
    encoder.event(event(100, 1, 2), &mut bytes).expect("fits");
    let from = Stamp::from_micros(100);
    let to = |t_us| Stamp::from_micros(t_us);
    let hour_us = 3_600_000_000;
    for (refused, error) in [
        (event(100, 2048, 7), EncodeError::Address { x: 2048, y: 7 }),
        (event(100, 7, 2048), EncodeError::Address { x: 7, y: 2048 }),
        (event(99, 1, 1), EncodeError::Backwards { from, to: to(99) }),
        (
            event(101 + hour_us, 1, 1),
            EncodeError::Leap {
                from,
                to: to(101 + hour_us),
            },
        ),
    ] {
        assert_eq!(encoder.event(refused, &mut bytes), Err(error));
    }
    let edge = TriggerEdge {
        t: from,
        channel: 16,
        rising: true,
    };
    assert_eq!(
        encoder.trigger(edge, &mut bytes),
        Err(EncodeError::Channel(16))
    );
    encoder.flush(&mut bytes);
    let mut found = Vec::new();
    Evt3Decoder::new(WHOLE).decode(&bytes, &mut found);
    assert_eq!(found, [event(100, 1, 2)]);
}

#[test]
fn silence_is_written_so_that_hours_are_not_lost() {
    let (mut encoder, mut bytes) = (Evt3Encoder::new(), Vec::new());
    let three_hours_us = 3 * 3600 * 1_000_000_u64;
    for quarter in 1..=12 {
        let t = Stamp::from_micros(three_hours_us / 12 * quarter);
        encoder.advance(t, &mut bytes).expect("in order");
    }
    let mut decoder = Evt3Decoder::new(WHOLE);
    decoder.decode(&bytes, &mut Vec::new());
    let mark = decoder.watermark().expect("the time is known");
    assert_eq!(mark, Stamp::from_micros(three_hours_us - 16));
    assert!(decoder.errors().is_clean());
}

#[test]
fn a_recording_joined_midway_finds_its_loop_by_a_hint() {
    let start = Stamp::from_micros(37_000_000);
    let (mut encoder, mut bytes) = (Evt3Encoder::starting_at(start), Vec::new());
    let event = Event {
        t: Stamp::from_micros(37_000_500),
        x: 4,
        y: 5,
        on: false,
    };
    encoder.event(event, &mut bytes).expect("fits");
    encoder.flush(&mut bytes);
    for hint_us in [30_000_000, 37_000_000, 44_000_000] {
        let (mut decoder, mut found) = (Evt3Decoder::new(WHOLE), Vec::new());
        decoder.expect_near(Stamp::from_micros(hint_us));
        decoder.decode(&bytes, &mut found);
        assert_eq!(found, [event], "hint {hint_us}");
    }
}

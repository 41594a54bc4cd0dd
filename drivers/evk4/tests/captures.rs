//! Real recordings, decoded to the last bit, however they are cut into chunks.
//!
//! The recordings are third-party files outside the project, found through `NOCTULE_DATA`.

use std::fs;
use std::path::PathBuf;

use noctule_evk4::{Decoder, RawFile, RawHeader, Summary};
use noctule_sensor::{Event, TriggerEdge};
use serde_json::Value;

/// A summary that also keeps the trigger edges.
#[derive(Default)]
struct Found {
    summary: Summary,
    edges: Vec<TriggerEdge>,
}

impl noctule_evk4::EventSink for Found {
    fn event(&mut self, event: Event) {
        self.summary.event(event);
    }

    fn trigger(&mut self, edge: TriggerEdge) {
        self.summary.trigger(edge);
        self.edges.push(edge);
    }
}

fn events_dir() -> Option<PathBuf> {
    let Some(data) = std::env::var_os("NOCTULE_DATA") else {
        eprintln!("SKIPPED: NOCTULE_DATA is not set, so no real recording is decoded here;");
        eprintln!("the generated streams of tests/streams are all that holds the decoders");
        return None;
    };
    Some(PathBuf::from(data).join("events"))
}

/// Runs `check` on name, bytes and expected values of every recording.
fn for_each_capture(check: impl Fn(&str, &[u8], &Value)) {
    let Some(dir) = events_dir() else { return };
    let text = fs::read_to_string(dir.join("expected.json")).expect("expected.json is there");
    let expected: Value = serde_json::from_str(&text).expect("expected.json is JSON");
    let files = expected["files"].as_object().expect("a map of files");
    assert!(files.len() >= 10, "only {} recordings", files.len());
    for (name, expected) in files {
        let bytes = fs::read(dir.join(name)).expect("the recording is there");
        check(name, &bytes, expected);
    }
}

fn decode(header: &RawHeader, payload: &[u8], chunk_lens: &[usize]) -> (Decoder, Found) {
    let mut decoder = Decoder::new(header.format, header.geometry);
    let mut found = Found::default();
    let (mut rest, mut lens) = (payload, chunk_lens.iter().cycle());
    while !rest.is_empty() {
        let len = (*lens.next().expect("cycle")).min(rest.len());
        let (chunk, after) = rest.split_at(len);
        decoder.decode(chunk, &mut found);
        rest = after;
    }
    decoder.finish();
    (decoder, found)
}

fn check_events(name: &str, expected: &Value, summary: &Summary) {
    let found = [
        ("cd_events", summary.events),
        ("first_t_us", summary.first_us.expect("events")),
        ("last_t_us", summary.last_us.expect("events")),
        ("sum_x", summary.sum_x),
        ("sum_y", summary.sum_y),
        ("sum_t_mod_2p64", summary.sum_us),
        ("on", summary.on),
        ("cd_nonmonotonic", summary.nonmonotonic),
    ];
    for (key, value) in found {
        assert_eq!(Some(value), expected[key].as_u64(), "{name}: {key}");
    }
    let sha256 = &expected["events_sha256_t8x2y2p1_le"];
    assert_eq!(
        Some(summary.sha256_hex().as_str()),
        sha256.as_str(),
        "{name}"
    );
}

fn check_counts(name: &str, expected: &Value, decoder: &Decoder) {
    let (errors, words) = (decoder.errors(), decoder.words());
    assert_eq!(
        Some(words.words),
        expected["words"].as_u64(),
        "{name}: words"
    );
    assert_eq!(words.accounted(errors), words.words, "{name}: conservation");
    assert_eq!(
        Some(errors.out_of_bounds),
        expected["oob"].as_u64(),
        "{name}"
    );
    for (key, found) in [
        (
            "words_before_first_time_high",
            errors.before_first_time_high,
        ),
        ("time_backward_steps", errors.time_backwards),
    ] {
        // EVT 2.1 entries leave these out; nothing is wrong with those files.
        assert_eq!(found, expected[key].as_u64().unwrap_or(0), "{name}: {key}");
    }
    // 3000 words of types 1, 9, B, C and D were put into this one, and an odd byte at its end.
    let padded = name == "derived_padding.raw";
    assert_eq!(errors.reserved_word, u64::from(padded) * 3000, "{name}");
    assert_eq!(errors.trailing_bytes, u64::from(padded), "{name}");
    assert_eq!(
        (errors.missing_y, errors.missing_vect_base),
        (0, 0),
        "{name}"
    );
}

fn check_triggers(name: &str, expected: &Value, found: &Found) {
    let expected = &expected["triggers"];
    let (mut count, mut rising, mut sum_us) = (0, 0, 0_u64);
    for (channel, summary) in found.summary.triggers() {
        let of_channel = summary.rising + summary.falling;
        let key = channel.to_string();
        assert_eq!(
            Some(of_channel),
            expected["channels"][&key].as_u64(),
            "{name}"
        );
        count += of_channel;
        rising += summary.rising;
        sum_us = sum_us.wrapping_add(summary.sum_us);
    }
    assert_eq!(Some(count), expected["count"].as_u64(), "{name}: triggers");
    if count == 0 {
        return;
    }
    assert_eq!(Some(rising), expected["rising"].as_u64(), "{name}: rising");
    assert_eq!(
        Some(count - rising),
        expected["falling"].as_u64(),
        "{name}: falling"
    );
    assert_eq!(
        Some(sum_us),
        expected["sum_t"].as_u64(),
        "{name}: sum of edges"
    );
    let edge = |e: &TriggerEdge| [e.t.as_micros(), e.channel.into(), e.rising.into()];
    let first = expected["first"].as_array().expect("first edges");
    let last = expected["last"].as_array().expect("last edges");
    for (value, found) in first.iter().zip(&found.edges) {
        assert_eq!(
            value,
            &Value::from(edge(found).to_vec()),
            "{name}: first edges"
        );
    }
    for (value, found) in last.iter().rev().zip(found.edges.iter().rev()) {
        assert_eq!(
            value,
            &Value::from(edge(found).to_vec()),
            "{name}: last edges"
        );
    }
}

#[test]
fn headers_give_encoding_size_and_every_line() {
    for_each_capture(|name, bytes, expected| {
        let (header, payload) = RawHeader::parse(bytes).expect("a header");
        let lines: Vec<_> = expected["header"]
            .as_array()
            .expect("lines")
            .iter()
            .collect();
        let lines: Vec<_> = lines.iter().filter_map(|v| v.as_str()).collect();
        let lines_len: usize = lines.iter().map(|line| line.len() + 1).sum();
        assert_eq!(payload, lines_len, "{name}: payload offset");
        let fields: Vec<_> = header
            .fields
            .iter()
            .map(|(k, v)| format!("% {k} {v}"))
            .collect();
        let lines: Vec<_> = lines.into_iter().filter(|line| *line != "% end").collect();
        assert_eq!(fields, lines, "{name}: fields");
        assert_eq!(
            Some(u64::from(header.geometry.width)),
            expected["width"].as_u64()
        );
        assert_eq!(
            Some(u64::from(header.geometry.height)),
            expected["height"].as_u64()
        );
    });
}

#[test]
fn every_recording_decodes_exactly_in_any_chunking() {
    for_each_capture(|name, bytes, expected| {
        let (header, payload) = RawHeader::parse(bytes).expect("a header");
        for lens in [
            &[usize::MAX][..],
            &[1],
            &[2, 3, 5, 7, 11, 13],
            &[4099, 1, 131_071],
        ] {
            let (decoder, found) = decode(&header, &bytes[payload..], lens);
            check_events(name, expected, &found.summary);
            check_counts(name, expected, &decoder);
            check_triggers(name, expected, &found);
        }
    });
}

#[test]
fn a_file_read_in_chunks_is_the_file_read_whole() {
    for_each_capture(|name, bytes, expected| {
        let mut summary = Summary::new();
        let file = RawFile::from_reader(bytes, None).expect("a header");
        let decoder = file.decode_all(&mut summary).expect("memory can be read");
        check_events(name, expected, &summary);
        check_counts(name, expected, &decoder);
    });
}

#[test]
fn rate_controller_reports_add_up_to_the_events_of_the_recording() {
    for_each_capture(|name, bytes, _| {
        let (header, payload) = RawHeader::parse(bytes).expect("a header");
        let (decoder, found) = decode(&header, &bytes[payload..], &[7]);
        let rate = decoder.rate();
        if name == "hd720_trigger2.raw" {
            // Reports are per period; nine events came after the last one.
            assert_eq!((rate.entered, rate.left), (82_460, 82_460), "{name}");
            assert_eq!(found.summary.events - rate.left, 9, "{name}");
            assert_eq!(rate.dropped(), 0, "{name}");
        }
    });
}

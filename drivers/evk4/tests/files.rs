//! RAW files made here, read back in chunks and summed up.

use std::io::{self, Read};

use noctule_evk4::{
    EventSink, Evt3Encoder, Format, Geometry, OpenError, RawError, RawFile, RawHeader, Summary,
};
use noctule_sensor::{Event, Stamp, TriggerEdge};
use sha2::{Digest, Sha256};

const GEOMETRY: Geometry = Geometry {
    width: 1280,
    height: 720,
};

/// Hands out a few bytes at a time, and is interrupted in between, as a pipe may be.
struct Trickle<'a> {
    bytes: &'a [u8],
    calls: usize,
}

impl Read for Trickle<'_> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        self.calls += 1;
        if self.calls.is_multiple_of(3) {
            return Err(io::ErrorKind::Interrupted.into());
        }
        let len = out.len().min(1 + self.calls * 7 % 5003);
        self.bytes.read(&mut out[..len])
    }
}

/// A recording of more than one chunk, in canonical order, and its events.
fn recording() -> (Vec<u8>, Vec<Event>) {
    let (mut encoder, mut events) = (Evt3Encoder::new(), Vec::new());
    let mut bytes = RawHeader::new(Format::Evt3, GEOMETRY).to_bytes();
    for t_us in 0..100_000 {
        let event = Event {
            t: Stamp::from_micros(t_us * 200),
            x: u16::try_from(t_us * 31 % 1280).expect("small"),
            y: u16::try_from(t_us * 17 % 720).expect("small"),
            on: t_us % 5 < 2,
        };
        encoder.event(event, &mut bytes).expect("in order");
        events.push(event);
    }
    encoder.flush(&mut bytes);
    (bytes, events)
}

#[test]
fn a_file_is_read_whole_however_it_trickles_in() {
    let (bytes, expected) = recording();
    let reader = Trickle {
        bytes: &bytes,
        calls: 0,
    };
    let file = RawFile::from_reader(reader, None).expect("a header");
    assert_eq!(file.header().geometry, GEOMETRY);
    let mut events: Vec<Event> = Vec::new();
    let decoder = file.decode_all(&mut events).expect("readable");
    assert!(decoder.errors().is_clean());
    assert!(events == expected, "{} of {}", events.len(), expected.len());
}

#[test]
fn chunks_end_with_an_empty_one_and_stay_empty() {
    let (bytes, _) = recording();
    let mut file = RawFile::from_reader(&bytes[..], None).expect("a header");
    let mut payload = Vec::new();
    loop {
        let chunk = file.next_chunk().expect("readable");
        if chunk.is_empty() {
            break;
        }
        payload.extend_from_slice(chunk);
    }
    assert!(bytes.ends_with(&payload));
    assert_eq!(payload.len() + file.header().to_bytes().len(), bytes.len());
    assert!(file.next_chunk().expect("readable").is_empty());
}

#[test]
fn what_cannot_be_opened_says_why() {
    let missing = RawFile::open("no/such/file.raw".as_ref(), None).expect_err("missing");
    assert!(matches!(missing, OpenError::Io(_)), "{missing}");
    let text = RawFile::from_reader(&b"not a raw file"[..], None).expect_err("no header");
    assert!(
        matches!(text, OpenError::Header(RawError::NoHeader(_))),
        "{text}"
    );
}

#[test]
fn a_summary_sums_and_digests_what_it_is_given() {
    let (_, events) = recording();
    let (mut summary, mut records) = (Summary::new(), Vec::new());
    for &event in &events[..1000] {
        summary.event(event);
        records.extend_from_slice(&event.t.as_micros().to_le_bytes());
        records.extend_from_slice(&event.x.to_le_bytes());
        records.extend_from_slice(&event.y.to_le_bytes());
        records.push(u8::from(event.on));
    }
    assert_eq!(summary.sha256(), <[u8; 32]>::from(Sha256::digest(&records)));
    assert_eq!(
        (summary.events, summary.on, summary.off()),
        (1000, 400, 600)
    );
    assert_eq!(
        (summary.first_us, summary.last_us),
        (Some(0), Some(999 * 200))
    );
    assert_eq!(summary.sum_us, 999 * 1000 / 2 * 200);
    for (t_us, channel, rising) in [(5, 0, true), (9, 0, false), (11, 6, true)] {
        let t = Stamp::from_micros(t_us);
        summary.trigger(TriggerEdge { t, channel, rising });
    }
    let found: Vec<_> = summary.triggers().map(|(c, s)| (c, *s)).collect();
    assert_eq!((found[0].0, found[1].0, found.len()), (0, 6, 2));
    let main = found[0].1;
    assert_eq!((main.rising, main.falling), (1, 1));
    assert_eq!((main.first_us, main.last_us, main.sum_us), (5, 9, 14));
}

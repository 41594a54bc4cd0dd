//! Races the EVT 3.0 decoder against the `neuromorphic-drivers` crate's adapter.
//!
//! One thread, one process, rounds interleaved; both feed the same consumers, and what must be
//! equal is compared: counts and sums of column, row and polarity. Times differ by design: the
//! adapter clamps them to monotone, which stamps events late after a sensor's step back.
#![allow(clippy::print_stdout, reason = "a report is what this program is for")]

use std::error::Error;
use std::hint::black_box;
use std::path::Path;
use std::time::Instant;

use neuromorphic_drivers::adapters::evt3::Adapter;
use noctule_evk4::{EventSink, Evt3Decoder, Evt3Encoder, Format, Geometry, RawHeader};
use noctule_sensor::{Event, Evk4, Stamp};

/// Bytes handed over at once: one USB transfer.
const TRANSFER_LEN: usize = 128 * 1024;
/// Bytes of each stream, at least: little enough that most rounds end within a time slice, so
/// that on a busy machine the median is still that of undisturbed rounds.
const STREAM_LEN: usize = 1 << 20;
/// Rounds; the median counts.
const ROUNDS: usize = 101;
const HD: Geometry = Geometry {
    width: 1280,
    height: 720,
};

/// What both decoders feed; times in each decoder's own unit.
trait Consumer: Default {
    const NAME: &'static str;
    fn take(&mut self, t: u64, x: u16, y: u16, on: bool);
    /// What must not depend on the decoder.
    fn result(&self) -> [u64; 4];
}

/// Folds every member of every event.
#[derive(Default)]
struct Fold {
    events: u64,
    t: u64,
    x: u64,
    y: u64,
    on: u64,
}

impl Consumer for Fold {
    const NAME: &'static str = "fold t, x, y, p";

    #[inline(always)]
    fn take(&mut self, t: u64, x: u16, y: u16, on: bool) {
        self.events += 1;
        self.t = self.t.wrapping_add(t);
        self.x = self.x.wrapping_add(u64::from(x));
        self.y = self.y.wrapping_add(u64::from(y));
        self.on = self.on.wrapping_add(u64::from(on));
    }

    fn result(&self) -> [u64; 4] {
        black_box(self.t);
        [self.events, self.x, self.y, self.on]
    }
}

/// Counts events only.
#[derive(Default)]
struct Count(u64);

impl Consumer for Count {
    const NAME: &'static str = "count";

    #[inline(always)]
    fn take(&mut self, _: u64, _: u16, _: u16, _: bool) {
        self.0 += 1;
    }

    fn result(&self) -> [u64; 4] {
        [self.0, 0, 0, 0]
    }
}

/// Keeps the time and polarity of the last event of every pixel: a scattered write per event.
struct Surface {
    last: Vec<u64>,
    events: u64,
}

impl Default for Surface {
    fn default() -> Self {
        Self {
            // Not zero, so that the pages are there before the clock starts.
            last: vec![2; 2048 * 1024],
            events: 0,
        }
    }
}

impl Consumer for Surface {
    const NAME: &'static str = "time surface";

    #[inline(always)]
    fn take(&mut self, t: u64, x: u16, y: u16, on: bool) {
        self.last[(usize::from(y) << 11 | usize::from(x)) & (2048 * 1024 - 1)] =
            t << 1 | u64::from(on);
        self.events += 1;
    }

    fn result(&self) -> [u64; 4] {
        let on = self.last.iter().filter(|last| **last & 1 != 0).count();
        let seen = self.last.iter().filter(|last| **last != 2).count();
        [self.events, on as u64, seen as u64, 0]
    }
}

/// A consumer as the decoder's sink.
struct Consuming<C>(C);

impl<C: Consumer> EventSink for Consuming<C> {
    #[inline(always)]
    fn event(&mut self, event: Event) {
        self.0.take(event.t.as_nanos(), event.x, event.y, event.on);
    }
}

fn run_noctule<C: Consumer>(stream: &Stream, consumer: C) -> C {
    let mut decoder = Evt3Decoder::new(stream.geometry);
    let mut sink = Consuming(consumer);
    for transfer in stream.bytes.chunks(TRANSFER_LEN) {
        decoder.decode(transfer, &mut sink);
    }
    assert_eq!(
        decoder.words().accounted(decoder.errors()),
        decoder.words().words
    );
    sink.0
}

fn run_adapter<C: Consumer>(stream: &Stream, mut consumer: C) -> C {
    let Geometry { width, height } = stream.geometry;
    let mut adapter = Adapter::from_dimensions(width, height);
    for transfer in stream.bytes.chunks(TRANSFER_LEN) {
        adapter.convert(
            transfer,
            |event| consumer.take(event.t, event.x, event.y, event.polarity as u8 != 0),
            |trigger| {
                black_box(trigger.t);
            },
        );
    }
    consumer
}

/// EVT 3.0 words and what they are.
struct Stream {
    name: String,
    geometry: Geometry,
    bytes: Vec<u8>,
}

fn race<C: Consumer>(stream: &Stream) {
    let (mut ours, mut theirs, mut ratios) = (Vec::new(), Vec::new(), Vec::new());
    let mut events = 0;
    for _ in 0..ROUNDS {
        let (consumer, started) = (C::default(), Instant::now());
        let our = run_noctule(stream, black_box(consumer));
        let our_s = started.elapsed().as_secs_f64();
        let (consumer, started) = (C::default(), Instant::now());
        let their = run_adapter(stream, black_box(consumer));
        let their_s = started.elapsed().as_secs_f64();
        assert_eq!(our.result(), their.result(), "{}", stream.name);
        events = our.result()[0];
        ours.push(our_s);
        theirs.push(their_s);
        ratios.push(their_s / our_s);
    }
    let rate = |seconds: f64| events as f64 / seconds / 1e6;
    println!(
        "{:<42} {:<16} {:>8.1} {:>8.1} {:>7.2}",
        stream.name,
        C::NAME,
        rate(median(&mut ours)),
        rate(median(&mut theirs)),
        median(&mut ratios),
    );
}

/// How fast the stream's own events are encoded; no other encoder races.
fn encode(stream: &Stream) -> Result<(), Box<dyn Error>> {
    let mut events: Vec<Event> = Vec::new();
    Evt3Decoder::new(stream.geometry).decode(&stream.bytes, &mut events);
    let (mut bytes, mut seconds) = (Vec::new(), Vec::new());
    for _ in 0..ROUNDS {
        let started = Instant::now();
        bytes.clear();
        let mut encoder = Evt3Encoder::starting_at(events[0].t);
        for &event in &events {
            encoder.event(event, &mut bytes)?;
        }
        encoder.flush(&mut bytes);
        seconds.push(started.elapsed().as_secs_f64());
        black_box(&bytes);
    }
    println!(
        "{:<42} {:<16} {:>8.1}",
        stream.name,
        "encode",
        events.len() as f64 / median(&mut seconds) / 1e6,
    );
    Ok(())
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    values[values.len() / 2]
}

/// `words` again and again, each time later, so that time goes on through the whole stream.
fn tile(words: &[u8], high_per_tile: u16) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(STREAM_LEN + words.len());
    let mut shift = 0_u16;
    while bytes.len() < STREAM_LEN {
        for word in words.as_chunks::<2>().0 {
            let word = u16::from_le_bytes(*word);
            let word = match word >> 12 {
                0x8 => 0x8000 | word.wrapping_add(shift) & 0xfff,
                _ => word,
            };
            bytes.extend_from_slice(&word.to_le_bytes());
        }
        shift = shift.wrapping_add(high_per_tile);
    }
    bytes
}

fn capture(dir: &Path, name: &str, high_per_tile: u16) -> Result<Stream, Box<dyn Error>> {
    let bytes = std::fs::read(dir.join(name))?;
    let (header, payload) = RawHeader::parse(&bytes)?;
    assert_eq!(header.format, Format::Evt3);
    Ok(Stream {
        name: format!("{name}, tiled"),
        geometry: header.geometry,
        bytes: tile(&bytes[payload..], high_per_tile),
    })
}

/// A recording of another encoding, written as EVT 3.0.
fn recoded(dir: &Path, name: &str) -> Result<Stream, Box<dyn Error>> {
    let mut events: Vec<Event> = Vec::new();
    let file = noctule_evk4::RawFile::open(&dir.join(name), None)?;
    let geometry = file.header().geometry;
    file.decode_all(&mut events)?;
    let (first, last) = (events[0].t, events[events.len() - 1].t);
    let span_us = last.as_micros() - first.as_micros() + 1;
    let (mut encoder, mut bytes) = (Evt3Encoder::starting_at(first), Vec::new());
    let mut shift_us = 0;
    while bytes.len() < STREAM_LEN {
        for event in &events {
            let t = Stamp::from_micros(event.t.as_micros() + shift_us);
            encoder.event(Event { t, ..*event }, &mut bytes)?;
        }
        shift_us += span_us;
    }
    encoder.flush(&mut bytes);
    Ok(Stream {
        name: format!("{name}, as evt3"),
        geometry,
        bytes,
    })
}

/// A small generator of reproducible numbers (xorshift, 64 bits).
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    fn below(&mut self, end: u16) -> u16 {
        u16::try_from(self.next() >> 48).unwrap_or(0) % end
    }
}

/// Rows of dense runs, as from edges and flicker: `in_16` of 16 pixels of a run fire at once.
fn generated(name: &str, in_16: u16, run_len: u16) -> Result<Stream, Box<dyn Error>> {
    let (mut random, mut encoder) = (Random(0x9e37_79b9_7f4a_7c15), Evt3Encoder::new());
    let (mut bytes, mut t_us) = (Vec::new(), 0);
    while bytes.len() < STREAM_LEN {
        t_us += u64::from(random.below(8));
        let t: Stamp<Evk4> = Stamp::from_micros(t_us);
        let (x, y) = (random.below(HD.width), random.below(HD.height));
        let on = random.next() >> 63 != 0;
        let run = random.below(run_len) + 1;
        for x in x..(x + run).min(HD.width) {
            if random.below(16) < in_16 {
                encoder.event(Event { t, x, y, on }, &mut bytes)?;
            }
        }
    }
    encoder.flush(&mut bytes);
    Ok(Stream {
        name: name.to_owned(),
        geometry: HD,
        bytes,
    })
}

fn streams() -> Result<Vec<Stream>, Box<dyn Error>> {
    let mut streams = vec![
        generated("generated, vectors 3/4 full", 12, 300)?,
        generated("generated, vectors 1/4 full", 4, 300)?,
        generated("generated, singles", 16, 1)?,
    ];
    if let Some(data) = std::env::var_os("NOCTULE_DATA") {
        let dir = Path::new(&data).join("events");
        streams.push(capture(&dir, "gen41_hd_vect.raw", 3)?);
        streams.push(capture(&dir, "hd720_trigger2.raw", 308)?);
        streams.push(capture(&dir, "vga_trigger_loop_a.raw", 324)?);
        streams.push(recoded(&dir, "gen31_evt2.raw")?);
    } else {
        eprintln!("NOCTULE_DATA is not set: generated streams only");
    }
    Ok(streams)
}

fn main() -> Result<(), Box<dyn Error>> {
    println!(
        "{:<42} {:<16} {:>8} {:>8} {:>7}",
        "million events per second, median", "consumer", "noctule", "adapter", "ratio"
    );
    for stream in streams()? {
        race::<Fold>(&stream);
        race::<Count>(&stream);
        race::<Surface>(&stream);
        encode(&stream)?;
    }
    Ok(())
}

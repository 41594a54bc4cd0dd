//! Events and trigger edges to EVT 3.0, the way the sensor writes it.
//!
//! Made for synthetic recordings and for tests. It does not imitate a sensor's faults: no step
//! back in time, no rate-controller reports, no padding.

use core::fmt;

use noctule_sensor::{Event, Evk4, Stamp, TriggerEdge};

use super::word::{
    ADDR_X, ADDR_Y, ADDRESS_MASK, EXT_TRIGGER, GROUP_PIXELS, HIGH_BITS, PAYLOAD_MASK, TIME_HIGH,
    TIME_LOW, VECT_8, VECT_12, VECT_BASE_X, make,
};

/// `TIME_HIGH` is repeated when this much time has gone by since the last one, microseconds.
const REPEAT_US: u64 = 16;
/// Longest silence that is written out, microseconds: an hour, 1.8 MB of `TIME_HIGH` words.
const LEAP_US_MAX: u64 = 3_600_000_000;
/// No row or no base column in force.
const NONE: u32 = u32::MAX;

/// Why something could not be encoded; the encoder is as it was before.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EncodeError {
    /// A row or column that does not fit the word's 11 bits.
    Address {
        /// Column.
        x: u16,
        /// Row.
        y: u16,
    },
    /// A trigger input that does not fit the word's 4 bits.
    Channel(u8),
    /// An instant before what was encoded already.
    Backwards {
        /// The latest instant so far.
        from: Stamp<Evk4>,
        /// The one refused.
        to: Stamp<Evk4>,
    },
    /// A silence of more than an hour.
    Leap {
        /// The latest instant so far.
        from: Stamp<Evk4>,
        /// The one refused.
        to: Stamp<Evk4>,
    },
}

impl fmt::Display for EncodeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Address { x, y } => write!(f, "pixel ({x}, {y}) does not fit 11 + 11 bits"),
            Self::Channel(channel) => write!(f, "trigger channel {channel} does not fit 4 bits"),
            Self::Backwards { from, to } => write!(f, "time goes back from {from} to {to}"),
            Self::Leap { from, to } => {
                write!(f, "silence of more than an hour from {from} to {to}")
            }
        }
    }
}

impl core::error::Error for EncodeError {}

/// Encodes a time-ordered sequence into EVT 3.0 words.
///
/// Decoding gives back the same sequence, in canonical order: by time, and among the events of
/// one microsecond between two triggers by row, then off before on, then column. Stamps are cut
/// to whole microseconds. Triggers keep their place among the events of their microsecond.
///
/// `TIME_HIGH` is written for every 4096 us that go by, eventful or not, and repeated every 16 us
/// in which something is written; row and base column are repeated after it, so a reader that
/// joins there lacks nothing. The counter starts at zero, as the sensor's does: a first event at
/// 1 s is preceded by 1 s of silence.
///
/// Events of a microsecond are gathered before they are written, hence [`flush`](Self::flush)
/// at the end. After the first few calls nothing is allocated but the output's own growth.
#[derive(Debug, Clone)]
pub struct Evt3Encoder {
    /// Instant of the gathered events; nothing earlier is taken.
    now_us: u64,
    /// `y << 12 | on << 11 | x` of the gathered events, so that order of value is canonical.
    pending: Vec<u32>,
    /// `TIME_HIGH`, widened, that is written next.
    high_next: u64,
    /// When `TIME_HIGH` was last written.
    high_at_us: u64,
    /// Time last written, as the decoder has it.
    written_us: u64,
    /// Row in force, or `NONE`.
    row: u32,
    /// `on << 16 | base` in force, or `NONE`.
    base: u32,
}

impl Default for Evt3Encoder {
    fn default() -> Self {
        Self::new()
    }
}

impl Evt3Encoder {
    /// An encoder whose counter is at zero.
    #[must_use]
    pub fn new() -> Self {
        Self::starting_at(Stamp::ZERO)
    }

    /// An encoder that joins in at `t`, as a recording started while the sensor was running.
    ///
    /// The wire carries 24 bits of microseconds: a decoder needs
    /// [`expect_near`](super::Evt3Decoder::expect_near) to find times of 16.78 s and more.
    #[must_use]
    pub fn starting_at(t: Stamp<Evk4>) -> Self {
        let now_us = t.as_micros();
        let high_next = now_us >> HIGH_BITS;
        Self {
            now_us,
            pending: Vec::new(),
            high_next,
            high_at_us: 0,
            written_us: 0,
            row: NONE,
            base: NONE,
        }
    }

    /// Takes the next event; words of earlier instants are appended to `out`.
    ///
    /// # Errors
    /// When the pixel does not fit the format, or time goes back or leaps.
    #[inline]
    pub fn event(&mut self, event: Event, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        let Event { t, x, y, on } = event;
        if (x | y) > ADDRESS_MASK {
            return Err(EncodeError::Address { x, y });
        }
        self.go_to(t, out)?;
        self.pending
            .push(u32::from(y) << 12 | u32::from(on) << 11 | u32::from(x));
        Ok(())
    }

    /// Takes the next trigger edge; it and everything before it is appended to `out`.
    ///
    /// # Errors
    /// When the channel does not fit the format, or time goes back or leaps.
    pub fn trigger(&mut self, edge: TriggerEdge, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        if edge.channel > 0xf {
            return Err(EncodeError::Channel(edge.channel));
        }
        self.go_to(edge.t, out)?;
        self.flush(out);
        self.write_time(out);
        let payload = u16::from(edge.channel) << 8 | u16::from(edge.rising);
        push(out, make(EXT_TRIGGER, payload));
        Ok(())
    }

    /// Lets time go on to `t` without an event, so that a decoder knows of it.
    ///
    /// # Errors
    /// When time goes back or leaps.
    pub fn advance(&mut self, t: Stamp<Evk4>, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        if t.as_micros() == self.now_us && !self.pending.is_empty() {
            return Ok(());
        }
        self.go_to(t, out)?;
        self.write_time(out);
        Ok(())
    }

    /// Appends what is gathered to `out`; events of the same microsecond may still follow, but
    /// are no longer sorted among those written.
    pub fn flush(&mut self, out: &mut Vec<u8>) {
        if self.pending.is_empty() {
            return;
        }
        self.write_time(out);
        let mut pending = core::mem::take(&mut self.pending);
        if !pending.is_sorted() {
            pending.sort_unstable();
        }
        let mut rest = pending.as_slice();
        while let [first, ..] = rest {
            let (run, after) = rest.split_at(run_len(rest));
            self.write_row(first >> 12, out);
            self.write_run(run, out);
            rest = after;
        }
        pending.clear();
        self.pending = pending;
    }

    /// Makes `t` the instant in hand, writing out the one before.
    #[inline]
    fn go_to(&mut self, t: Stamp<Evk4>, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        let to_us = t.as_micros();
        if to_us == self.now_us {
            return Ok(());
        }
        let from = Stamp::from_micros(self.now_us);
        if to_us < self.now_us {
            return Err(EncodeError::Backwards { from, to: t });
        }
        if to_us - self.now_us > LEAP_US_MAX {
            return Err(EncodeError::Leap { from, to: t });
        }
        self.flush(out);
        self.now_us = to_us;
        Ok(())
    }

    /// Writes the time words that bring a decoder to the instant in hand.
    fn write_time(&mut self, out: &mut Vec<u8>) {
        let high = self.now_us >> HIGH_BITS;
        if high >= self.high_next {
            for high in self.high_next..=high {
                push(out, make(TIME_HIGH, low_12(high)));
            }
            self.high_next = high + 1;
            push(out, make(TIME_LOW, low_12(self.now_us)));
        } else if self.now_us == self.written_us {
            return;
        } else if self.now_us - self.high_at_us >= REPEAT_US {
            push(out, make(TIME_HIGH, low_12(high)));
            push(out, make(TIME_LOW, low_12(self.now_us)));
        } else {
            push(out, make(TIME_LOW, low_12(self.now_us)));
            self.written_us = self.now_us;
            return;
        }
        self.high_at_us = self.now_us;
        self.written_us = self.now_us;
        self.row = NONE;
        self.base = NONE;
    }

    #[inline]
    fn write_row(&mut self, row: u32, out: &mut Vec<u8>) {
        if row != self.row {
            self.row = row;
            self.base = NONE;
            push(out, make(ADDR_Y, low_16(row)));
        }
    }

    /// Writes events of one row, polarity and aligned 32-pixel block: as a vector group where
    /// that takes no more words than one for each event.
    #[inline]
    fn write_run(&mut self, run: &[u32], out: &mut Vec<u8>) {
        let block = u32::from(GROUP_PIXELS) - 1;
        let base = (run[0] & 0x7ff & !block) | (run[0] >> 11 & 1) << 16;
        let running = base == self.base;
        if run.len() < if running { 3 } else { 4 } {
            // Some decoders keep one column for both kinds of word.
            self.base = NONE;
            for &pixel in run {
                push(out, make(ADDR_X, low_16(pixel & 0xfff)));
            }
            return;
        }
        if !running {
            push(out, make(VECT_BASE_X, low_16(run[0] & 0xfff & !block)));
        }
        let mask = run.iter().fold(0_u32, |mask, x| mask | 1 << (x & block));
        let group = [
            make(VECT_12, low_16(mask & 0xfff)),
            make(VECT_12, low_16(mask >> 12 & 0xfff)),
            make(VECT_8, low_16(mask >> 24)),
        ];
        let [[a, b], [c, d], [e, f]] = group.map(u16::to_le_bytes);
        out.extend_from_slice(&[a, b, c, d, e, f]);
        self.base = base + u32::from(GROUP_PIXELS);
    }
}

/// How many of the first of `sorted` share row, polarity and block, each pixel once.
#[inline]
fn run_len(sorted: &[u32]) -> usize {
    let mut len = 1;
    while len < sorted.len()
        && sorted[len] >> 5 == sorted[len - 1] >> 5
        && sorted[len] != sorted[len - 1]
    {
        len += 1;
    }
    len
}

#[inline]
fn push(out: &mut Vec<u8>, word: u16) {
    out.extend_from_slice(&word.to_le_bytes());
}

#[inline]
const fn low_12(value: u64) -> u16 {
    let [low, high, ..] = value.to_le_bytes();
    u16::from_le_bytes([low, high]) & PAYLOAD_MASK
}

#[inline]
const fn low_16(value: u32) -> u16 {
    let [low, high, ..] = value.to_le_bytes();
    u16::from_le_bytes([low, high])
}

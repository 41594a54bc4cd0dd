//! EVT 3.0: 16-bit words whose meaning depends on what came before.
//!
//! Words are taken one by one and no group is assumed complete, so a lost word costs itself and
//! nothing more. Two things are deliberately not done: times are not clamped to monotone (a
//! `TIME_LOW` may step back by some microseconds with no event in between), and times are not
//! shifted to start at zero.

use noctule_sensor::{Event, Evk4, Stamp, TriggerEdge};

use super::rate::{Payload, RateCounts};
use super::time_high::{Step, TimeHigh};
use super::word::{
    ADDR_X, ADDR_Y, ADDRESS_MASK, CONTINUED_4, CONTINUED_12, EXT_TRIGGER, HIGH_BITS, HIGH_UNIT_US,
    ON_BIT, OTHERS, PAYLOAD_MASK, TIME_HIGH, TIME_LOW, VECT_8, VECT_12, VECT_BASE_X, kind,
};
use super::{ErrorCounts, EventSink, Geometry, WordTally};

/// Largest step back of `TIME_LOW` that [`Evt3Decoder::watermark`] allows for, microseconds.
///
/// HD sensors step back by up to 11 us, once a millisecond.
const STEP_BACK_US_MAX: u64 = 16;
/// Nanoseconds per step of `TIME_HIGH`.
const HIGH_NS: u64 = HIGH_UNIT_US * 1000;
/// No row address seen; outside every sensor.
const NO_ROW: u16 = u16::MAX;
/// No base column seen; outside every sensor.
const NO_BASE: u16 = u16::MAX;
/// Where a base column stops advancing; outside every sensor, and distinct from [`NO_BASE`].
const BASE_MAX: u16 = u16::MAX - 1;

/// What an event takes from the words before its own.
#[derive(Debug, Clone, Copy)]
pub(super) struct State {
    /// Low 12 bits of the time in force.
    pub(super) low: u16,
    /// Row in force, or `NO_ROW`.
    pub(super) y: u16,
    /// Column of the next vector word's first pixel, or `NO_BASE`.
    pub(super) base_x: u16,
    /// Polarity of vector words.
    pub(super) base_on: bool,
}

/// Streaming decoder of EVT 3.0.
///
/// Bytes may be split anywhere between calls; the result does not depend on how.
#[derive(Debug, Clone)]
pub struct Evt3Decoder {
    pub(super) geometry: Geometry,
    pub(super) time_high: TimeHigh,
    /// Time of the high word alone, nanoseconds.
    pub(super) high_ns: u64,
    pub(super) state: State,
    /// First half of a word whose second half is yet to come.
    half: Option<u8>,
    payload: Payload,
    rate: RateCounts,
    pub(super) errors: ErrorCounts,
    pub(super) tally: WordTally,
}

impl Evt3Decoder {
    /// A decoder for a sensor of this size, waiting for its first `TIME_HIGH`.
    #[must_use]
    pub fn new(geometry: Geometry) -> Self {
        Self {
            geometry,
            time_high: TimeHigh::new(HIGH_BITS),
            high_ns: 0,
            state: State {
                low: 0,
                y: NO_ROW,
                base_x: NO_BASE,
                base_on: false,
            },
            half: None,
            payload: Payload::default(),
            rate: RateCounts::default(),
            errors: ErrorCounts::default(),
            tally: WordTally::default(),
        }
    }

    /// Decodes the next bytes of the stream into `sink`.
    pub fn decode(&mut self, bytes: &[u8], sink: &mut impl EventSink) {
        let mut bytes = bytes;
        if let (Some(low), [high, rest @ ..]) = (self.half, bytes) {
            self.half = None;
            bytes = rest;
            self.word(u16::from_le_bytes([low, *high]), sink);
        }
        let (words, tail) = bytes.as_chunks::<2>();
        self.run(words, sink);
        if let [low] = tail {
            self.half = Some(*low);
        }
    }

    /// Ends the stream: half a word that is still waiting is counted as a trailing byte.
    pub fn finish(&mut self) {
        if self.half.take().is_some() {
            self.errors.trailing_bytes += 1;
        }
    }

    /// Tells that bytes went missing: row, base column and time are no longer trusted.
    ///
    /// Decoding resumes at the next `TIME_HIGH`. If more than half a loop (8.39 s) may have gone
    /// by, call [`expect_near`](Self::expect_near) too, or whole loops are lost.
    pub fn gap(&mut self) {
        self.finish();
        self.time_high.forget();
        self.state.y = NO_ROW;
        self.state.base_x = NO_BASE;
        self.payload = Payload::default();
    }

    /// Says that the next `TIME_HIGH` lies within 8.39 s of `near`, which recovers the loop count
    /// after a gap or in the middle of a recording; `near` comes from the host's clock.
    ///
    /// Words before that `TIME_HIGH` are skipped, as before the first one of a stream.
    pub fn expect_near(&mut self, near: Stamp<Evk4>) {
        self.time_high.expect_near(near.as_micros() / HIGH_UNIT_US);
    }

    /// Errors so far.
    #[must_use]
    pub const fn errors(&self) -> &ErrorCounts {
        &self.errors
    }

    /// Where every word so far went.
    #[must_use]
    pub const fn words(&self) -> &WordTally {
        &self.tally
    }

    /// What the sensor's rate controller reported so far.
    #[must_use]
    pub const fn rate(&self) -> &RateCounts {
        &self.rate
    }

    /// Nothing earlier than this follows; `None` while the time is not known.
    ///
    /// Trails the time in force by 16 us, because a sensor may step back by up to 11 us within
    /// its stream. A larger step back breaks the promise; it is counted as
    /// [`ErrorCounts::time_backwards`], and the watermark steps back with it.
    #[must_use]
    pub fn watermark(&self) -> Option<Stamp<Evk4>> {
        self.time_high
            .is_known()
            .then(|| Stamp::from_nanos(self.t_ns().saturating_sub(STEP_BACK_US_MAX * 1000)))
    }

    /// Whether time and row are known, so that events need no more than a column.
    pub(super) const fn is_ready(&self) -> bool {
        self.time_high.is_known() && self.state.y != NO_ROW
    }

    /// Takes one word, whatever it is.
    pub(super) fn word(&mut self, word: u16, sink: &mut impl EventSink) {
        self.tally.words += 1;
        if kind(word) == TIME_HIGH {
            return self.take_time_high(word & PAYLOAD_MASK);
        }
        if !self.time_high.is_known() {
            self.errors.before_first_time_high += 1;
            return;
        }
        match kind(word) {
            ADDR_Y => self.state.y = word & ADDRESS_MASK,
            ADDR_X => {
                let (x, on) = (word & ADDRESS_MASK, word & ON_BIT != 0);
                return self.pixels(x, on, 1, sink);
            }
            VECT_BASE_X => {
                self.state.base_x = word & ADDRESS_MASK;
                self.state.base_on = word & ON_BIT != 0;
            }
            VECT_12 => return self.vector(u32::from(word & PAYLOAD_MASK), 12, sink),
            VECT_8 => return self.vector(u32::from(word & 0xff), 8, sink),
            TIME_LOW => return self.take_time_low(word & PAYLOAD_MASK),
            EXT_TRIGGER => sink.trigger(TriggerEdge {
                t: Stamp::from_nanos(self.t_ns()),
                channel: (word >> 8 & 0xf).to_le_bytes()[0],
                rising: word & 1 != 0,
            }),
            OTHERS | CONTINUED_12 | CONTINUED_4 => self.take_payload(word),
            _ => {
                self.errors.reserved_word += 1;
                return;
            }
        }
        self.tally.decoded += 1;
    }

    /// `OTHERS` and the words that continue it.
    pub(super) fn take_payload(&mut self, word: u16) {
        if kind(word) == OTHERS {
            self.payload.start(word & PAYLOAD_MASK);
        } else if kind(word) == CONTINUED_12
            && let Some((subtype, payload)) = self.payload.take_12(word & PAYLOAD_MASK)
        {
            self.rate.report(subtype, payload);
        }
    }

    fn take_time_high(&mut self, high: u16) {
        let step = self.time_high.take(u32::from(high));
        if step != Step::Same {
            let high_ns = self.time_high.widened().saturating_mul(HIGH_NS);
            self.high_ns = high_ns.min(u64::MAX - HIGH_NS);
            self.state.low = 0;
        }
        if step == Step::Backward {
            self.errors.time_backwards += 1;
        } else {
            self.tally.decoded += 1;
        }
    }

    fn take_time_low(&mut self, low: u16) {
        if low < self.state.low {
            self.errors.time_backwards += 1;
        } else {
            self.tally.decoded += 1;
        }
        self.state.low = low;
    }

    /// The time in force, nanoseconds.
    pub(super) fn t_ns(&self) -> u64 {
        self.high_ns + u64::from(self.state.low) * 1000
    }

    /// A `VECT_12` or `VECT_8`: `mask` has `len` bits, for the columns from the base on.
    fn vector(&mut self, mask: u32, len: u16, sink: &mut impl EventSink) {
        let base_x = self.state.base_x;
        if base_x != NO_BASE {
            self.state.base_x = base_x.saturating_add(len).min(BASE_MAX);
        } else if self.state.y != NO_ROW {
            self.errors.missing_vect_base += 1;
            return;
        }
        self.pixels(base_x, self.state.base_on, mask, sink);
    }

    /// Checks and delivers the events of one event word: one for each bit of `mask`, at `x` plus its index.
    fn pixels(&mut self, x: u16, on: bool, mask: u32, sink: &mut impl EventSink) {
        if self.state.y == NO_ROW {
            self.errors.missing_y += 1;
            return;
        }
        let columns = if self.state.y < self.geometry.height {
            u32::from(self.geometry.width.saturating_sub(x))
        } else {
            0
        };
        let inside = mask & 1_u32.checked_shl(columns).map_or(u32::MAX, |bit| bit - 1);
        if inside == mask {
            self.tally.decoded += 1;
        } else {
            self.tally.out_of_bounds += 1;
            self.errors.out_of_bounds += u64::from((mask ^ inside).count_ones());
        }
        self.deliver(x, on, inside, sink);
    }

    /// Delivers one event for each bit of `mask`, at `x` plus its index, all inside the sensor.
    #[inline(always)]
    pub(super) fn deliver(&self, x: u16, on: bool, mask: u32, sink: &mut impl EventSink) {
        let (t, y) = (Stamp::from_nanos(self.t_ns()), self.state.y);
        let mut rest = mask;
        while rest != 0 {
            // At most 31, and `x` plus it lies inside the sensor.
            let x = x + u16::from(rest.trailing_zeros().to_le_bytes()[0]);
            sink.event(Event { t, x, y, on });
            rest &= rest - 1;
        }
    }
}

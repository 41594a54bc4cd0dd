//! The fast way through EVT 3.0: common words in order, straight from registers to the sink.
//!
//! Rows, columns and times follow one another in an order that a branch predictor learns in part,
//! so tests come in the order of how likely a word is after the one before, and a word that
//! nearly always follows another is looked for right after it. All state is in local variables,
//! bounds are one comparison (a row outside the sensor shows as a width of zero), time is put
//! together once for each time word, and a vector group is recognised, checked and expanded
//! whole. Whatever is rare or wrong goes to the word-by-word decoder, which alone decides what
//! counts as which error.

use noctule_sensor::{Event, Stamp};

use super::evt3::State;
use super::word::{
    ADDR_X, ADDR_Y, ADDRESS_MASK, CONTINUED_4, CONTINUED_12, GROUP_PIXELS, ON_BIT, OTHERS,
    PAYLOAD_MASK, TIME_HIGH, TIME_LOW, VECT_8, VECT_12, VECT_BASE_X, kind, make,
};
use super::{EventSink, Evt3Decoder};

/// State and limits of the words to come, until a word is taken by itself.
#[derive(Clone, Copy)]
struct Fast {
    state: State,
    /// Time in force, nanoseconds.
    t_ns: u64,
    /// First column outside the sensor; 0 while no event can be inside.
    columns: u16,
    /// The `TIME_HIGH` word that changes nothing; of another type while the time is not known.
    same_high: u16,
}

impl Fast {
    fn of(decoder: &Evt3Decoder) -> Self {
        let row_is_inside = decoder.state.y < decoder.geometry.height;
        Self {
            state: decoder.state,
            t_ns: decoder.t_ns(),
            columns: if row_is_inside {
                decoder.geometry.width
            } else {
                0
            },
            same_high: make(TIME_HIGH, decoder.time_high.low_12()),
        }
    }

    #[inline(always)]
    fn event(&self, x: u16, on: bool, sink: &mut impl EventSink) {
        let (t, y) = (Stamp::from_nanos(self.t_ns), self.state.y);
        sink.event(Event { t, x, y, on });
    }

    /// Expands the vector group at the start of `words`, if there is one and it is wholly inside.
    #[inline(always)]
    fn group(&mut self, words: &[[u8; 2]], sink: &mut impl EventSink) -> bool {
        let Some([a, b, c]) = words.first_chunk::<3>() else {
            return false;
        };
        let [a, b, c] = [*a, *b, *c].map(u16::from_le_bytes);
        let is_group = (kind(a) == VECT_12) & (kind(b) == VECT_12) & (kind(c) == VECT_8);
        let base = self.state.base_x;
        if !is_group || base >= self.columns.saturating_sub(GROUP_PIXELS - 1) {
            return false;
        }
        let mut mask = u32::from(a & PAYLOAD_MASK)
            | u32::from(b & PAYLOAD_MASK) << 12
            | u32::from(c & 0xff) << 24;
        while mask != 0 {
            let index = u16::from(mask.trailing_zeros().to_le_bytes()[0]);
            self.event(base + index, self.state.base_on, sink);
            mask &= mask - 1;
        }
        self.state.base_x = base + GROUP_PIXELS;
        true
    }
}

impl Evt3Decoder {
    /// Decodes `words`, the common ones here and the others one by one.
    pub(super) fn run(&mut self, words: &[[u8; 2]], sink: &mut impl EventSink) {
        let mut rest = words;
        while !self.time_high.is_known() {
            let [word, after @ ..] = rest else { return };
            self.word(u16::from_le_bytes(*word), sink);
            rest = after;
        }
        let Self {
            geometry, high_ns, ..
        } = *self;
        let (mut fast, mut high_ns, mut one_by_one) = (Fast::of(self), high_ns, 0);
        let common = rest.len();
        while let [bytes, after @ ..] = rest {
            let here = rest;
            rest = after;
            let word = u16::from_le_bytes(*bytes);
            let address = word & ADDRESS_MASK;
            if kind(word) == ADDR_X && address < fast.columns {
                fast.event(address, word & ON_BIT != 0, sink);
            } else if kind(word) == ADDR_Y && address < geometry.height {
                fast.state.y = address;
                fast.columns = geometry.width;
            } else if kind(word) == TIME_LOW && word & PAYLOAD_MASK >= fast.state.low {
                fast.state.low = word & PAYLOAD_MASK;
                fast.t_ns = high_ns + u64::from(fast.state.low) * 1000;
            } else if word == fast.same_high {
                // Says nothing new.
            } else if kind(word) == VECT_BASE_X {
                fast.state.base_x = address;
                fast.state.base_on = word & ON_BIT != 0;
                while fast.group(rest, sink) {
                    rest = &rest[3..];
                }
            } else if matches!(kind(word), OTHERS | CONTINUED_12 | CONTINUED_4) {
                self.take_payload(word);
            } else if fast.group(here, sink) {
                rest = &here[3..];
            } else {
                self.state = fast.state;
                self.word(word, sink);
                one_by_one += 1;
                (fast, high_ns) = (Fast::of(self), self.high_ns);
            }
        }
        self.state = fast.state;
        let taken = (common - one_by_one) as u64;
        self.tally.words += taken;
        self.tally.decoded += taken;
    }
}

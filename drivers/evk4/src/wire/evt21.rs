//! EVT 2.1: 64-bit words, each up to 32 events of one row, polarity and microsecond.
//!
//! The upper half of a word is laid out as an EVT 2.0 word; the lower half is the mask of pixels.

use noctule_sensor::{Event, Evk4, Stamp, TriggerEdge};

use super::carry::Carry;
use super::evt2::{HIGH_BITS, HIGH_UNIT_US, eleven_bits, field};
use super::time_high::{Step, TimeHigh};
use super::{ErrorCounts, EventSink, Geometry, WordTally};

/// Which half of a word comes first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum WordOrder {
    /// A plain little-endian 64-bit word (GenX320).
    Little,
    /// The upper half first, each half little-endian (IMX636, "legacy").
    Legacy,
}

/// Streaming decoder of EVT 2.1.
///
/// Bytes may be split anywhere between calls; the result does not depend on how.
#[derive(Debug, Clone)]
pub struct Evt21Decoder {
    geometry: Geometry,
    order: WordOrder,
    time_high: TimeHigh,
    carry: Carry<8>,
    errors: ErrorCounts,
    tally: WordTally,
}

impl Evt21Decoder {
    /// A decoder for a sensor of this size, waiting for its first `TIME_HIGH`.
    #[must_use]
    pub fn new(geometry: Geometry, order: WordOrder) -> Self {
        Self {
            geometry,
            order,
            time_high: TimeHigh::new(HIGH_BITS),
            carry: Carry::new(),
            errors: ErrorCounts::default(),
            tally: WordTally::default(),
        }
    }

    /// Decodes the next bytes of the stream into `sink`.
    pub fn decode(&mut self, bytes: &[u8], sink: &mut impl EventSink) {
        let mut carry = self.carry;
        carry.words(bytes, |[a, b, c, d, e, f, g, h]| {
            let first = u32::from_le_bytes([a, b, c, d]);
            let second = u32::from_le_bytes([e, f, g, h]);
            match self.order {
                WordOrder::Little => self.word(second, first, sink),
                WordOrder::Legacy => self.word(first, second, sink),
            }
        });
        self.carry = carry;
    }

    /// Ends the stream: bytes of an incomplete word are counted as trailing.
    pub fn finish(&mut self) {
        self.errors.trailing_bytes += self.carry.drop_rest();
    }

    /// Tells that bytes went missing; decoding resumes at the next `TIME_HIGH`.
    pub fn gap(&mut self) {
        self.finish();
        self.time_high.forget();
    }

    /// Says that the next `TIME_HIGH` lies within 2 h 23 min of `near`.
    pub fn expect_near(&mut self, near: Stamp<Evk4>) {
        self.time_high.expect_near(near.as_micros() / HIGH_UNIT_US);
    }

    /// Errors so far; `missing_y` and `missing_vect_base` cannot occur in this encoding.
    #[must_use]
    pub const fn errors(&self) -> &ErrorCounts {
        &self.errors
    }

    /// Where every word so far went.
    #[must_use]
    pub const fn words(&self) -> &WordTally {
        &self.tally
    }

    /// Nothing earlier than this follows, unless `TIME_HIGH` steps back, which is counted;
    /// `None` while the time is not known. Trails by up to 64 us.
    #[must_use]
    pub fn watermark(&self) -> Option<Stamp<Evk4>> {
        self.time_high
            .is_known()
            .then(|| Stamp::from_micros(self.time_high.widened() * HIGH_UNIT_US))
    }

    fn word(&mut self, upper: u32, mask: u32, sink: &mut impl EventSink) {
        self.tally.words += 1;
        let kind = upper >> field::KIND_SHIFT;
        if kind == field::TIME_HIGH {
            if self.time_high.take(upper & field::TIME_HIGH_MASK) == Step::Backward {
                self.errors.time_backwards += 1;
            } else {
                self.tally.decoded += 1;
            }
            return;
        }
        if !self.time_high.is_known() {
            self.errors.before_first_time_high += 1;
            return;
        }
        let low = u64::from(upper >> field::T_SHIFT & 0x3f);
        let t = Stamp::from_micros(self.time_high.widened() * HIGH_UNIT_US + low);
        match kind {
            field::CD_OFF | field::CD_ON => {
                return self.pixels(t, upper, mask, sink);
            }
            field::EXT_TRIGGER => sink.trigger(TriggerEdge {
                t,
                channel: (upper >> field::CHANNEL_SHIFT & 0x1f).to_le_bytes()[0],
                rising: upper & 1 != 0,
            }),
            field::OTHERS | field::CONTINUED => {}
            _ => {
                self.errors.reserved_word += 1;
                return;
            }
        }
        self.tally.decoded += 1;
    }

    /// Delivers one event for each bit of `mask`, at the word's column plus the bit's index.
    fn pixels(&mut self, t: Stamp<Evk4>, upper: u32, mask: u32, sink: &mut impl EventSink) {
        let (x, y) = (eleven_bits(upper >> field::X_SHIFT), eleven_bits(upper));
        let on = upper >> field::KIND_SHIFT == field::CD_ON;
        let columns = if y < self.geometry.height {
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
        let mut rest = inside;
        while rest != 0 {
            let x = x + u16::from(rest.trailing_zeros().to_le_bytes()[0]);
            sink.event(Event { t, x, y, on });
            rest &= rest - 1;
        }
    }
}

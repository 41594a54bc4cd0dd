//! EVT 2.0: 32-bit words, one event each, with the time's low 6 bits in the word itself.

use noctule_sensor::{Event, Evk4, Stamp, TriggerEdge};

use super::carry::Carry;
use super::time_high::{Step, TimeHigh};
use super::{ErrorCounts, EventSink, Geometry, WordTally};

/// Word types, bits 31..28, and field positions (EVT 2.0 format page; the upper half of an
/// EVT 2.1 word is the same).
pub(super) mod field {
    pub const CD_OFF: u32 = 0x0;
    pub const CD_ON: u32 = 0x1;
    pub const TIME_HIGH: u32 = 0x8;
    pub const EXT_TRIGGER: u32 = 0xA;
    pub const OTHERS: u32 = 0xE;
    pub const CONTINUED: u32 = 0xF;
    pub const KIND_SHIFT: u32 = 28;
    pub const TIME_HIGH_MASK: u32 = (1 << 28) - 1;
    pub const T_SHIFT: u32 = 22;
    pub const X_SHIFT: u32 = 11;
    pub const CHANNEL_SHIFT: u32 = 8;
}

/// Width of `TIME_HIGH`, bits; with 6 low bits it wraps after 4 h 46 min.
pub(super) const HIGH_BITS: u32 = 28;
/// Microseconds per step of `TIME_HIGH`.
pub(super) const HIGH_UNIT_US: u64 = 1 << 6;

/// Streaming decoder of EVT 2.0.
///
/// Bytes may be split anywhere between calls; the result does not depend on how.
#[derive(Debug, Clone)]
pub struct Evt2Decoder {
    geometry: Geometry,
    time_high: TimeHigh,
    carry: Carry<4>,
    errors: ErrorCounts,
    tally: WordTally,
}

impl Evt2Decoder {
    /// A decoder for a sensor of this size, waiting for its first `TIME_HIGH`.
    #[must_use]
    pub fn new(geometry: Geometry) -> Self {
        Self {
            geometry,
            time_high: TimeHigh::new(HIGH_BITS),
            carry: Carry::new(),
            errors: ErrorCounts::default(),
            tally: WordTally::default(),
        }
    }

    /// Decodes the next bytes of the stream into `sink`.
    pub fn decode(&mut self, bytes: &[u8], sink: &mut impl EventSink) {
        let mut carry = self.carry;
        carry.words(bytes, |word| self.word(u32::from_le_bytes(word), sink));
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

    fn word(&mut self, word: u32, sink: &mut impl EventSink) {
        self.tally.words += 1;
        let kind = word >> field::KIND_SHIFT;
        if kind == field::TIME_HIGH {
            if self.time_high.take(word & field::TIME_HIGH_MASK) == Step::Backward {
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
        let low = u64::from(word >> field::T_SHIFT & 0x3f);
        let t = Stamp::from_micros(self.time_high.widened() * HIGH_UNIT_US + low);
        match kind {
            field::CD_OFF | field::CD_ON => {
                let (x, y) = (eleven_bits(word >> field::X_SHIFT), eleven_bits(word));
                if x >= self.geometry.width || y >= self.geometry.height {
                    self.errors.out_of_bounds += 1;
                    self.tally.out_of_bounds += 1;
                    return;
                }
                let on = kind == field::CD_ON;
                sink.event(Event { t, x, y, on });
            }
            field::EXT_TRIGGER => sink.trigger(TriggerEdge {
                t,
                channel: (word >> field::CHANNEL_SHIFT & 0x1f).to_le_bytes()[0],
                rising: word & 1 != 0,
            }),
            field::OTHERS | field::CONTINUED => {}
            _ => {
                self.errors.reserved_word += 1;
                return;
            }
        }
        self.tally.decoded += 1;
    }
}

/// The low 11 bits: a row or a column.
pub(super) const fn eleven_bits(field: u32) -> u16 {
    let [low, high, ..] = (field & 0x7ff).to_le_bytes();
    u16::from_le_bytes([low, high])
}

//! One face for every encoding.

use noctule_sensor::{Evk4, Stamp};

use super::{
    ErrorCounts, EventSink, Evt2Decoder, Evt3Decoder, Evt21Decoder, RateCounts, WordOrder,
    WordTally,
};

/// Size of a sensor, pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Geometry {
    /// Columns.
    pub width: u16,
    /// Rows.
    pub height: u16,
}

/// Encoding of an event stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Format {
    /// EVT 2.0: 32-bit words, one event each.
    Evt2,
    /// EVT 2.1: 64-bit little-endian words, up to 32 events each.
    Evt21,
    /// EVT 2.1 with the upper half of each word first ("legacy" endianness, IMX636).
    Evt21Legacy,
    /// EVT 3.0: 16-bit words with state.
    Evt3,
}

impl Format {
    /// Bytes of one word.
    #[must_use]
    pub const fn word_len(self) -> usize {
        match self {
            Self::Evt2 => 4,
            Self::Evt21 | Self::Evt21Legacy => 8,
            Self::Evt3 => 2,
        }
    }
}

/// Streaming decoder of any [`Format`].
///
/// Bytes may be split anywhere between calls; the result does not depend on how.
#[derive(Debug, Clone)]
pub enum Decoder {
    /// EVT 2.0.
    Evt2(Evt2Decoder),
    /// EVT 2.1, either word order.
    Evt21(Evt21Decoder),
    /// EVT 3.0.
    Evt3(Evt3Decoder),
}

macro_rules! each {
    ($self:expr, $decoder:ident => $body:expr) => {
        match $self {
            Self::Evt2($decoder) => $body,
            Self::Evt21($decoder) => $body,
            Self::Evt3($decoder) => $body,
        }
    };
}

impl Decoder {
    /// A decoder for a sensor of this size, waiting for its first `TIME_HIGH`.
    #[must_use]
    pub fn new(format: Format, geometry: Geometry) -> Self {
        match format {
            Format::Evt2 => Self::Evt2(Evt2Decoder::new(geometry)),
            Format::Evt21 => Self::Evt21(Evt21Decoder::new(geometry, WordOrder::Little)),
            Format::Evt21Legacy => Self::Evt21(Evt21Decoder::new(geometry, WordOrder::Legacy)),
            Format::Evt3 => Self::Evt3(Evt3Decoder::new(geometry)),
        }
    }

    /// Decodes the next bytes of the stream into `sink`.
    pub fn decode(&mut self, bytes: &[u8], sink: &mut impl EventSink) {
        each!(self, decoder => decoder.decode(bytes, sink));
    }

    /// Ends the stream: a word that is still incomplete is counted as trailing bytes.
    pub fn finish(&mut self) {
        each!(self, decoder => decoder.finish());
    }

    /// Tells that bytes went missing: all state is dropped until the next `TIME_HIGH`.
    ///
    /// If more than half of the counter's range may have gone by (8.39 s in EVT 3.0), call
    /// [`expect_near`](Self::expect_near) too, or whole loops are lost.
    pub fn gap(&mut self) {
        each!(self, decoder => decoder.gap());
    }

    /// Says that the next `TIME_HIGH` lies within half of the counter's range of `near`.
    ///
    /// Recovers the loop count after a gap or in the middle of a recording.
    pub fn expect_near(&mut self, near: Stamp<Evk4>) {
        each!(self, decoder => decoder.expect_near(near));
    }

    /// Errors so far.
    #[must_use]
    pub const fn errors(&self) -> &ErrorCounts {
        each!(self, decoder => decoder.errors())
    }

    /// Where every word so far went.
    #[must_use]
    pub const fn words(&self) -> &WordTally {
        each!(self, decoder => decoder.words())
    }

    /// What the sensor's rate controller reported so far; all zero where the encoding is not
    /// known to carry it (all but EVT 3.0).
    #[must_use]
    pub const fn rate(&self) -> RateCounts {
        match self {
            Self::Evt3(decoder) => *decoder.rate(),
            Self::Evt2(_) | Self::Evt21(_) => RateCounts::ZERO,
        }
    }

    /// Nothing earlier than this follows; `None` while the time is not known.
    ///
    /// See [`Evt3Decoder::watermark`] for what a step back in time does to it.
    #[must_use]
    pub fn watermark(&self) -> Option<Stamp<Evk4>> {
        each!(self, decoder => decoder.watermark())
    }
}

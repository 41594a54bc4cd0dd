//! Prophesee EVK4: EVT words to events and trigger edges, and back.
//!
//! Decodes EVT 2.0, EVT 2.1 and EVT 3.0 from bytes split anywhere, encodes EVT 3.0, and reads RAW
//! files of any size in constant memory. A damaged stream never stops decoding: every word is
//! decoded or counted under one kind of error ([`ErrorCounts`], [`WordTally`]).
//!
//! ```
//! use noctule_evk4::{Decoder, Evt3Encoder, Format, Geometry};
//! use noctule_sensor::{Event, Stamp};
//!
//! let event = Event { t: Stamp::from_micros(5000), x: 640, y: 360, on: true };
//! let (mut encoder, mut bytes) = (Evt3Encoder::new(), Vec::new());
//! encoder.event(event, &mut bytes)?;
//! encoder.flush(&mut bytes);
//!
//! let mut decoder = Decoder::new(Format::Evt3, Geometry { width: 1280, height: 720 });
//! let mut events = Vec::new();
//! decoder.decode(&bytes, &mut events);
//! assert_eq!(events, [event]);
//! assert!(decoder.errors().is_clean());
//! # Ok::<(), noctule_evk4::EncodeError>(())
//! ```
#![forbid(unsafe_code)]

mod header;
mod raw_file;
mod summary;
mod wire;

pub use header::{RawError, RawHeader};
pub use raw_file::{OpenError, RawFile};
pub use summary::{Summary, TriggerSummary};
pub use wire::{
    Decoder, EncodeError, ErrorCounts, EventSink, Evt2Decoder, Evt3Decoder, Evt3Encoder,
    Evt21Decoder, Format, Geometry, RateCounts, WordOrder, WordTally,
};

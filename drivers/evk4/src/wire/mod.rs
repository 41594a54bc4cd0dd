//! Bytes to events and back, for every EVT encoding; no I/O, no clock, no allocation in decoders.
//!
//! All times leave here widened past the counter's wrap, in whole microseconds of the sensor's
//! clock. Bad words are counted by kind and never end decoding: see [`ErrorCounts`].

mod carry;
mod decoder;
mod encoder;
mod evt2;
mod evt21;
mod evt3;
mod evt3_batch;
mod evt3_run;
mod rate;
mod sink;
mod tally;
mod time_high;
mod word;

pub use decoder::{Decoder, Format, Geometry};
pub use encoder::{EncodeError, Evt3Encoder};
pub use evt2::Evt2Decoder;
pub use evt3::Evt3Decoder;
pub use evt21::{Evt21Decoder, WordOrder};
pub use rate::RateCounts;
pub use sink::EventSink;
pub use tally::{ErrorCounts, WordTally};

//! The recording directory: what the sensors delivered, byte for byte.
//!
//! Written as it comes, in bounded memory, and read back stream by stream; `FORMAT.md` is the
//! schema. Merging the streams by arrival, pacing them and decoding what they carry are the
//! host's.
#![forbid(unsafe_code)]

mod calibration;
mod can;
mod clocks;
mod datagrams;
mod error;
mod events;
mod exposure;
mod faults;
mod flow;
mod image;
mod layout;
mod meta;
mod picture;
mod pose;
mod recording;
mod table;
mod truth;
mod writer;

pub use calibration::{
    CALIBRATION_SCHEMA, Calibration, Delays, Distortion, EventLens, Lens, Rectangle,
};
pub use can::CanFrames;
pub use clocks::{ClockReading, ClockReadings, ClockTruth, TruthClocks};
pub use datagrams::Datagrams;
pub use error::{FieldError, RecordingError, WriteError};
pub use events::{EventTransfers, Transfer};
pub use exposure::{EdgeTruth, ExposureTruth, ExposureTruths};
pub use faults::Faults;
pub use image::{ImageRow, ImageRows};
pub use meta::{
    CameraMeta, CanMeta, Counts, EventsMeta, Generator, GridSize, LidarMeta, Meta,
    RECORDING_SCHEMA, Split, StrobeMeta, StrobePolarity,
};
pub use picture::Picture;
pub use pose::Pose;
pub use recording::{Missing, Recording};
pub use truth::{SampleTruth, SampleWriter, TruthWriter};
pub use writer::RecordingWriter;

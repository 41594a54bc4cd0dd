//! The recording directory: what the sensors delivered, byte for byte.
//!
//! Written as it comes, in bounded memory, and read back stream by stream; `FORMAT.md` is the
//! schema. Merging the streams by arrival, pacing them and decoding what they carry are the
//! host's.
#![forbid(unsafe_code)]

mod calibration;
mod can;
mod clocks;
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

pub use calibration::Rectangle;
pub use calibration::{CALIBRATION_SCHEMA, Calibration, Delays, Distortion, EventLens, Lens};
pub use can::CanFrames;
pub use clocks::{ClockReading, ClockReadings, ClockTruth, TruthClocks};
pub use error::{FieldError, RecordingError, WriteError};
pub use events::{EventTransfers, Transfer};
pub use exposure::{EdgeTruth, ExposureTruth, ExposureTruths};
pub use faults::Faults;
pub use flow::{read_flow, write_flow};
pub use image::{ImageRow, ImageRows};
pub use meta::{
    CameraMeta, CanMeta, Counts, EventsMeta, Generator, GridSize, LidarMeta, Meta,
    RECORDING_SCHEMA, Split, StrobeMeta, StrobePolarity,
};
pub use picture::{Picture, read_depth, read_mask, read_rgb8, write_depth, write_mask, write_rgb8};
pub use pose::Pose;
pub use recording::{Missing, Recording};
pub use truth::{SampleTruth, SampleWriter, TruthWriter};
pub use writer::RecordingWriter;

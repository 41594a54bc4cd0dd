//! What a recording says about itself: `meta.json`.

use noctule_camera::Encoding;
use noctule_can::{Interface, MotionConfig, MotionDecoder};
use serde::{Deserialize, Serialize};

use crate::{FieldError, Rectangle};

/// The version of the recording directory that this crate reads and writes.
pub const RECORDING_SCHEMA: u64 = 1;

/// Most steps an exposure can be divided into.
const STEPS_MAX: u32 = 64;
/// Longest side of an image, pixels.
const SIDE_MAX: u32 = 16_384;

/// The program that made up a synthetic recording.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Generator {
    /// Its name.
    pub name: String,
    /// Its version; the same version and seed give the same bytes.
    pub version: String,
    /// What it started from.
    pub seed: u64,
}

/// What a recording may be used for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Split {
    /// To fit weights.
    Train,
    /// To choose between them.
    Val,
    /// To report.
    Test,
}

/// Columns and rows of a grid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GridSize {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// Which level of the strobe line means that the shutter is open.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StrobePolarity {
    /// The rising edge opens.
    ActiveHigh,
    /// The falling edge opens.
    ActiveLow,
}

/// How the camera's strobe reaches the event camera's trigger input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StrobeMeta {
    /// Trigger input, as trigger words number it.
    pub channel: u8,
    /// Polarity at the input.
    pub polarity: StrobePolarity,
    /// How much later than the shutter opens its edge arrives, nanoseconds.
    pub open_delay_ns: i64,
    /// How much later than the shutter closes its edge arrives, nanoseconds.
    pub close_delay_ns: i64,
}

/// The event camera.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EventsMeta {
    /// Device serial; empty when unknown.
    pub serial: String,
    /// Sensor columns.
    pub width: u32,
    /// Sensor rows.
    pub height: u32,
    /// The strobe line; absent when none is connected.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub strobe: Option<StrobeMeta>,
}

/// The RGB camera.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraMeta {
    /// Device serial; empty when unknown.
    pub serial: String,
    /// Columns of every image.
    pub width: u32,
    /// Rows of every image.
    pub height: u32,
    /// Transfer function of the pixel values.
    pub encoding: Encoding,
    /// Bits per sample; schema 1 has 8.
    pub bit_depth: u8,
}

/// The LiDAR.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LidarMeta {
    /// Device serial; empty when unknown.
    pub serial: String,
    /// Maker's name of the model, such as `PandarQT64`; empty when unknown.
    pub model: String,
    /// UDP port its packets were received on.
    pub port: u16,
}

/// The vehicle's bus.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CanMeta {
    /// Network interface, as written in the log.
    pub interface: String,
    /// Which signals carry the motion.
    pub motion: MotionConfig,
}

/// What a recording says about itself. A sensor that is absent here was not there.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Meta {
    /// Name of the sequence.
    pub name: String,
    /// The program that made it up; absent for a real recording.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub generator: Option<Generator>,
    /// What it may be used for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub split: Option<Split>,
    /// Steps per exposure, T.
    pub steps: u32,
    /// The part of the RGB image that the network sees.
    pub crop: Rectangle,
    /// The grid it sees it on.
    pub network: GridSize,
    /// The event camera, if any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub events: Option<EventsMeta>,
    /// The RGB camera, if any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera: Option<CameraMeta>,
    /// The LiDAR, if any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lidar: Option<LidarMeta>,
    /// The vehicle's bus, if any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub can: Option<CanMeta>,
}

impl Meta {
    /// Checks every value.
    ///
    /// # Errors
    /// Names the field, its value and what is wrong.
    pub fn validate(&self) -> Result<(), FieldError> {
        if !(1..=STEPS_MAX).contains(&self.steps) {
            return Err(FieldError::new("steps", self.steps, "not in 1..=64"));
        }
        side("network.width", self.network.width)?;
        side("network.height", self.network.height)?;
        let (mut width, mut height) = (SIDE_MAX, SIDE_MAX);
        if let Some(events) = &self.events {
            side("events.width", events.width)?;
            side("events.height", events.height)?;
        }
        if let Some(camera) = &self.camera {
            side("camera.width", camera.width)?;
            side("camera.height", camera.height)?;
            (width, height) = (camera.width, camera.height);
            if camera.bit_depth != 8 {
                let depth = camera.bit_depth;
                return Err(FieldError::new("camera.bit_depth", depth, "schema 1 has 8"));
            }
        }
        self.crop
            .validate_within(width, height)
            .map_err(|e| e.within("crop"))?;
        if let Some(can) = &self.can {
            Interface::new(&can.interface).map_err(|_| {
                let problem = "not 1 to 15 printable characters";
                FieldError::new("can.interface", &can.interface, problem)
            })?;
            MotionDecoder::new(&can.motion)
                .map_err(|e| FieldError::new("can.motion", e, "unusable signals"))?;
        }
        Ok(())
    }
}

fn side(field: &str, value: u32) -> Result<(), FieldError> {
    if (1..=SIDE_MAX).contains(&value) {
        return Ok(());
    }
    Err(FieldError::new(field, value, "not in 1..=16384"))
}

/// How much of each stream was written; only a finished recording has them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Counts {
    /// Transfers in `raw/events.csv`.
    pub event_transfers: u64,
    /// Bytes of `raw/events.raw` behind its header.
    pub event_bytes: u64,
    /// The longest transfer, bytes.
    pub event_transfer_len_max: u64,
    /// Datagrams in `raw/lidar.pcap`.
    pub datagrams: u64,
    /// Images in `raw/rgb`.
    pub images: u64,
    /// Lines of `raw/can.log`.
    pub can_frames: u64,
    /// Rows of `raw/clocks.csv`.
    pub clock_readings: u64,
}

/// `meta.json` as a whole.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct MetaFile {
    pub(crate) schema: u64,
    /// Of `calib.toml`, hexadecimal.
    pub(crate) calibration_sha256: String,
    pub(crate) recording: Meta,
    /// Absent until the recording was finished.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) counts: Option<Counts>,
}

#[derive(Deserialize)]
pub(crate) struct SchemaOnly {
    pub(crate) schema: u64,
}

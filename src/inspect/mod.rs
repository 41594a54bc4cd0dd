//! What is in a file: RAW event streams, packet captures and recording directories, in numbers.
//!
//! Files are told apart by their first bytes, never by their names, and read once, in bounded
//! memory. A file that is damaged is reported as far as it goes, together with its
//! [faults](Inspection::faults); only a file of which nothing can be read is an error. Prints
//! nothing.

mod error;
mod kind;
mod lidar;
mod pulses;
mod raw;
mod recording;
mod sensor;
mod text;
mod watched;

pub use error::InspectError;
pub use kind::Kind;
pub use lidar::{LidarReport, SkippedReport};
pub use pulses::{ExposureReport, TruthReport};
pub use raw::{RawReport, TriggerReport};
pub use recording::{
    CanReport, ClockReport, GeneratorReport, ImageReport, RecordingReport, TransferReport,
};
pub use sensor::{
    SensorFound, find_recorded_sensor, find_sensor, load_correction, load_fire_times,
};
pub use watched::Watched;

use std::fs;
use std::path::{Path, PathBuf};

use noctule_evk4::Geometry;
use serde::{Serialize, Serializer};

/// What an inspection has to be told.
#[derive(Debug, Clone, Default)]
pub struct Options {
    /// A LiDAR's own angle table (Hesai CSV), in place of a recording's own or the nominal one. It
    /// decides where sweeps are cut.
    pub angles: Option<PathBuf>,
    /// Size of the event sensor where a RAW header gives none.
    pub geometry: Option<Geometry>,
}

/// What one path holds.
///
/// As JSON one object: the report's keys with `kind` first, then `path` and `faults` (sentences).
#[derive(Debug, Serialize)]
pub struct Inspection {
    /// The numbers.
    #[serde(flatten)]
    pub report: Report,
    /// What was inspected; in JSON, bytes that are no UTF-8 are replaced.
    #[serde(serialize_with = "shown")]
    pub path: PathBuf,
    /// Damage, in the order in which it was met; everything before it was counted.
    #[serde(serialize_with = "sentences")]
    pub faults: Vec<InspectError>,
}

/// The numbers of one path.
#[derive(Debug, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Report {
    /// A RAW file.
    Raw(RawReport),
    /// A packet capture with a LiDAR's packets.
    Lidar(LidarReport),
    /// A recording directory.
    Recording(Box<RecordingReport>),
}

/// Inspects one path; `progress` is told of every number of bytes read, which add up to about
/// [`bytes_to_read`].
///
/// # Errors
/// When nothing of it can be read: it is not there, of no known kind, or its header cannot be
/// understood; also when the angle table is unusable.
pub fn inspect(
    path: &Path,
    options: &Options,
    progress: &dyn Fn(u64),
) -> Result<Inspection, InspectError> {
    let mut faults = Vec::new();
    let report = match Kind::of(path)? {
        Kind::Raw => Report::Raw(raw::inspect(path, options, progress, &mut faults)?),
        Kind::Capture => Report::Lidar(lidar::inspect(path, options, progress, &mut faults)?),
        Kind::Recording => {
            let report = recording::inspect(path, options, progress, &mut faults)?;
            Report::Recording(Box::new(report))
        }
    };
    Ok(Inspection {
        report,
        path: path.to_owned(),
        faults,
    })
}

/// Bytes that an inspection or an export of `path` will read, for a progress bar; 0 when unknown.
#[must_use]
pub fn bytes_to_read(path: &Path) -> u64 {
    let len = |path: &Path| fs::metadata(path).map_or(0, |m| m.len());
    if path.is_dir() {
        return len(&path.join(recording::EVENTS_FILE)) + len(&path.join(recording::LIDAR_FILE));
    }
    len(path)
}

fn shown<S: Serializer>(path: &Path, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&path.display())
}

fn sentences<S: Serializer>(faults: &[InspectError], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(faults.iter().map(ToString::to_string))
}

/// Counts by name as one JSON object, in their own order.
fn by_name<S: Serializer>(
    counts: &[(&'static str, u64)],
    serializer: S,
) -> Result<S::Ok, S::Error> {
    serializer.collect_map(counts.iter().copied())
}

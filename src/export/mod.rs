//! Files for other programs: events as CSV or NPY, LiDAR as PCD or CSV, depth as PNG.
//!
//! The target's extension decides the format, the source's first bytes what is in it. Everything
//! streams, whatever the length; a target appears under its name only once it is whole. Prints
//! nothing.

mod cloud;
mod depth;
mod error;
mod events;
mod output;
mod points;
mod target;

pub use cloud::{CLOUD_COLUMNS, PCD_RECORD_LEN};
pub use depth::{DepthFormat, DepthOptions, Layer};
pub use error::ExportError;
pub use events::{EVENT_COLUMNS, NPY_RECORD_LEN};
pub use target::{Stream, Target};

use std::path::PathBuf;

use noctule_evk4::Geometry;
use noctule_hesai::Returns;

use crate::inspect::{InspectError, Kind};

/// What to export, and how.
#[derive(Debug, Clone)]
pub struct Request {
    /// A RAW file, a capture, a recording directory, a depth PNG of 16 bits or a folder of them.
    pub from: PathBuf,
    /// The file to write; its extension decides the format. A folder for several depth maps.
    pub to: PathBuf,
    /// Which stream of a recording; needed where the format does not decide it.
    pub stream: Option<Stream>,
    /// Size of the event sensor where a RAW header gives none.
    pub geometry: Option<Geometry>,
    /// LiDAR settings.
    pub lidar: LidarOptions,
    /// Depth settings.
    pub depth: DepthOptions,
}

impl Request {
    /// An export with nothing out of the ordinary.
    #[must_use]
    pub fn new(from: impl Into<PathBuf>, to: impl Into<PathBuf>) -> Self {
        Self {
            from: from.into(),
            to: to.into(),
            stream: None,
            geometry: None,
            lidar: LidarOptions::default(),
            depth: DepthOptions::default(),
        }
    }
}

/// How LiDAR packets are decoded.
#[derive(Debug, Clone)]
pub struct LidarOptions {
    /// The unit's angle table (Hesai CSV); without it the recording's own, else the model's.
    pub angles: Option<PathBuf>,
    /// The unit's fire-time table (Hesai CSV); without it the model's.
    pub fire_times: Option<PathBuf>,
    /// Every return, or equal ones of a firing once (the last block's).
    pub returns: Returns,
    /// Only the returns of this sweep, numbered from 0 in the order of the file.
    pub sweep: Option<u32>,
}

impl Default for LidarOptions {
    fn default() -> Self {
        Self {
            angles: None,
            fire_times: None,
            returns: Returns::Unique,
            sweep: None,
        }
    }
}

/// What was written.
#[derive(Debug)]
pub struct Exported {
    /// Rows, points or depth maps.
    pub written: u64,
    /// What they are, for a sentence.
    pub unit: &'static str,
    /// What of the source could not be decoded, by kind; only kinds that occurred. For events the
    /// kinds of error of the encoding, for LiDAR packets the reasons for which datagrams were
    /// rejected, and `lost` packets.
    pub undecoded: Vec<(&'static str, u64)>,
    /// Where the source was damaged; everything before it was exported.
    pub faults: Vec<InspectError>,
}

/// Exports; `progress` is told of every number of source bytes read.
///
/// # Errors
/// When the source cannot be read at all, does not hold what the target's format takes, or the
/// target cannot be written; the target is then as it was before.
pub fn export(request: &Request, progress: &dyn Fn(u64)) -> Result<Exported, ExportError> {
    let target = Target::of(&request.to)?;
    if is_depth(request, target) {
        return depth::export(request, target, progress);
    }
    let kind = Kind::of(&request.from)?;
    let stream = stream(request, kind, target)?;
    match (stream, target) {
        (Stream::Events, Target::Csv | Target::Npy) => {
            events::export(request, kind, target, progress)
        }
        (Stream::Lidar, Target::Csv | Target::Pcd) => {
            points::export(request, kind, target, progress)
        }
        _ => Err(ExportError::Unsuitable {
            path: request.to.clone(),
            target,
            stream,
        }),
    }
}

/// Whether depth is meant: asked for, or the source holds nothing else, or the target takes nothing
/// else of a recording.
fn is_depth(request: &Request, target: Target) -> bool {
    if let Some(stream) = request.stream {
        return stream == Stream::Depth;
    }
    let from = &request.from;
    if !from.is_dir() {
        return depth::is_png(from);
    }
    matches!(target, Target::Png | Target::Folder) || !from.join("meta.json").is_file()
}

/// The stream of the source that the target takes.
fn stream(request: &Request, kind: Kind, target: Target) -> Result<Stream, ExportError> {
    let held = match kind {
        Kind::Raw => Some(Stream::Events),
        Kind::Capture => Some(Stream::Lidar),
        Kind::Recording => None,
    };
    match (held, request.stream) {
        (Some(held), Some(asked)) if held != asked => Err(ExportError::NoStream {
            path: request.from.clone(),
            held,
            asked,
        }),
        (Some(stream), _) | (None, Some(stream)) => Ok(stream),
        (None, None) => match target {
            Target::Npy => Ok(Stream::Events),
            Target::Pcd => Ok(Stream::Lidar),
            _ => Err(ExportError::Ambiguous {
                path: request.from.clone(),
            }),
        },
    }
}

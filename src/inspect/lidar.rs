//! A LiDAR's packets in numbers.

use std::io::BufReader;
use std::path::Path;

use noctule_hesai::pcap::{Reader, Skipped};
use noctule_hesai::{Options as DecoderOptions, Summary, Survey};
use noctule_sensor::Stamp;
use serde::Serialize;

use super::{InspectError, Options, SensorFound, Watched, by_name, find_sensor, load_correction};

/// Bytes read at once.
const BUFFER_LEN: usize = 256 << 10;

/// Counts over all packets of one LiDAR.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct LidarReport {
    /// Short name of the sensor, such as `qt64`; null when no packet of a known one was found.
    pub model: Option<&'static str>,
    /// Valid packets, duplicates among them.
    pub packets: u64,
    /// Non-zero returns of all blocks.
    pub returns: u64,
    /// Non-zero returns with equal ones of the same firing counted once.
    pub points: u64,
    /// Sweeps, complete and partial.
    pub sweeps: u64,
    /// Sweeps of which every block arrived.
    pub sweeps_complete: u64,
    /// Packets missing, by sequence number, less those that came late.
    pub lost: u64,
    /// Packets that came after a later one.
    pub late: u64,
    /// Packets that came more than once.
    pub duplicate: u64,
    /// Datagrams that are no packets of the sensor, by reason; only reasons that occurred.
    #[serde(serialize_with = "by_name")]
    pub rejected: Vec<(&'static str, u64)>,
    /// When the earliest non-zero return was fired, nanoseconds of the LiDAR's clock.
    pub first_ns: Option<u64>,
    /// When the latest non-zero return was fired, nanoseconds of the LiDAR's clock.
    pub last_ns: Option<u64>,
    /// UDP port of the sensor; null when none was found.
    pub port: Option<u16>,
    /// Times the sensor's numbering began anew.
    pub restarts: u64,
    /// Jumps of the sensor's clock, restarts among them.
    pub clock_steps: u64,
    /// Records of the capture that are none of the sensor's datagrams.
    pub skipped: SkippedReport,
}

/// Records of a capture that were passed over.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct SkippedReport {
    /// Datagrams to other ports.
    pub other_port: u64,
    /// Frames that are not UDP over IP.
    pub not_udp: u64,
    /// Pieces of IP datagrams.
    pub fragments: u64,
    /// Frames cut short when they were captured, or with lengths that contradict one another.
    pub cut: u64,
}

impl LidarReport {
    pub(super) fn new(summary: &Summary, skipped: Skipped) -> Self {
        let counts = &summary.counts;
        Self {
            model: summary.model.map(|model| model.name()),
            packets: counts.packets,
            returns: counts.returns,
            points: counts.points,
            sweeps: counts.sweeps,
            sweeps_complete: counts.sweeps_complete,
            lost: counts.lost,
            late: counts.late,
            duplicate: counts.duplicate,
            rejected: counts.rejected.iter().collect(),
            first_ns: summary.first.map(Stamp::as_nanos),
            last_ns: summary.last.map(Stamp::as_nanos),
            port: summary.port,
            restarts: counts.restarts,
            clock_steps: counts.clock_steps,
            skipped: SkippedReport {
                other_port: summary.other_ports + skipped.other_port,
                not_udp: skipped.not_udp,
                fragments: skipped.fragments,
                cut: skipped.cut,
            },
        }
    }
}

/// A survey of any sensor, or of the one that `angles` is a table of.
pub(super) fn survey(
    path: &Path,
    angles: Option<&Path>,
    sensor: impl FnOnce() -> Result<Option<SensorFound>, InspectError>,
) -> Result<Survey, InspectError> {
    let Some(angles) = angles else {
        return Ok(Survey::new());
    };
    let Some(SensorFound { model, port }) = sensor()? else {
        return Ok(Survey::new());
    };
    let options = DecoderOptions {
        correction: load_correction(angles, model)?,
        ..DecoderOptions::new(model)
    };
    Survey::of(port, options).map_err(|source| InspectError::Options {
        path: path.to_owned(),
        source,
    })
}

pub(super) fn inspect(
    path: &Path,
    options: &Options,
    progress: &dyn Fn(u64),
    faults: &mut Vec<InspectError>,
) -> Result<LidarReport, InspectError> {
    let mut survey = survey(path, options.angles.as_deref(), || find_sensor(path))?;
    let file = BufReader::with_capacity(BUFFER_LEN, Watched::open(path, progress)?);
    let mut reader = Reader::new(file).map_err(InspectError::capture(path))?;
    if let Err(error) = survey.read(&mut reader) {
        faults.push(InspectError::capture(path)(error));
    }
    Ok(LidarReport::new(&survey.summary(), reader.skipped()))
}

//! Which LiDAR sent a capture, and the tables of one unit.

use std::fs;
use std::io::BufReader;
use std::path::Path;

use noctule_hesai::pcap::Reader;
use noctule_hesai::{Correction, FireTimes, Model, Packet};
use noctule_recording::Recording;

use super::{InspectError, Watched};

/// Who sends the packets of a capture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SensorFound {
    /// The sensor.
    pub model: Model,
    /// UDP port it sends to.
    pub port: u16,
}

impl SensorFound {
    /// The sender of this datagram, if it is a valid packet of a known model.
    #[must_use]
    pub fn in_datagram(port: u16, payload: &[u8]) -> Option<Self> {
        let model = Model::identify(payload).ok()?;
        Packet::new(model, payload).ok()?;
        Some(Self { model, port })
    }
}

/// Reads a capture up to its first valid packet; `None` when there is none before its end or its
/// first fault.
///
/// # Errors
/// When the file cannot be opened or is no capture.
pub fn find_sensor(path: &Path) -> Result<Option<SensorFound>, InspectError> {
    let file = BufReader::new(Watched::open(path, &|_| {})?);
    let mut reader = Reader::new(file).map_err(InspectError::capture(path))?;
    while let Ok(Some(datagram)) = reader.next_datagram() {
        let found = SensorFound::in_datagram(datagram.dst_port, datagram.payload);
        if found.is_some() {
            return Ok(found);
        }
    }
    Ok(None)
}

/// The LiDAR of a recording, by its first valid packet; `None` as in [`find_sensor`].
///
/// # Errors
/// When the recording has no LiDAR datagrams, or they cannot be opened.
pub fn find_recorded_sensor(recording: &Recording) -> Result<Option<SensorFound>, InspectError> {
    let mut stream = recording.datagrams()?;
    while let Ok(Some(datagram)) = stream.next_datagram() {
        let found = SensorFound::in_datagram(datagram.dst_port, datagram.payload);
        if found.is_some() {
            return Ok(found);
        }
    }
    Ok(None)
}

/// Reads a unit's angle table.
///
/// # Errors
/// When the file cannot be read or is no table of that model.
pub fn load_correction(path: &Path, model: Model) -> Result<Correction, InspectError> {
    Correction::from_csv(model, &text(path)?).map_err(|source| InspectError::Table {
        path: path.to_owned(),
        source,
    })
}

/// Reads a fire-time table.
///
/// # Errors
/// When the file cannot be read or is no table of that model.
pub fn load_fire_times(path: &Path, model: Model) -> Result<FireTimes, InspectError> {
    FireTimes::from_csv(model, &text(path)?).map_err(|source| InspectError::Table {
        path: path.to_owned(),
        source,
    })
}

fn text(path: &Path) -> Result<String, InspectError> {
    fs::read_to_string(path).map_err(InspectError::io(path, 0))
}

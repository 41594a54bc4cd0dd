//! LiDAR packets, decoded to returns, to a cloud.

use std::fs;
use std::io::BufReader;
use std::path::Path;

use noctule_hesai::pcap::Reader;
use noctule_hesai::{Decoder, Options};
use noctule_recording::Recording;
use noctule_sensor::Return;

use super::cloud::Cloud;
use super::{ExportError, Exported, Request, Target};
use crate::inspect::{
    InspectError, Kind, SensorFound, Watched, find_recorded_sensor, find_sensor, load_correction,
    load_fire_times,
};

pub(super) fn export(
    request: &Request,
    kind: Kind,
    target: Target,
    progress: &dyn Fn(u64),
) -> Result<Exported, ExportError> {
    let path = &request.from;
    let recording = match kind {
        Kind::Recording => Some(Recording::open(path)?),
        Kind::Raw | Kind::Capture => None,
    };
    let sensor = match &recording {
        Some(recording) => find_recorded_sensor(recording)?,
        None => find_sensor(path)?,
    };
    let no_sensor = || ExportError::NoSensor { path: path.clone() };
    let sensor = sensor.ok_or_else(no_sensor)?;
    let options = options(request, recording.as_ref(), sensor)?;
    let decoder = Decoder::new(options).map_err(|source| InspectError::Options {
        path: path.clone(),
        source,
    })?;
    let mut points = Points {
        decoder,
        sweep: request.lidar.sweep,
        cloud: Cloud::create(&request.to, target)?,
    };
    let faults = match recording {
        Some(recording) => points.take_recording(&recording, progress)?,
        None => points.take_capture(path, sensor.port, progress)?,
    };
    let (written, counts) = (points.cloud.written(), points.decoder.counts());
    let lost = Some(("lost", counts.lost)).filter(|(_, lost)| *lost > 0);
    let undecoded = counts.rejected.iter().chain(lost).collect();
    match points.sweep {
        Some(sweep) if written == 0 => Err(ExportError::NoSweep {
            path: path.clone(),
            sweep,
            sweeps: counts.sweeps,
        }),
        _ => {
            points.cloud.finish()?;
            Ok(Exported {
                written,
                unit: "points",
                undecoded,
                faults,
            })
        }
    }
}

/// The decoder's settings: tables given, else the recording's own, else the model's.
fn options(
    request: &Request,
    recording: Option<&Recording>,
    SensorFound { model, .. }: SensorFound,
) -> Result<Options, ExportError> {
    let lidar = &request.lidar;
    let mut options = Options {
        returns: lidar.returns,
        ..Options::new(model)
    };
    let own = recording.and_then(|recording| {
        let name = recording.calibration()?.lidar_angles.as_deref()?;
        Some(recording.path().join(name)).filter(|path| fs::exists(path).unwrap_or(false))
    });
    if let Some(path) = lidar.angles.as_ref().or(own.as_ref()) {
        options.correction = load_correction(path, model)?;
    }
    if let Some(path) = &lidar.fire_times {
        options.fire_times = load_fire_times(path, model)?;
    }
    Ok(options)
}

/// Decodes packet by packet.
struct Points {
    decoder: Decoder,
    sweep: Option<u32>,
    cloud: Cloud,
}

impl Points {
    fn packet(&mut self, payload: &[u8]) {
        let Self {
            decoder,
            sweep,
            cloud,
        } = self;
        let mut sink = |r: Return, of: u32| {
            if sweep.is_none_or(|sweep| sweep == of) {
                cloud.put(&r);
            }
        };
        // Datagrams that are no packets are the sensor's other messages; inspect counts them.
        let _counted = decoder.decode(payload, &mut sink);
    }

    fn take_capture(
        &mut self,
        path: &Path,
        port: u16,
        progress: &dyn Fn(u64),
    ) -> Result<Vec<InspectError>, ExportError> {
        let file = BufReader::with_capacity(256 << 10, Watched::open(path, progress)?);
        let mut reader = Reader::new(file).map_err(InspectError::capture(path))?;
        reader.set_port(Some(port));
        while !self.cloud.has_failed() {
            match reader.next_datagram() {
                Ok(None) => break,
                Ok(Some(datagram)) => self.packet(datagram.payload),
                Err(error) => return Ok(vec![InspectError::capture(path)(error)]),
            }
        }
        Ok(Vec::new())
    }

    fn take_recording(
        &mut self,
        recording: &Recording,
        progress: &dyn Fn(u64),
    ) -> Result<Vec<InspectError>, ExportError> {
        let mut stream = recording.datagrams()?;
        while !self.cloud.has_failed() {
            match stream.next_datagram() {
                Ok(None) => break,
                Ok(Some(datagram)) => {
                    progress(datagram.payload.len() as u64);
                    self.packet(datagram.payload);
                }
                Err(error) => return Ok(vec![error.into()]),
            }
        }
        let fault = InspectError::of_lidar(recording.path(), stream.faults());
        Ok(fault.into_iter().collect())
    }
}

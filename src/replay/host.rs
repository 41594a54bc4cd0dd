//! The host on a recording: opens its streams, starts a thread for each, runs to the end.

use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::thread;

use noctule_hesai::{Correction, FireTimes, Model, Options};
use noctule_recording::{Missing, Recording, RecordingError};
use noctule_sensor::{Realtime, Stamp};

use crate::bus::BusError;
use crate::config::Config;
use crate::host::{
    Assembler, EventBlock, HostReport, ImageBlock, Lanes, MotionBlock, Outlet, ReturnBlock, Rig,
    RigError,
};
use crate::ingest::{self, Flow, IngestError, Ingested, Pace, Pacer};
use crate::lane::{WhenFull, lane};
use crate::latency::{StageRow, monotonic_ns};

/// Why a recording could not be replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The recording.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The rig.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// A stream.
    #[error(transparent)]
    Ingest(#[from] IngestError),
    /// The bus.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// A LiDAR table.
    #[error("{path}: {cause}")]
    Table {
        /// Which file.
        path: String,
        /// Why it is refused.
        cause: String,
    },
    /// No packet of the capture is from a sensor that is known.
    #[error("{path}: no packet of a known LiDAR model (set lidar.model to say which)")]
    UnknownLidar {
        /// The capture.
        path: String,
    },
    /// Nothing is known of how the file should be opened.
    #[error("{path}: neither a recording directory nor a RAW or pcap file: {cause}")]
    Unknown {
        /// What was given.
        path: String,
        /// Why.
        cause: String,
    },
    /// A thread of the host died.
    #[error("the {0} thread panicked")]
    Thread(&'static str),
    /// A child process.
    #[error(transparent)]
    Supervise(#[from] crate::supervise::SuperviseError),
    /// The inference process never came up.
    #[error("inference was not ready after {0:?}")]
    NotReady(std::time::Duration),
    /// The program's own path.
    #[error("finding this program: {0}")]
    Program(std::io::Error),
}

/// How the host runs.
#[derive(Debug, Clone, Copy)]
pub struct HostOptions {
    /// How fast the recording is let through.
    pub pace: Pace,
    /// See [`Flow::piece_bytes`].
    pub piece_bytes: Option<usize>,
}

/// A recording, opened, with everything the host must know before the first byte.
#[derive(Debug)]
pub struct Prepared {
    recording: Recording,
    rig: Rig,
    lidar: Option<Options>,
    origin: Stamp<Realtime>,
}

impl Prepared {
    /// Opens a recording directory, a RAW file or a packet capture.
    ///
    /// # Errors
    /// When it cannot be opened or run.
    pub fn open(path: &Path, config: &Config) -> Result<Self, ReplayError> {
        Self::new(open_any(path)?, config)
    }

    /// Prepares an opened recording.
    ///
    /// # Errors
    /// When it cannot be run.
    pub fn new(recording: Recording, config: &Config) -> Result<Self, ReplayError> {
        let lidar = lidar_options(&recording, config)?;
        let correction = lidar.as_ref().map(|o| &o.correction);
        let rig = Rig::new(
            config,
            recording.meta(),
            recording.calibration(),
            correction,
        )?;
        let origin = first_arrival(&recording)?;
        Ok(Self {
            recording,
            rig,
            lidar,
            origin,
        })
    }

    /// The recording.
    #[must_use]
    pub fn recording(&self) -> &Recording {
        &self.recording
    }

    /// The rig.
    #[must_use]
    pub fn rig(&self) -> &Rig {
        &self.rig
    }

    /// What the recording lacks, in words.
    #[must_use]
    pub fn missing(&self) -> Vec<String> {
        self.recording
            .missing()
            .iter()
            .map(Missing::to_string)
            .collect()
    }
}

fn open_any(path: &Path) -> Result<Recording, ReplayError> {
    if path.is_dir() {
        return Ok(Recording::open(path)?);
    }
    let mut start = [0; 4];
    let read = std::fs::File::open(path)
        .and_then(|mut file| std::io::Read::read(&mut file, &mut start))
        .map_err(|cause| ReplayError::Unknown {
            path: path.display().to_string(),
            cause: cause.to_string(),
        })?;
    Ok(if is_capture(&start[..read]) {
        Recording::from_pcap(path)?
    } else {
        Recording::from_raw_file(path)?
    })
}

/// Whether a file that starts with these bytes is a packet capture: pcap with stamps of either
/// resolution in either byte order, or pcapng.
#[must_use]
pub fn is_capture(start: &[u8]) -> bool {
    const MAGICS: [[u8; 4]; 3] = [
        [0xa1, 0xb2, 0xc3, 0xd4],
        [0xa1, 0xb2, 0x3c, 0x4d],
        [0x0a, 0x0d, 0x0d, 0x0a],
    ];
    MAGICS
        .iter()
        .any(|magic| start == magic || start.iter().rev().eq(magic))
}

fn lidar_options(recording: &Recording, config: &Config) -> Result<Option<Options>, ReplayError> {
    let Some(meta) = &recording.meta().lidar else {
        return Ok(None);
    };
    let named = match config.lidar.model.as_str() {
        "auto" => Model::from_name(&meta.model),
        name => Model::from_name(name),
    };
    let unknown = || ReplayError::UnknownLidar {
        path: recording.path().display().to_string(),
    };
    let model = match named {
        Some(model) => model,
        None => detect(recording)?.ok_or_else(unknown)?,
    };
    let mut options = Options::new(model);
    let read = |path: &Path| {
        std::fs::read_to_string(path).map_err(|e| ReplayError::Table {
            path: path.display().to_string(),
            cause: e.to_string(),
        })
    };
    let refused = |path: String| {
        move |e: noctule_hesai::TableError| ReplayError::Table {
            path,
            cause: e.to_string(),
        }
    };
    if let Some(path) = &config.lidar.angles {
        options.correction = Correction::from_csv(model, &read(path)?)
            .map_err(refused(path.display().to_string()))?;
    } else if let Some(bytes) = recording.lidar_angles()? {
        let text = String::from_utf8_lossy(&bytes);
        options.correction = Correction::from_csv(model, &text).map_err(refused(format!(
            "{}: angle table",
            recording.path().display()
        )))?;
    }
    if let Some(path) = &config.lidar.fire_times {
        options.fire_times = FireTimes::from_csv(model, &read(path)?)
            .map_err(refused(path.display().to_string()))?;
    }
    Ok(Some(options))
}

/// The model of the first packet that is one.
fn detect(recording: &Recording) -> Result<Option<Model>, ReplayError> {
    let mut datagrams = recording.datagrams()?;
    while let Some(datagram) = datagrams.next_datagram()? {
        if let Some(model) = Model::detect(datagram.payload) {
            return Ok(Some(model));
        }
    }
    Ok(None)
}

/// The earliest arrival of any stream: where replay time begins.
fn first_arrival(recording: &Recording) -> Result<Stamp<Realtime>, ReplayError> {
    let meta = recording.meta();
    let mut first = Stamp::MAX;
    if meta.events.is_some()
        && let Some(transfer) = recording.event_transfers()?.next_transfer()?
    {
        first = first.min(transfer.arrival);
    }
    if meta.lidar.is_some()
        && let Some(datagram) = recording.datagrams()?.next_datagram()?
    {
        first = first.min(datagram.t);
    }
    if meta.camera.is_some()
        && let Some(row) = recording.images()?.next()
    {
        first = first.min(row?.stamp.arrival);
    }
    Ok(if first == Stamp::MAX {
        Stamp::ZERO
    } else {
        first
    })
}

/// Runs the host over the whole recording on this thread, one more per stream.
///
/// # Errors
/// When a stream or the outlet fails.
pub fn run_host<O: Outlet>(
    prepared: &Prepared,
    config: &Config,
    outlet: O,
    options: HostOptions,
    stop: &AtomicBool,
) -> Result<HostReport, ReplayError> {
    let mut assembler = Assembler::new(&prepared.rig, outlet)?;
    // Threads are up before the first delivery is due.
    let start_ns = monotonic_ns() + 50_000_000;
    let flow = Flow {
        pacer: Pacer::new(options.pace, prepared.origin, start_ns),
        when_full: WhenFull::Wait,
        piece_bytes: options.piece_bytes,
        stop,
    };
    let ingested = thread::scope(|scope| {
        let (lanes, running) = start_streams(scope, prepared, config, flow)?;
        let merged = crate::host::run(&mut assembler, lanes, stop);
        let mut ingested = Vec::new();
        for (name, handle) in running {
            ingested.push(handle.join().map_err(|_| ReplayError::Thread(name))??);
        }
        merged?;
        Ok::<_, ReplayError>(ingested)
    })?;
    Ok(report(&assembler, ingested))
}

type Running<'scope> = Vec<(
    &'static str,
    thread::ScopedJoinHandle<'scope, Result<Ingested, IngestError>>,
)>;

fn start_streams<'scope, 'env>(
    scope: &'scope thread::Scope<'scope, 'env>,
    prepared: &'env Prepared,
    config: &'env Config,
    flow: Flow<'env>,
) -> Result<(Lanes, Running<'scope>), ReplayError> {
    let host = thread::current();
    let recording = &prepared.recording;
    let meta = recording.meta();
    let sizes = &config.lanes;
    let (mut lanes, mut running) = (Lanes::default(), Vec::new());
    if meta.events.is_some() {
        let transfers = recording.event_transfers()?;
        let (producer, consumer) = lane(sizes.event_blocks, host.clone(), EventBlock::new);
        lanes.events = Some(consumer);
        let handle = scope.spawn(move || ingest::run_events(transfers, producer, flow));
        running.push(("events", handle));
    }
    if let Some(options) = prepared.lidar.clone() {
        let datagrams = recording.datagrams()?;
        let (producer, consumer) = lane(sizes.lidar_packets, host.clone(), ReturnBlock::new);
        lanes.lidar = Some(consumer);
        let handle = scope.spawn(move || ingest::run_lidar(datagrams, options, producer, flow));
        running.push(("lidar", handle));
    }
    if let Some(camera) = &meta.camera {
        let bytes = camera.width as usize * camera.height as usize * 3;
        let (producer, consumer) = lane(sizes.images, host.clone(), || ImageBlock::new(bytes));
        lanes.images = Some(consumer);
        let handle = scope.spawn(move || ingest::run_camera(recording, producer, flow));
        running.push(("images", handle));
    }
    if meta.can.is_some() || recording.clock_readings().is_ok() {
        let empty = || MotionBlock::Clocks {
            reading: crate::sync::ClockReading {
                realtime: Stamp::ZERO,
                monotonic: Stamp::ZERO,
                tai_offset_ns: 0,
            },
        };
        let (producer, consumer) = lane(sizes.motion, host, empty);
        lanes.motion = Some(consumer);
        let signals = meta.can.as_ref().map_or(&config.can, |can| &can.motion);
        let handle = scope.spawn(move || ingest::run_motion(recording, signals, producer, flow));
        running.push(("motion", handle));
    }
    Ok((lanes, running))
}

fn report<O: Outlet>(assembler: &Assembler<O>, ingested: Vec<Ingested>) -> HostReport {
    let bundles = assembler.bundle_report();
    let latency = &assembler.latency;
    let stage =
        |name: &str, l| StageRow::new(name, bundles.exposures - bundles.discarded, bundles.sent, l);
    let timeline = assembler.timeline();
    let counts = timeline.counts();
    let evk4 = timeline.evk4_to_tai().map(|(map, _)| map);
    HostReport {
        streams: ingested.iter().map(|i| i.row.clone()).collect(),
        details: ingested
            .iter()
            .map(|i| {
                let named = i
                    .details
                    .iter()
                    .map(|(name, count)| ((*name).to_owned(), *count));
                (i.row.stream.to_owned(), named.collect())
            })
            .collect(),
        bundles,
        raster: assembler.raster_report(),
        stages: vec![
            stage("close -> decided", &latency.close_to_decided),
            stage("decided -> sent", &latency.decided_to_sent),
            stage("last input -> sent", &latency.inputs_to_sent),
            stage("close -> bundle sent", &latency.close_to_sent),
        ],
        epochs: [counts.host, counts.evk4, counts.lidar, counts.strobe]
            .map(|c| c.backwards + c.steps),
        evk4_uncertainty_ns: evk4
            .zip(assembler.events_passed())
            .map(|(map, passed)| map.uncertainty_at(passed)),
        lidar_uncertainty_ns: timeline.lidar_to_tai().map(|map| map.uncertainty_ns),
    }
}

//! A recording directory in numbers, stream by stream, and what it lacks.

use std::path::Path;

use noctule_camera::SequenceMonitor;
use noctule_can::MotionDecoder;
use noctule_hesai::Survey;
use noctule_recording::{Faults, Missing, RECORDING_SCHEMA, Recording, RecordingError};
use serde::Serialize;

use super::lidar::survey;
use super::pulses::Pulses;
use super::raw::Tap;
use super::{
    ExposureReport, InspectError, LidarReport, Options, RawReport, TruthReport,
    find_recorded_sensor,
};

/// Files of the recording schema that faults are reported against.
pub(super) const EVENTS_FILE: &str = "raw/events.raw";
pub(super) const LIDAR_FILE: &str = "raw/lidar.pcap";
const IMAGES_FILE: &str = "raw/rgb.csv";
const CAN_FILE: &str = "raw/can.log";
const CLOCKS_FILE: &str = "raw/clocks.csv";
const EXPOSURES_FILE: &str = "truth/exposures.csv";

/// Everything a recording holds. A stream that is absent or cannot be opened is null.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecordingReport {
    /// Name of the sequence.
    pub name: String,
    /// Version of the recording format.
    pub schema: u64,
    /// The program that made it up; null for a real recording.
    pub generator: Option<GeneratorReport>,
    /// Steps per exposure.
    pub steps: u32,
    /// The event stream.
    pub events: Option<RawReport>,
    /// How the event stream arrived.
    pub transfers: Option<TransferReport>,
    /// The LiDAR.
    pub lidar: Option<LidarReport>,
    /// The long-exposure images.
    pub images: Option<ImageReport>,
    /// The vehicle's bus.
    pub can: Option<CanReport>,
    /// Exposures by the strobe's edges.
    pub exposures: ExposureReport,
    /// Readings of the host's clocks.
    pub clocks: Option<ClockReport>,
    /// Samples with truth.
    pub samples: u64,
    /// What a recording could have and this one does not: `end` (it was interrupted),
    /// `calibration`, `events`, `event_arrivals`, `images`, `lidar`, `lidar_angles`, `can`,
    /// `clock_readings`, `truth_exposures`, `truth_clocks`, `samples`.
    pub missing: Vec<&'static str>,
}

/// The program that made up a synthetic recording.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct GeneratorReport {
    /// Its name.
    pub name: String,
    /// Its version.
    pub version: String,
    /// What it started from.
    pub seed: u64,
}

/// USB transfers of the event stream.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct TransferReport {
    /// Transfers.
    pub count: u64,
    /// Their bytes.
    pub bytes: u64,
    /// Arrival of the first, nanoseconds of the host's realtime clock.
    pub first_ns: Option<u64>,
    /// Arrival of the last, nanoseconds of the host's realtime clock.
    pub last_ns: Option<u64>,
}

/// Images by the driver's counter.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct ImageReport {
    /// Images there are.
    pub count: u64,
    /// Numbers of the driver's counter that never came.
    pub lost: u64,
    /// Images that came after a later one.
    pub late: u64,
    /// Images that came twice.
    pub duplicate: u64,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Driver's stamp of the first, nanoseconds of the host's monotonic clock.
    pub first_ns: Option<u64>,
    /// Driver's stamp of the last, nanoseconds of the host's monotonic clock.
    pub last_ns: Option<u64>,
}

/// Frames of the vehicle's bus.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct CanReport {
    /// All frames.
    pub frames: u64,
    /// Samples of speed and yaw rate that the frames make.
    pub motion: u64,
    /// Frames that carry a signal of the motion.
    pub used: u64,
    /// Frames of other messages.
    pub unknown: u64,
    /// Frames too short for their signal.
    pub short: u64,
    /// Remote requests.
    pub remote: u64,
    /// Error reports of the bus.
    pub errors: u64,
    /// Signals whose partner was not there yet or too old.
    pub unpaired: u64,
    /// Arrival of the first, nanoseconds of the host's realtime clock.
    pub first_ns: Option<u64>,
    /// Arrival of the last, nanoseconds of the host's realtime clock.
    pub last_ns: Option<u64>,
}

/// Readings of the host's clocks.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct ClockReport {
    /// Readings.
    pub readings: u64,
    /// Readings with the network card's clock.
    pub phc_readings: u64,
    /// TAI - UTC of the last reading, seconds; 0 when the kernel was not told.
    pub tai_offset_s: i32,
    /// First reading, nanoseconds of the host's realtime clock.
    pub first_ns: Option<u64>,
    /// Last reading, nanoseconds of the host's realtime clock.
    pub last_ns: Option<u64>,
}

pub(super) fn inspect(
    path: &Path,
    options: &Options,
    progress: &dyn Fn(u64),
    faults: &mut Vec<InspectError>,
) -> Result<RecordingReport, InspectError> {
    let recording = Recording::open(path)?;
    let meta = recording.meta();
    let missing = recording.missing();
    let mut streams = Streams {
        recording: &recording,
        missing: &missing,
        options,
        progress,
        faults,
    };
    let lidar = streams.lidar()?;
    let (events, transfers, exposures) = streams.events();
    let report = RecordingReport {
        name: meta.name.clone(),
        schema: RECORDING_SCHEMA,
        generator: meta.generator.as_ref().map(|generator| GeneratorReport {
            name: generator.name.clone(),
            version: generator.version.clone(),
            seed: generator.seed,
        }),
        steps: meta.steps,
        events,
        transfers,
        lidar,
        images: streams.images(),
        can: streams.can(),
        exposures: ExposureReport {
            truth: streams.truth(),
            ..exposures
        },
        clocks: streams.clocks(),
        samples: recording.samples()?.len() as u64,
        missing: missing.iter().map(|&missing| key(missing)).collect(),
    };
    Ok(report)
}

/// Reads one stream after the other; what goes wrong in one leaves the others alone.
struct Streams<'a> {
    recording: &'a Recording,
    missing: &'a [Missing],
    options: &'a Options,
    progress: &'a dyn Fn(u64),
    faults: &'a mut Vec<InspectError>,
}

impl Streams<'_> {
    /// The stream, unless it is missing or cannot be opened.
    fn open<T>(
        &mut self,
        missing: Missing,
        open: impl FnOnce(&Recording) -> Result<T, RecordingError>,
    ) -> Option<T> {
        if self.missing.contains(&missing) {
            return None;
        }
        let opened = open(self.recording);
        opened.map_err(|error| self.faults.push(error.into())).ok()
    }

    /// The items of a table up to its end or its first fault.
    fn rows<T>(
        &mut self,
        table: &mut impl Iterator<Item = Result<T, RecordingError>>,
        mut take: impl FnMut(T),
    ) {
        for row in table {
            match row {
                Ok(row) => take(row),
                Err(error) => self.faults.push(error.into()),
            }
        }
    }

    fn note(&mut self, file: &str, faults: Faults) {
        let dir = self.recording.path();
        self.faults.extend(InspectError::stream(dir, file, faults));
    }

    fn events(&mut self) -> (Option<RawReport>, Option<TransferReport>, ExposureReport) {
        let meta = self.recording.meta();
        let strobe = meta.events.as_ref().and_then(|events| events.strobe);
        let mut tap = Tap::new(strobe.as_ref().map(Pulses::new));
        let Some(mut stream) = self.open(Missing::Events, Recording::event_transfers) else {
            return (None, None, ExposureReport::default());
        };
        let (format, geometry) = (stream.header().format, stream.header().geometry);
        let mut decoder = noctule_evk4::Decoder::new(format, geometry);
        let mut transfers = TransferReport::default();
        loop {
            match stream.next_transfer() {
                Ok(None) => break,
                Ok(Some(transfer)) => {
                    let len = transfer.bytes.len() as u64;
                    transfers.count += 1;
                    transfers.bytes += len;
                    span(
                        &mut transfers.first_ns,
                        &mut transfers.last_ns,
                        transfer.arrival.as_nanos(),
                    );
                    (self.progress)(len);
                    decoder.decode(transfer.bytes, &mut tap);
                }
                Err(error) => {
                    self.faults.push(error.into());
                    break;
                }
            }
        }
        decoder.finish();
        self.note(EVENTS_FILE, stream.faults());
        let exposures = tap.pulses.as_ref().map(Pulses::report).unwrap_or_default();
        let report = tap.report(format, geometry, &decoder);
        (Some(report), Some(transfers), exposures)
    }

    /// Errs only where a table of angles is unusable.
    fn lidar(&mut self) -> Result<Option<LidarReport>, InspectError> {
        let Some(mut stream) = self.open(Missing::Lidar, Recording::datagrams) else {
            return Ok(None);
        };
        let mut survey = self.survey()?;
        loop {
            match stream.next_datagram() {
                Ok(None) => break,
                Ok(Some(datagram)) => {
                    (self.progress)(datagram.payload.len() as u64);
                    survey.datagram(datagram.dst_port, datagram.payload);
                }
                Err(error) => {
                    self.faults.push(error.into());
                    break;
                }
            }
        }
        self.note(LIDAR_FILE, stream.faults());
        Ok(Some(LidarReport::new(&survey.summary(), stream.skipped())))
    }

    /// With the table given, else with the recording's own, else with the model's.
    fn survey(&mut self) -> Result<Survey, InspectError> {
        let recording = self.recording;
        let dir = recording.path();
        let own = recording
            .calibration()
            .and_then(|c| c.lidar_angles.as_deref());
        let own = own
            .filter(|_| !self.missing.contains(&Missing::LidarAngles))
            .map(|name| dir.join(name));
        let path = dir.join(LIDAR_FILE);
        let given = self.options.angles.as_deref();
        let made = survey(&path, given.or(own.as_deref()), || {
            find_recorded_sensor(recording)
        });
        match made {
            // A bad table inside the recording is a fault of the recording.
            Err(error) if given.is_none() => {
                self.faults.push(error);
                Ok(Survey::new())
            }
            made => made,
        }
    }

    fn images(&mut self) -> Option<ImageReport> {
        let camera = self.recording.meta().camera.as_ref()?;
        let mut report = ImageReport {
            width: camera.width,
            height: camera.height,
            ..ImageReport::default()
        };
        let mut table = self.open(Missing::Images, Recording::images)?;
        let mut monitor = SequenceMonitor::new();
        self.rows(&mut table, |row| {
            monitor.push(row.stamp.sequence);
            let driver_ns = row.stamp.driver.as_nanos();
            span(&mut report.first_ns, &mut report.last_ns, driver_ns);
        });
        self.note(IMAGES_FILE, table.faults());
        let counts = monitor.counts();
        Some(ImageReport {
            count: counts.received,
            lost: counts.lost,
            late: counts.late,
            duplicate: counts.duplicate,
            ..report
        })
    }

    fn can(&mut self) -> Option<CanReport> {
        let can = self.recording.meta().can.as_ref()?;
        // The signals were checked when meta.json was read.
        let mut decoder = MotionDecoder::new(&can.motion).ok()?;
        let mut report = CanReport::default();
        let mut log = self.open(Missing::Can, Recording::can_frames)?;
        self.rows(&mut log, |record| {
            report.frames += 1;
            let motion = decoder.push(&record.frame, record.arrival);
            report.motion += u64::from(motion.is_some());
            let arrival_ns = record.arrival.as_nanos();
            span(&mut report.first_ns, &mut report.last_ns, arrival_ns);
        });
        self.note(CAN_FILE, log.faults());
        let counts = decoder.counts();
        Some(CanReport {
            used: counts.used,
            unknown: counts.unknown,
            short: counts.short,
            remote: counts.remote,
            errors: counts.error,
            unpaired: counts.unpaired,
            ..report
        })
    }

    fn clocks(&mut self) -> Option<ClockReport> {
        let mut table = self.open(Missing::ClockReadings, Recording::clock_readings)?;
        let mut report = ClockReport::default();
        self.rows(&mut table, |reading| {
            report.readings += 1;
            report.phc_readings += u64::from(reading.phc.is_some());
            report.tai_offset_s = reading.tai_offset_s;
            let realtime_ns = reading.realtime.as_nanos();
            span(&mut report.first_ns, &mut report.last_ns, realtime_ns);
        });
        self.note(CLOCKS_FILE, table.faults());
        Some(report)
    }

    fn truth(&mut self) -> Option<TruthReport> {
        let mut table = self.open(Missing::TruthExposures, Recording::exposures_truth)?;
        let mut report = TruthReport::default();
        self.rows(&mut table, |truth| report.add(&truth));
        self.note(EXPOSURES_FILE, table.faults());
        Some(report)
    }
}

/// The first value stays, the last is replaced.
fn span(first: &mut Option<u64>, last: &mut Option<u64>, now: u64) {
    first.get_or_insert(now);
    *last = Some(now);
}

/// A missing part's name in reports.
const fn key(missing: Missing) -> &'static str {
    match missing {
        Missing::End => "end",
        Missing::Calibration => "calibration",
        Missing::Events => "events",
        Missing::EventArrivals => "event_arrivals",
        Missing::Images => "images",
        Missing::Lidar => "lidar",
        Missing::LidarAngles => "lidar_angles",
        Missing::Can => "can",
        Missing::ClockReadings => "clock_readings",
        Missing::TruthExposures => "truth_exposures",
        Missing::TruthClocks => "truth_clocks",
        Missing::Samples => "samples",
    }
}

//! Opens a recording and says what is in it.

use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

use noctule_evk4::Geometry;

use crate::can::CanFrames;
use crate::clocks::{ClockReadings, TruthClocks};
use crate::datagrams::Datagrams;
use crate::exposure::ExposureTruths;
use crate::image::ImageRows;
use crate::layout;
use crate::meta::{MetaFile, RECORDING_SCHEMA, SchemaOnly};
use crate::picture::read_rgb8;
use crate::truth;
use crate::writer::sha256_hex;
use crate::{
    Calibration, Counts, EventTransfers, EventsMeta, FieldError, GridSize, LidarMeta, Meta,
    RecordingError, Rectangle, SampleTruth,
};

/// Something a recording could have and does not.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Missing {
    /// The recording was interrupted: `meta.json` has no counts.
    End,
    /// Lenses and poses.
    Calibration,
    /// The event stream.
    Events,
    /// When the event stream's bytes arrived; arrivals are made up from sensor time.
    EventArrivals,
    /// Images.
    Images,
    /// LiDAR datagrams.
    Lidar,
    /// The angle table that the calibration names.
    LidarAngles,
    /// CAN frames.
    Can,
    /// Readings of the host's clocks.
    ClockReadings,
    /// True exposures.
    TruthExposures,
    /// True clocks.
    TruthClocks,
    /// Samples with their truth.
    Samples,
}

impl fmt::Display for Missing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::End => "its end: it was interrupted",
            Self::Calibration => "calibration",
            Self::Events => "events",
            Self::EventArrivals => "arrivals of events: made up from sensor time",
            Self::Images => "images",
            Self::Lidar => "lidar datagrams",
            Self::LidarAngles => "the lidar's own angle table",
            Self::Can => "can frames",
            Self::ClockReadings => "clock readings",
            Self::TruthExposures => "true exposures",
            Self::TruthClocks => "true clocks",
            Self::Samples => "samples with truth",
        })
    }
}

/// Where the data is.
#[derive(Debug, Clone)]
enum Source {
    Directory(PathBuf),
    Raw {
        path: PathBuf,
        packets: Option<PathBuf>,
        fallback: Option<Geometry>,
    },
    Pcap(PathBuf),
}

/// A recording: a directory, or a lone file of one sensor.
///
/// Every reader it gives has its own file handles, can be sent to another thread, and hands over
/// what there is in the order in which it arrived.
#[derive(Debug, Clone)]
pub struct Recording {
    source: Source,
    meta: Meta,
    calibration: Option<Calibration>,
    counts: Option<Counts>,
}

impl Recording {
    /// Opens a recording directory; checks version, meta and calibration.
    ///
    /// # Errors
    /// When one of the two files cannot be read, is of another version, holds a value that cannot
    /// be, or they do not belong together.
    pub fn open(dir: &Path) -> Result<Self, RecordingError> {
        let file = read_meta(&dir.join(layout::META))?;
        let path = dir.join(layout::CALIBRATION);
        let text = fs::read_to_string(&path).map_err(|e| RecordingError::io(&path, e))?;
        let calibration = Calibration::parse(&text, &path)?;
        if sha256_hex(text.as_bytes()) != file.calibration_sha256 {
            let problem = "calib.toml has another hash";
            let error = FieldError::new("calibration_sha256", file.calibration_sha256, problem);
            return Err(RecordingError::field(&dir.join(layout::META), error));
        }
        Ok(Self {
            source: Source::Directory(dir.to_owned()),
            meta: file.recording,
            calibration: Some(calibration),
            counts: file.counts,
        })
    }

    /// Opens a lone RAW file. Where a `NAME.packets.csv` lies beside it, transfers and arrivals
    /// come from there (the driver's stamps); otherwise arrivals are made up from sensor time.
    ///
    /// # Errors
    /// When the file cannot be read or its header cannot be understood.
    pub fn from_raw_file(path: &Path) -> Result<Self, RecordingError> {
        Self::from_raw_file_with(path, None)
    }

    /// As [`from_raw_file`](Self::from_raw_file), with a sensor size for headers that give none.
    ///
    /// # Errors
    /// As [`from_raw_file`](Self::from_raw_file).
    pub fn from_raw_file_with(
        path: &Path,
        fallback: Option<Geometry>,
    ) -> Result<Self, RecordingError> {
        let packets = path.with_extension("packets.csv");
        let stream = EventTransfers::by_sensor_time(path, fallback)?;
        let header = stream.header();
        let serial = header.field("serial_number").unwrap_or_default().to_owned();
        let geometry = header.geometry;
        let (width, height) = (u32::from(geometry.width), u32::from(geometry.height));
        let mut meta = lone_meta(path, width, height);
        meta.events = Some(EventsMeta {
            serial,
            width,
            height,
            strobe: None,
        });
        Ok(Self {
            source: Source::Raw {
                path: path.to_owned(),
                packets: packets.is_file().then_some(packets),
                fallback,
            },
            meta,
            calibration: None,
            counts: None,
        })
    }

    /// Opens a lone capture of LiDAR datagrams.
    ///
    /// # Errors
    /// When the file cannot be read or is no capture.
    pub fn from_pcap(path: &Path) -> Result<Self, RecordingError> {
        let mut meta = lone_meta(path, 512, 512);
        meta.lidar = Some(LidarMeta {
            serial: String::new(),
            model: String::new(),
            port: 2368,
        });
        let recording = Self {
            source: Source::Pcap(path.to_owned()),
            meta,
            calibration: None,
            counts: None,
        };
        recording.datagrams()?;
        Ok(recording)
    }

    /// The directory, or the lone file.
    #[must_use]
    pub fn path(&self) -> &Path {
        match &self.source {
            Source::Directory(path) | Source::Raw { path, .. } | Source::Pcap(path) => path,
        }
    }

    /// What it says about itself; for a lone file, what follows from the file, with 8 steps and a
    /// 256x256 network grid over the whole sensor.
    #[must_use]
    pub const fn meta(&self) -> &Meta {
        &self.meta
    }

    /// Its calibration; a lone file has none.
    #[must_use]
    pub const fn calibration(&self) -> Option<&Calibration> {
        self.calibration.as_ref()
    }

    /// How much was written; `None` when it was interrupted, or is a lone file.
    #[must_use]
    pub const fn counts(&self) -> Option<&Counts> {
        self.counts.as_ref()
    }

    /// What it could have and does not, in a fixed order.
    #[must_use]
    pub fn missing(&self) -> Vec<Missing> {
        let dir = match &self.source {
            Source::Directory(dir) => dir,
            Source::Raw { packets, .. } => return lone_missing(Missing::Events, packets.is_some()),
            Source::Pcap(_) => return lone_missing(Missing::Lidar, true),
        };
        let (meta, there) = (&self.meta, |name: &str| dir.join(name).is_file());
        let angles = self
            .calibration
            .as_ref()
            .and_then(|c| c.lidar_angles.as_deref());
        let samples = truth::samples(dir).is_ok_and(|s| !s.is_empty());
        [
            (Missing::End, self.counts.is_some()),
            (
                Missing::Events,
                meta.events.is_some() && there(layout::EVENTS),
            ),
            (
                Missing::Images,
                meta.camera.is_some() && there(layout::IMAGE_ROWS),
            ),
            (Missing::Lidar, meta.lidar.is_some() && there(layout::LIDAR)),
            (Missing::LidarAngles, angles.is_none_or(there)),
            (Missing::Can, meta.can.is_some() && there(layout::CAN)),
            (Missing::ClockReadings, there(layout::CLOCKS)),
            (Missing::TruthExposures, there(layout::TRUTH_EXPOSURES)),
            (Missing::TruthClocks, there(layout::TRUTH_CLOCKS)),
            (Missing::Samples, samples),
        ]
        .into_iter()
        .filter_map(|(what, present)| (!present).then_some(what))
        .collect()
    }

    /// The event stream.
    ///
    /// # Errors
    /// When there is none, or its header or table cannot be understood.
    pub fn event_transfers(&self) -> Result<EventTransfers, RecordingError> {
        match &self.source {
            Source::Directory(dir) if let Some(events) = &self.meta.events => {
                let geometry = |n: u32| u16::try_from(n).unwrap_or(u16::MAX);
                let fallback = Geometry {
                    width: geometry(events.width),
                    height: geometry(events.height),
                };
                let counted = self.counts.map(|c| c.event_transfers);
                let len_max = self.counts.map_or(0, |c| c.event_transfer_len_max);
                let len_max = usize::try_from(len_max).unwrap_or(usize::MAX);
                EventTransfers::open(dir, Some(fallback), counted, len_max)
            }
            Source::Raw {
                path,
                packets: Some(packets),
                fallback,
            } => EventTransfers::with_packets(path, packets, *fallback),
            Source::Raw { path, fallback, .. } => EventTransfers::by_sensor_time(path, *fallback),
            _ => Err(self.absent(layout::EVENTS, "events")),
        }
    }

    /// The LiDAR's datagrams.
    ///
    /// # Errors
    /// When there are none or the capture cannot be understood.
    pub fn datagrams(&self) -> Result<Datagrams, RecordingError> {
        match (&self.source, &self.meta.lidar) {
            (Source::Pcap(path), _) => Datagrams::open(path),
            (Source::Directory(dir), Some(lidar)) => {
                let counted = self.counts.map(|c| c.datagrams);
                Datagrams::of_recording(&dir.join(layout::LIDAR), lidar.port, counted)
            }
            _ => Err(self.absent(layout::LIDAR, "lidar datagrams")),
        }
    }

    /// The images' stamps; [`read_image`](Self::read_image) gives the pixels.
    ///
    /// # Errors
    /// When there are none, or the table cannot be understood.
    pub fn images(&self) -> Result<ImageRows, RecordingError> {
        match self.directory() {
            Some(dir) if self.meta.camera.is_some() => {
                ImageRows::open(dir, self.counts.map(|c| c.images))
            }
            _ => Err(self.absent(layout::IMAGE_ROWS, "images")),
        }
    }

    /// Decodes image `index` (of its row) into `rgb8`, packed RGB8; `rgb8` is resized to fit and
    /// keeps its memory. Gives columns and rows.
    ///
    /// # Errors
    /// When there is no such image, it cannot be decoded, or it has another size than meta says.
    pub fn read_image(
        &self,
        index: u32,
        rgb8: &mut Vec<u8>,
    ) -> Result<(usize, usize), RecordingError> {
        let (Some(dir), Some(camera)) = (self.directory(), &self.meta.camera) else {
            return Err(self.absent(layout::IMAGES, "images"));
        };
        let path = layout::image(dir, index);
        let size = read_rgb8(&path, rgb8)?;
        let declared = (camera.width as usize, camera.height as usize);
        if size != declared {
            let problem = format!("size {size:?}, meta.json says {declared:?}");
            return Err(RecordingError::picture(&path, problem));
        }
        Ok(size)
    }

    /// The CAN frames.
    ///
    /// # Errors
    /// When there are none or the log cannot be opened.
    pub fn can_frames(&self) -> Result<CanFrames, RecordingError> {
        match self.directory() {
            Some(dir) if self.meta.can.is_some() => {
                CanFrames::open(dir, self.counts.map(|c| c.can_frames))
            }
            _ => Err(self.absent(layout::CAN, "can frames")),
        }
    }

    /// The readings of the host's clocks.
    ///
    /// # Errors
    /// When there are none or the table cannot be understood.
    pub fn clock_readings(&self) -> Result<ClockReadings, RecordingError> {
        let dir = self.present(layout::CLOCKS, "clock readings")?;
        ClockReadings::open(dir, self.counts.map(|c| c.clock_readings))
    }

    /// The true exposures.
    ///
    /// # Errors
    /// When there are none or the table cannot be understood.
    pub fn exposures_truth(&self) -> Result<ExposureTruths, RecordingError> {
        ExposureTruths::open(self.present(layout::TRUTH_EXPOSURES, "true exposures")?)
    }

    /// How the clocks truly ran.
    ///
    /// # Errors
    /// When nobody knows or the file cannot be understood.
    pub fn truth_clocks(&self) -> Result<TruthClocks, RecordingError> {
        let dir = self.present(layout::TRUTH_CLOCKS, "true clocks")?;
        TruthClocks::load(&dir.join(layout::TRUTH_CLOCKS))
    }

    /// Numbers of the samples that have truth, in order; empty when there are none.
    ///
    /// # Errors
    /// When the folder cannot be listed.
    pub fn samples(&self) -> Result<Vec<u32>, RecordingError> {
        self.directory().map_or(Ok(Vec::new()), truth::samples)
    }

    /// The truth of sample `index`.
    ///
    /// # Errors
    /// When there is no such sample.
    pub fn sample_truth(&self, index: u32) -> Result<SampleTruth, RecordingError> {
        SampleTruth::open(self.path(), index)
    }

    /// The LiDAR's own angle correction table (Hesai CSV); `None` when the calibration names none.
    ///
    /// # Errors
    /// When it names one that cannot be read.
    pub fn lidar_angles(&self) -> Result<Option<Vec<u8>>, RecordingError> {
        let name = self
            .calibration
            .as_ref()
            .and_then(|c| c.lidar_angles.as_deref());
        let (Some(dir), Some(name)) = (self.directory(), name) else {
            return Ok(None);
        };
        let path = dir.join(name);
        let bytes = fs::read(&path).map_err(|e| RecordingError::io(&path, e))?;
        Ok(Some(bytes))
    }

    fn directory(&self) -> Option<&Path> {
        match &self.source {
            Source::Directory(dir) => Some(dir),
            Source::Raw { .. } | Source::Pcap(_) => None,
        }
    }

    /// The directory, if it has the file.
    fn present(&self, name: &str, what: &'static str) -> Result<&Path, RecordingError> {
        self.directory()
            .filter(|dir| dir.join(name).is_file())
            .ok_or_else(|| self.absent(name, what))
    }

    fn absent(&self, name: &str, what: &'static str) -> RecordingError {
        let path = match &self.source {
            Source::Directory(dir) => dir.join(name),
            Source::Raw { path, .. } | Source::Pcap(path) => path.clone(),
        };
        RecordingError::Absent { path, what }
    }
}

fn read_meta(path: &Path) -> Result<MetaFile, RecordingError> {
    let text = fs::read_to_string(path).map_err(|e| RecordingError::io(path, e))?;
    let syntax = |error: serde_json::Error| RecordingError::Syntax {
        path: path.to_owned(),
        line: error.line(),
        problem: error.to_string(),
    };
    let found = serde_json::from_str::<SchemaOnly>(&text)
        .map_err(syntax)?
        .schema;
    if found != RECORDING_SCHEMA {
        return Err(RecordingError::Schema {
            path: path.to_owned(),
            found,
            supported: RECORDING_SCHEMA,
        });
    }
    let file: MetaFile = serde_json::from_str(&text).map_err(syntax)?;
    file.recording
        .validate()
        .map_err(|e| RecordingError::field(path, e.within("recording")))?;
    Ok(file)
}

/// What is known about a lone file.
fn lone_meta(path: &Path, width: u32, height: u32) -> Meta {
    let name = path.file_stem().unwrap_or_default();
    Meta {
        name: name.to_string_lossy().into_owned(),
        generator: None,
        split: None,
        steps: 8,
        crop: Rectangle {
            x: 0,
            y: 0,
            width,
            height,
        },
        network: GridSize {
            width: 256,
            height: 256,
        },
        events: None,
        camera: None,
        lidar: None,
        can: None,
    }
}

fn lone_missing(present: Missing, arrivals: bool) -> Vec<Missing> {
    use Missing as M;
    [
        M::Calibration,
        M::Events,
        M::EventArrivals,
        M::Images,
        M::Lidar,
        M::Can,
        M::ClockReadings,
        M::TruthExposures,
        M::TruthClocks,
        M::Samples,
    ]
    .into_iter()
    .filter(|&what| what != present && (what != M::EventArrivals || !arrivals))
    .collect()
}

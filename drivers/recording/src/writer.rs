//! Writes a recording as the sensors deliver, in bounded memory.

use std::fs::{self, File};
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use noctule_camera::FrameStamp;
use noctule_can::{Frame, Interface, Record};
use noctule_evk4::RawHeader;
use noctule_hesai::pcap;
use noctule_sensor::{Clock, Monotonic, Realtime, Stamp};
use sha2::{Digest, Sha256};

use crate::image::stamped_at_name;
use crate::layout;
use crate::meta::{MetaFile, RECORDING_SCHEMA};
use crate::picture::write_rgb8;
use crate::table::OutFile;
use crate::{Calibration, ClockReading, Counts, Meta, WriteError};

/// Bytes buffered before a data file is written to.
const DATA_BUFFER_LEN: usize = 1 << 20;

/// Writes one recording directory.
///
/// `meta.json` is written first without counts and replaced by one with counts in
/// [`finish`](Self::finish), so that a recording that was interrupted says so. The same calls give
/// the same bytes: no file carries the time of writing.
#[derive(Debug)]
pub struct RecordingWriter {
    dir: PathBuf,
    file: MetaFile,
    counts: Counts,
    lidar_angles: Option<String>,
    events: Option<EventFiles>,
    lidar: Option<pcap::Writer<BufWriter<File>>>,
    images: Option<OutFile>,
    can: Option<(OutFile, Interface)>,
    clocks: OutFile,
}

#[derive(Debug)]
struct EventFiles {
    raw: OutFile,
    transfers: OutFile,
    /// Where the next transfer begins; 0 until the header was written.
    offset: u64,
}

impl RecordingWriter {
    /// Starts a recording in `dir`, which is created if need be and must not hold one already.
    ///
    /// # Errors
    /// When `meta` or `calibration` cannot be, a recording is there, or a file cannot be created.
    pub fn create(dir: &Path, meta: Meta, calibration: &Calibration) -> Result<Self, WriteError> {
        let field = |what| move |source| WriteError::Field { what, source };
        meta.validate().map_err(field("meta"))?;
        calibration.validate().map_err(field("calibration"))?;
        for name in [layout::META, layout::RAW] {
            let path = dir.join(name);
            if path.exists() {
                return Err(WriteError::Exists { path });
            }
        }
        create_dir(&dir.join(layout::RAW))?;
        let calibration_toml = calibration.to_toml();
        write_file(&dir.join(layout::CALIBRATION), calibration_toml.as_bytes())?;
        let file = MetaFile {
            schema: RECORDING_SCHEMA,
            calibration_sha256: sha256_hex(calibration_toml.as_bytes()),
            recording: meta,
            counts: None,
        };
        write_meta(dir, &file)?;
        let meta = &file.recording;
        Ok(Self {
            events: meta.events.as_ref().map(|_| event_files(dir)).transpose()?,
            lidar: meta
                .lidar
                .as_ref()
                .map(|l| capture(dir, l.port))
                .transpose()?,
            images: meta.camera.as_ref().map(|_| image_table(dir)).transpose()?,
            can: meta
                .can
                .as_ref()
                .map(|c| can_log(dir, &c.interface))
                .transpose()?,
            clocks: OutFile::table(dir.join(layout::CLOCKS), layout::CLOCK_COLUMNS)?,
            dir: dir.to_owned(),
            counts: Counts::default(),
            lidar_angles: calibration.lidar_angles.clone(),
            file,
        })
    }

    /// Writes the header of `raw/events.raw`, once and before any transfer: the `%` lines as the
    /// camera's software writes them.
    ///
    /// # Errors
    /// When `header` is no RAW header or more than one, when it was given before, or the file
    /// cannot be written.
    pub fn events_header(&mut self, header: &[u8]) -> Result<(), WriteError> {
        let files = self
            .events
            .as_mut()
            .ok_or(WriteError::Undeclared("events"))?;
        let bad = |text: String| Err(WriteError::EventsHeader(text));
        if files.offset != 0 {
            return bad("was written already".to_owned());
        }
        match RawHeader::parse(header) {
            Ok((_, len)) if len == header.len() => {}
            Ok((_, len)) => return bad(format!("{} bytes follow it", header.len() - len)),
            Err(error) => return bad(error.to_string()),
        }
        files.offset = header.len() as u64;
        files.raw.bytes(header)?;
        // Whatever happens from here on, the file can be opened.
        files.raw.flush()
    }

    /// Appends one USB transfer.
    ///
    /// # Errors
    /// When there is no header yet, the transfer is longer than 64 MiB, or a file cannot be
    /// written.
    pub fn event_transfer(
        &mut self,
        bytes: &[u8],
        arrival: Stamp<Realtime>,
    ) -> Result<(), WriteError> {
        let files = self
            .events
            .as_mut()
            .ok_or(WriteError::Undeclared("events"))?;
        if files.offset == 0 {
            let text = "must be written before the first transfer".to_owned();
            return Err(WriteError::EventsHeader(text));
        }
        if bytes.len() > layout::TRANSFER_LEN_MAX {
            return Err(WriteError::TransferLength {
                actual: bytes.len(),
                max: layout::TRANSFER_LEN_MAX,
            });
        }
        let (offset, len) = (files.offset, bytes.len() as u64);
        files.raw.bytes(bytes)?;
        files
            .transfers
            .line(format_args!("{offset},{len},{}", arrival.as_nanos()))?;
        files.offset += len;
        self.counts.event_transfers += 1;
        self.counts.event_bytes += len;
        self.counts.event_transfer_len_max = self.counts.event_transfer_len_max.max(len);
        Ok(())
    }

    /// Appends one LiDAR datagram.
    ///
    /// # Errors
    /// When the payload is longer than a datagram can be, or the file cannot be written.
    pub fn datagram(&mut self, payload: &[u8], arrival: Stamp<Realtime>) -> Result<(), WriteError> {
        let capture = self.lidar.as_mut().ok_or(WriteError::Undeclared("lidar"))?;
        capture
            .datagram(arrival, payload)
            .map_err(|e| WriteError::io(&self.dir.join(layout::LIDAR), e))?;
        self.counts.datagrams += 1;
        Ok(())
    }

    /// Appends one image: packed RGB8, rows from the top, of the size that meta names.
    ///
    /// # Errors
    /// When the size is another, or a file cannot be written.
    pub fn image(
        &mut self,
        stamp: FrameStamp,
        width: usize,
        height: usize,
        rgb8: &[u8],
    ) -> Result<(), WriteError> {
        let (Some(rows), Some(camera)) = (&mut self.images, &self.file.recording.camera) else {
            return Err(WriteError::Undeclared("camera"));
        };
        let declared = (camera.width as usize, camera.height as usize);
        if (width, height) != declared {
            return Err(WriteError::Size {
                what: "image",
                width,
                height,
                needed: declared.0 * declared.1 * 3,
                actual: rgb8.len(),
            });
        }
        let index = u32::try_from(self.counts.images).unwrap_or(u32::MAX);
        write_rgb8(&layout::image(&self.dir, index), width, height, rgb8)?;
        rows.line(format_args!(
            "{index},{},{},{},{},{},{},{}",
            stamp.sequence,
            stamp.driver.as_nanos(),
            Monotonic::NAME,
            stamped_at_name(stamp.at),
            stamp.arrival.as_nanos(),
            stamp.exposure_set_ns,
            stamp.gain_db,
        ))?;
        self.counts.images += 1;
        Ok(())
    }

    /// Appends one CAN frame, on the interface that meta names.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn can(&mut self, frame: Frame, arrival: Stamp<Realtime>) -> Result<(), WriteError> {
        let (log, interface) = self.can.as_mut().ok_or(WriteError::Undeclared("can"))?;
        let record = Record {
            arrival,
            interface: *interface,
            frame,
            direction: None,
        };
        log.line(format_args!("{record}"))?;
        self.counts.can_frames += 1;
        Ok(())
    }

    /// Appends one reading of the host's clocks.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn clock_reading(&mut self, reading: ClockReading) -> Result<(), WriteError> {
        let (realtime, monotonic) = (reading.realtime.as_nanos(), reading.monotonic.as_nanos());
        let tai_offset_s = reading.tai_offset_s;
        match reading.phc {
            None => self
                .clocks
                .line(format_args!("{realtime},{monotonic},{tai_offset_s},"))?,
            Some(phc) => self.clocks.line(format_args!(
                "{realtime},{monotonic},{tai_offset_s},{}",
                phc.as_nanos()
            ))?,
        }
        self.counts.clock_readings += 1;
        Ok(())
    }

    /// Writes the LiDAR's angle correction table (Hesai CSV) under the name that the calibration
    /// gives it.
    ///
    /// # Errors
    /// When the calibration names none or the file cannot be written.
    pub fn lidar_angles(&mut self, csv: &[u8]) -> Result<(), WriteError> {
        let name = self.lidar_angles.as_ref();
        let name = name.ok_or(WriteError::Undeclared("lidar angles"))?;
        write_file(&self.dir.join(name), csv)
    }

    /// Writes out what is buffered and marks the recording as whole.
    ///
    /// # Errors
    /// When a file cannot be written; the recording then counts as interrupted.
    pub fn finish(mut self) -> Result<Counts, WriteError> {
        if let Some(files) = &mut self.events {
            files.raw.flush()?;
            files.transfers.flush()?;
        }
        if let Some(capture) = self.lidar {
            capture
                .finish()
                .map_err(|e| WriteError::io(&self.dir.join(layout::LIDAR), e))?;
        }
        if let Some(rows) = &mut self.images {
            rows.flush()?;
        }
        if let Some((log, _)) = &mut self.can {
            log.flush()?;
        }
        self.clocks.flush()?;
        self.file.counts = Some(self.counts);
        write_meta(&self.dir, &self.file)?;
        Ok(self.counts)
    }
}

fn event_files(dir: &Path) -> Result<EventFiles, WriteError> {
    let transfers = dir.join(layout::EVENT_TRANSFERS);
    Ok(EventFiles {
        raw: OutFile::create(dir.join(layout::EVENTS), DATA_BUFFER_LEN)?,
        transfers: OutFile::table(transfers, layout::EVENT_TRANSFER_COLUMNS)?,
        offset: 0,
    })
}

fn capture(dir: &Path, port: u16) -> Result<pcap::Writer<BufWriter<File>>, WriteError> {
    let path = dir.join(layout::LIDAR);
    let io = |e| WriteError::io(&path, e);
    let file = File::create_new(&path).map_err(io)?;
    pcap::Writer::new(BufWriter::with_capacity(DATA_BUFFER_LEN, file), port).map_err(io)
}

fn image_table(dir: &Path) -> Result<OutFile, WriteError> {
    create_dir(&dir.join(layout::IMAGES))?;
    OutFile::table(dir.join(layout::IMAGE_ROWS), layout::IMAGE_COLUMNS)
}

fn can_log(dir: &Path, interface: &str) -> Result<(OutFile, Interface), WriteError> {
    let interface = Interface::new(interface).map_err(|_| WriteError::Undeclared("can"))?;
    Ok((OutFile::create(dir.join(layout::CAN), 64 << 10)?, interface))
}

/// Replaces `meta.json` in one step, so that it is never half there.
fn write_meta(dir: &Path, file: &MetaFile) -> Result<(), WriteError> {
    let path = dir.join(layout::META);
    let next = dir.join("meta.json.next");
    let error = |e| WriteError::io(&path, e);
    let mut text = serde_json::to_string_pretty(file).map_err(|e| error(e.into()))?;
    text.push('\n');
    write_file(&next, text.as_bytes())?;
    fs::rename(&next, &path).map_err(error)
}

pub(crate) fn write_file(path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
    fs::write(path, bytes).map_err(|e| WriteError::io(path, e))
}

pub(crate) fn create_dir(path: &Path) -> Result<(), WriteError> {
    fs::create_dir_all(path).map_err(|e| WriteError::io(path, e))
}

pub(crate) fn sha256_hex(bytes: &[u8]) -> String {
    let digest = Sha256::digest(bytes);
    digest.iter().map(|byte| format!("{byte:02x}")).collect()
}

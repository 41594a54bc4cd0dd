//! The LiDAR datagrams of a recording.

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use noctule_hesai::pcap::{CaptureError, Datagram, Reader, Skipped};

use crate::faults::Left;
use crate::{Faults, RecordingError};

/// The datagrams in the order in which they were captured, lent one at a time.
#[derive(Debug)]
pub struct Datagrams {
    path: PathBuf,
    /// `None` when the recording was cut off before anything was written out.
    reader: Option<Reader<BufReader<File>>>,
    left: Left,
    truncated: Faults,
}

impl Datagrams {
    /// A whole capture, whose header must be there.
    pub(crate) fn open(path: &Path) -> Result<Self, RecordingError> {
        let file = File::open(path).map_err(|e| RecordingError::io(path, e))?;
        let buffered = BufReader::with_capacity(256 << 10, file);
        let reader = Reader::new(buffered).map_err(|e| RecordingError::capture(path, e))?;
        Ok(Self {
            path: path.to_owned(),
            reader: Some(reader),
            left: Left::new(None),
            truncated: Faults::default(),
        })
    }

    /// The capture of a recording directory; one that was cut off inside its header is empty.
    pub(crate) fn of_recording(
        path: &Path,
        port: u16,
        counted: Option<u64>,
    ) -> Result<Self, RecordingError> {
        let mut datagrams = match Self::open(path) {
            Err(RecordingError::Capture {
                source: CaptureError::Truncated { needed, actual, .. },
                ..
            }) => Self {
                path: path.to_owned(),
                reader: None,
                left: Left::new(None),
                truncated: cut(needed, actual),
            },
            other => other?,
        };
        datagrams.left = Left::new(counted);
        datagrams.set_port(Some(port));
        Ok(datagrams)
    }

    /// Hands out datagrams to that UDP port only, from now on; `None` for all. A recording
    /// directory begins with its LiDAR's port, a lone capture with all.
    pub fn set_port(&mut self, port: Option<u16>) {
        if let Some(reader) = &mut self.reader {
            reader.set_port(port);
        }
    }

    /// The next datagram, stamped with its arrival; `None` at the end. A last record that was cut
    /// off is counted and not handed over.
    ///
    /// # Errors
    /// When the capture cannot be read or understood. Nothing follows an error.
    pub fn next_datagram(&mut self) -> Result<Option<Datagram<'_>>, RecordingError> {
        let Some(reader) = &mut self.reader else {
            self.left.take(None::<Result<(), ()>>);
            return Ok(None);
        };
        let next = match reader.next_datagram() {
            Err(CaptureError::Truncated { needed, actual, .. }) => {
                self.truncated = cut(needed, actual);
                None
            }
            other => other.transpose(),
        };
        self.left
            .take(next)
            .transpose()
            .map_err(|source| RecordingError::capture(&self.path, source))
    }

    /// Records of the capture that were passed over, by kind.
    #[must_use]
    pub fn skipped(&self) -> Skipped {
        self.reader
            .as_ref()
            .map_or_else(Skipped::default, Reader::skipped)
    }

    /// What is missing; complete once the stream has ended.
    #[must_use]
    pub fn faults(&self) -> Faults {
        Faults {
            truncated_bytes: self.truncated.truncated_bytes,
            ..self.left.faults(self.truncated.truncated_rows)
        }
    }
}

fn cut(needed: usize, actual: usize) -> Faults {
    Faults {
        truncated_rows: 1,
        truncated_bytes: needed.saturating_sub(actual) as u64,
        ..Faults::default()
    }
}

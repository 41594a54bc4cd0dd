//! A RAW file, streamed chunk by chunk.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use crate::{Decoder, EventSink, Geometry, RawError, RawHeader};

/// Bytes read at once; also the longest header understood.
const CHUNK_LEN: usize = 256 * 1024;

/// Why a RAW file could not be opened.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The file could not be opened or read.
    #[error("cannot read the file: {0}")]
    Io(#[from] io::Error),
    /// Its header could not be understood.
    #[error(transparent)]
    Header(#[from] RawError),
}

/// Reads a RAW file's header, then hands over its payload chunk by chunk.
///
/// Holds one chunk in memory, whatever the file's size.
#[derive(Debug)]
pub struct RawFile<R = File> {
    header: RawHeader,
    reader: R,
    chunk: Vec<u8>,
    /// What of `chunk` has not been handed over yet.
    unread: core::ops::Range<usize>,
}

impl RawFile {
    /// Opens the file at `path`; `fallback` is the sensor's size where the header gives none.
    ///
    /// # Errors
    /// When the file cannot be read or its header cannot be understood.
    pub fn open(path: &Path, fallback: Option<Geometry>) -> Result<Self, OpenError> {
        Self::from_reader(File::open(path)?, fallback)
    }
}

impl<R: Read> RawFile<R> {
    /// As [`RawFile::open`], from anything that can be read.
    ///
    /// # Errors
    /// When `reader` fails or the header cannot be understood.
    pub fn from_reader(mut reader: R, fallback: Option<Geometry>) -> Result<Self, OpenError> {
        let mut chunk = vec![0; CHUNK_LEN];
        let filled = read_full(&mut reader, &mut chunk)?;
        let (header, payload) = RawHeader::parse_with(&chunk[..filled], fallback)?;
        Ok(Self {
            header,
            reader,
            chunk,
            unread: payload..filled,
        })
    }

    /// What the file says about itself.
    #[must_use]
    pub const fn header(&self) -> &RawHeader {
        &self.header
    }

    /// A decoder for this file's encoding and sensor.
    #[must_use]
    pub fn decoder(&self) -> Decoder {
        Decoder::new(self.header.format, self.header.geometry)
    }

    /// The next bytes of the payload; empty at the end of the file. Chunks split words anywhere.
    ///
    /// # Errors
    /// When reading fails.
    pub fn next_chunk(&mut self) -> io::Result<&[u8]> {
        if self.unread.is_empty() {
            let filled = read_full(&mut self.reader, &mut self.chunk)?;
            self.unread = 0..filled;
        }
        let range = core::mem::replace(&mut self.unread, 0..0);
        Ok(&self.chunk[range])
    }

    /// Decodes the rest of the file into `sink`, and gives the decoder with its counts.
    ///
    /// # Errors
    /// When reading fails.
    pub fn decode_all(mut self, sink: &mut impl EventSink) -> io::Result<Decoder> {
        let mut decoder = self.decoder();
        loop {
            let chunk = self.next_chunk()?;
            if chunk.is_empty() {
                decoder.finish();
                return Ok(decoder);
            }
            decoder.decode(chunk, sink);
        }
    }
}

/// Fills `chunk` as far as the reader has bytes.
fn read_full(reader: &mut impl Read, chunk: &mut [u8]) -> io::Result<usize> {
    let mut filled = 0;
    while filled < chunk.len() {
        match reader.read(&mut chunk[filled..]) {
            Ok(0) => break,
            Ok(n) => filled += n,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(filled)
}

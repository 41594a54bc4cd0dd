//! Events to rows of text or records of an array.

use std::path::Path;

use noctule_evk4::{Decoder, EventSink, RawFile};
use noctule_recording::Recording;
use noctule_sensor::Event;

use super::output::Output;
use super::{ExportError, Exported, Request, Target};
use crate::inspect::{InspectError, Kind, Watched};

/// First line of an events CSV: microseconds of the sensor's clock, column, row, 1 for brighter.
pub const EVENT_COLUMNS: &str = "t_us,x,y,p";

/// Bytes of one record of an events NPY: t u64 (microseconds), x u16, y u16, p u8, little-endian.
pub const NPY_RECORD_LEN: usize = 13;

/// Bytes of an NPY header; a multiple of 64, as the format asks for.
const NPY_HEADER_LEN: usize = 192;

/// Writes each event as it is decoded.
struct Rows {
    output: Output,
    target: Target,
    written: u64,
    text: Vec<u8>,
}

impl EventSink for Rows {
    #[inline]
    fn event(&mut self, event: Event) {
        self.written += 1;
        let (t_us, p) = (event.t.as_micros(), u8::from(event.on));
        if self.target == Target::Npy {
            let mut record = [0; NPY_RECORD_LEN];
            record[0..8].copy_from_slice(&t_us.to_le_bytes());
            record[8..10].copy_from_slice(&event.x.to_le_bytes());
            record[10..12].copy_from_slice(&event.y.to_le_bytes());
            record[12] = p;
            self.output.put(&record);
            return;
        }
        self.text.clear();
        decimal(t_us, &mut self.text);
        self.text.push(b',');
        decimal(u64::from(event.x), &mut self.text);
        self.text.push(b',');
        decimal(u64::from(event.y), &mut self.text);
        self.text.extend([b',', b'0' + p, b'\n']);
        self.output.put(&self.text);
    }
}

pub(super) fn export(
    request: &Request,
    kind: Kind,
    target: Target,
    progress: &dyn Fn(u64),
) -> Result<Exported, ExportError> {
    let mut source = Source::open(request, kind, progress)?;
    let mut rows = Rows {
        output: Output::create(&request.to)?,
        target,
        written: 0,
        text: Vec::new(),
    };
    match target {
        Target::Npy => rows.output.put(&npy_header(0)),
        _ => rows.output.put(format!("{EVENT_COLUMNS}\n").as_bytes()),
    }
    let (undecoded, faults) = source.decode(request, &mut rows, progress);
    if target == Target::Npy {
        rows.output.replace_header(&npy_header(rows.written));
    }
    rows.output.finish()?;
    Ok(Exported {
        written: rows.written,
        unit: "events",
        undecoded,
        faults,
    })
}

/// Where the bytes come from.
enum Source<'a> {
    Raw(Box<RawFile<Watched<'a>>>),
    Recording(Box<noctule_recording::EventTransfers>),
}

impl<'a> Source<'a> {
    fn open(request: &Request, kind: Kind, progress: &'a dyn Fn(u64)) -> Result<Self, ExportError> {
        let path = &request.from;
        if kind == Kind::Recording {
            let stream = Recording::open(path)?.event_transfers()?;
            return Ok(Self::Recording(Box::new(stream)));
        }
        let file = RawFile::from_reader(Watched::open(path, progress)?, request.geometry)
            .map_err(InspectError::open_raw(path))?;
        Ok(Self::Raw(Box::new(file)))
    }

    /// Decodes to the end, the first fault, or the first failure to write; gives what could not be
    /// decoded and where the source is damaged.
    fn decode(
        &mut self,
        request: &Request,
        rows: &mut Rows,
        progress: &dyn Fn(u64),
    ) -> (Vec<(&'static str, u64)>, Vec<InspectError>) {
        let header = match self {
            Self::Raw(file) => file.header(),
            Self::Recording(stream) => stream.header(),
        };
        let mut decoder = Decoder::new(header.format, header.geometry);
        let mut faults = Vec::new();
        while !rows.output.has_failed() {
            match self.next(&request.from, progress) {
                Ok(Some(bytes)) => decoder.decode(bytes, rows),
                Ok(None) => break,
                Err(error) => {
                    faults.push(error);
                    break;
                }
            }
        }
        decoder.finish();
        if let Self::Recording(stream) = self {
            faults.extend(InspectError::of_events(&request.from, stream.faults()));
        }
        let kinds = decoder.errors().by_kind().into_iter();
        (kinds.filter(|(_, count)| *count > 0).collect(), faults)
    }

    /// The next bytes; `None` at the end.
    fn next(&mut self, path: &Path, progress: &dyn Fn(u64)) -> Result<Option<&[u8]>, InspectError> {
        match self {
            Self::Raw(file) => {
                let chunk = file.next_chunk().map_err(InspectError::io(path, 0))?;
                Ok((!chunk.is_empty()).then_some(chunk))
            }
            Self::Recording(stream) => {
                let transfer = stream.next_transfer()?;
                Ok(transfer.map(|transfer| {
                    progress(transfer.bytes.len() as u64);
                    transfer.bytes
                }))
            }
        }
    }
}

/// The header of an NPY file, version 1.0 (NumPy Enhancement Proposal 1), padded to a fixed length
/// so that the count can be filled in at the end.
fn npy_header(events: u64) -> [u8; NPY_HEADER_LEN] {
    let dictionary = format!(
        "{{'descr': [('t', '<u8'), ('x', '<u2'), ('y', '<u2'), ('p', '|u1')], \
         'fortran_order': False, 'shape': ({events},), }}"
    );
    let mut header = [b' '; NPY_HEADER_LEN];
    header[..10].copy_from_slice(b"\x93NUMPY\x01\x00\xb6\x00");
    header[10..10 + dictionary.len()].copy_from_slice(dictionary.as_bytes());
    header[NPY_HEADER_LEN - 1] = b'\n';
    header
}

/// Appends a number in decimal.
pub(super) fn decimal(mut value: u64, text: &mut Vec<u8>) {
    let mut digits = [0; 20];
    let mut first = digits.len();
    loop {
        first -= 1;
        let digit = u8::try_from(value % 10).unwrap_or(0); // below 10
        digits[first] = b'0' + digit;
        value /= 10;
        if value == 0 {
            break;
        }
    }
    text.extend_from_slice(&digits[first..]);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_written_as_the_standard_library_does() {
        for value in [0, 7, 10, 99, 1280, 18_446_744_073_709_551_615] {
            let mut text = b"x".to_vec();
            decimal(value, &mut text);
            assert_eq!(text, format!("x{value}").as_bytes());
        }
    }

    #[test]
    fn every_count_fits_the_header() {
        for events in [0, 82_469, u64::MAX] {
            let header = npy_header(events);
            let text = String::from_utf8_lossy(&header[10..]);
            assert!(
                text.contains(&format!("'shape': ({events},), }}")),
                "{text}"
            );
            assert!(text.ends_with('\n'));
            let len = u16::from_le_bytes([header[8], header[9]]);
            assert_eq!(usize::from(len) + 10, NPY_HEADER_LEN);
        }
    }
}

//! The event stream of a recording, USB transfer by USB transfer, lent from one buffer.

use std::fs::File;
use std::io::{BufReader, ErrorKind, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use noctule_evk4::{Decoder, EventSink, Geometry, RawHeader};
use noctule_sensor::{Event, Evk4, Realtime, Stamp, TriggerEdge};

use crate::faults::Left;
use crate::layout;
use crate::table::Table;
use crate::{Faults, RecordingError};

/// Longest header understood, bytes.
const HEADER_LEN_MAX: usize = 256 << 10;
/// Bytes handed over at a time where nobody recorded the transfers.
const CHUNK_LEN: usize = 4096;
/// Columns of the table that public event-camera recordings carry beside a RAW file.
const PACKET_COLUMNS: &[&str] = &[
    "seq",
    "byte_offset",
    "byte_length",
    "driver_stamp_ns",
    "bag_receive_ns",
];

/// One USB transfer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Transfer<'a> {
    /// Where its bytes begin in the file.
    pub offset: u64,
    /// When the host had it whole. Made up from sensor time where it was not recorded; the
    /// recording's `missing` then says so.
    pub arrival: Stamp<Realtime>,
    /// Its bytes; words may be split between transfers.
    pub bytes: &'a [u8],
}

/// Where transfers begin and end, and when they arrived.
#[derive(Debug)]
enum Schedule {
    /// A table; `first` is the column of the offset, followed by length and arrival.
    Listed { table: Table, first: usize },
    /// Nobody knows: chunks of constant length, stamped with the sensor time they reach.
    SensorTime {
        decoder: Box<Decoder>,
        reached: Reached,
    },
}

/// A table of transfers; `first` is the column of the offset, followed by length and arrival.
struct List<'a> {
    path: &'a Path,
    columns: &'static [&'static str],
    first: usize,
}

impl List<'_> {
    fn open(&self) -> Result<Table, RecordingError> {
        Table::open(self.path, self.columns)
    }
}

/// The event stream in the order in which it arrived.
#[derive(Debug)]
pub struct EventTransfers {
    path: PathBuf,
    reader: BufReader<File>,
    header: Vec<u8>,
    raw_header: RawHeader,
    schedule: Schedule,
    buffer: Vec<u8>,
    /// Where the next transfer must begin.
    position: u64,
    left: Left,
    truncated_bytes: u64,
    unlisted_bytes: u64,
}

impl EventTransfers {
    /// The stream of a recording directory.
    pub(crate) fn open(
        dir: &Path,
        fallback: Option<Geometry>,
        counted: Option<u64>,
        len_max: usize,
    ) -> Result<Self, RecordingError> {
        let list = List {
            path: &dir.join(layout::EVENT_TRANSFERS),
            columns: layout::EVENT_TRANSFER_COLUMNS,
            first: 0,
        };
        let mut transfers = Self::listed(&dir.join(layout::EVENTS), &list, fallback)?;
        transfers.left = Left::new(counted);
        transfers
            .buffer
            .reserve(len_max.min(layout::TRANSFER_LEN_MAX));
        Ok(transfers)
    }

    /// A RAW file with the packets table of public recordings beside it.
    pub(crate) fn with_packets(
        raw: &Path,
        packets: &Path,
        fallback: Option<Geometry>,
    ) -> Result<Self, RecordingError> {
        let list = List {
            path: packets,
            columns: PACKET_COLUMNS,
            first: 1,
        };
        Self::listed(raw, &list, fallback)
    }

    fn listed(
        raw: &Path,
        list: &List<'_>,
        fallback: Option<Geometry>,
    ) -> Result<Self, RecordingError> {
        let first = list.first;
        // The first transfer says where the header ends, whatever its style.
        let begin = match list.open()?.next_row()? {
            None => None,
            Some(row) => {
                let offset: usize = row.get(first)?;
                if offset > HEADER_LEN_MAX {
                    return Err(row.error(first, "more than 256 KiB of header"));
                }
                Some(offset)
            }
        };
        let table = list.open()?;
        let schedule = |_: &RawHeader| Schedule::Listed { table, first };
        Self::begin(raw, begin, fallback, schedule)
    }

    /// A RAW file with nothing beside it.
    pub(crate) fn by_sensor_time(
        raw: &Path,
        fallback: Option<Geometry>,
    ) -> Result<Self, RecordingError> {
        Self::begin(raw, None, fallback, |header| Schedule::SensorTime {
            decoder: Box::new(Decoder::new(header.format, header.geometry)),
            reached: Reached::default(),
        })
    }

    fn begin(
        path: &Path,
        header_len: Option<usize>,
        fallback: Option<Geometry>,
        schedule: impl FnOnce(&RawHeader) -> Schedule,
    ) -> Result<Self, RecordingError> {
        let io = |e| RecordingError::io(path, e);
        let mut file = File::open(path).map_err(io)?;
        let mut header = Vec::new();
        (&mut file)
            .take(header_len.unwrap_or(HEADER_LEN_MAX) as u64)
            .read_to_end(&mut header)
            .map_err(io)?;
        let (raw_header, parsed_len) =
            RawHeader::parse_with(&header, fallback).map_err(|source| {
                RecordingError::EventsHeader {
                    path: path.to_owned(),
                    source,
                }
            })?;
        if header_len.is_none() {
            header.truncate(parsed_len);
        }
        let position = header.len() as u64;
        file.seek(SeekFrom::Start(position)).map_err(io)?;
        Ok(Self {
            path: path.to_owned(),
            reader: BufReader::with_capacity(256 << 10, file),
            schedule: schedule(&raw_header),
            header,
            raw_header,
            buffer: Vec::with_capacity(CHUNK_LEN),
            position,
            left: Left::new(None),
            truncated_bytes: 0,
            unlisted_bytes: 0,
        })
    }

    /// The header's bytes as they stand in the file.
    #[must_use]
    pub fn header_bytes(&self) -> &[u8] {
        &self.header
    }

    /// The header as understood.
    #[must_use]
    pub const fn header(&self) -> &RawHeader {
        &self.raw_header
    }

    /// The next transfer; `None` at the end. A last transfer that was cut off is handed over as
    /// far as it goes, and counted.
    ///
    /// # Errors
    /// When a row of the table cannot be, or a file cannot be read. Nothing follows an error.
    pub fn next_transfer(&mut self) -> Result<Option<Transfer<'_>>, RecordingError> {
        let next = self.advance().transpose();
        let next = self.left.take(next).transpose()?;
        Ok(next.map(|(offset, arrival)| Transfer {
            offset,
            arrival,
            bytes: &self.buffer,
        }))
    }

    /// Fills the buffer with the next transfer; gives its offset and arrival.
    fn advance(&mut self) -> Result<Option<(u64, Stamp<Realtime>)>, RecordingError> {
        let offset = self.position;
        let (len, listed) = match &mut self.schedule {
            Schedule::SensorTime { .. } => (CHUNK_LEN, None),
            Schedule::Listed { table, first } => {
                let Some(row) = table.next_row()? else {
                    return self.end_of_list();
                };
                if row.get::<u64>(*first)? != offset {
                    return Err(row.error(*first, "not where the transfer before ends"));
                }
                let len: usize = row.get(*first + 1)?;
                if len > layout::TRANSFER_LEN_MAX {
                    return Err(row.error(*first + 1, "more than 64 MiB"));
                }
                (len, Some(Stamp::from_nanos(row.get(*first + 2)?)))
            }
        };
        self.buffer.resize(len, 0);
        let got = read_full(&mut self.reader, &mut self.buffer)
            .map_err(|e| RecordingError::io(&self.path, e))?;
        self.buffer.truncate(got);
        // Where the next must begin, whether or not the file goes that far.
        self.position += if listed.is_some() { len } else { got } as u64;
        if let Schedule::SensorTime { decoder, reached } = &mut self.schedule {
            decoder.decode(&self.buffer, reached);
            reached.to(decoder.watermark().unwrap_or_default());
            let arrival = Stamp::from_nanos(reached.0.as_nanos());
            return Ok((got > 0).then_some((offset, arrival)));
        }
        self.truncated_bytes += (len - got) as u64;
        // A row whose bytes are all missing counts as absent, not as an empty transfer.
        Ok(listed
            .filter(|_| got > 0 || len == 0)
            .map(|arrival| (offset, arrival)))
    }

    fn end_of_list<T>(&mut self) -> Result<Option<T>, RecordingError> {
        let file = self.reader.get_ref().metadata();
        let len = file.map_err(|e| RecordingError::io(&self.path, e))?.len();
        self.unlisted_bytes = len.saturating_sub(self.position);
        Ok(None)
    }

    /// What is missing; complete once the stream has ended.
    #[must_use]
    pub fn faults(&self) -> Faults {
        let truncated_rows = match &self.schedule {
            Schedule::Listed { table, .. } => table.truncated(),
            Schedule::SensorTime { .. } => 0,
        };
        Faults {
            truncated_bytes: self.truncated_bytes,
            unlisted_bytes: self.unlisted_bytes,
            ..self.left.faults(truncated_rows)
        }
    }
}

/// The latest time that anything decoded carries; the decoder's watermark alone may lie before
/// the last events.
#[derive(Debug, Default)]
struct Reached(Stamp<Evk4>);

impl Reached {
    fn to(&mut self, t: Stamp<Evk4>) {
        self.0 = self.0.max(t);
    }
}

impl EventSink for Reached {
    fn event(&mut self, event: Event) {
        self.to(event.t);
    }

    fn trigger(&mut self, edge: TriggerEdge) {
        self.to(edge.t);
    }
}

/// Fills `buffer` as far as the reader has bytes.
fn read_full(reader: &mut impl Read, buffer: &mut [u8]) -> std::io::Result<usize> {
    let mut filled = 0;
    while filled < buffer.len() {
        match reader.read(&mut buffer[filled..]) {
            Ok(0) => break,
            Ok(n) => filled += n,
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(filled)
}

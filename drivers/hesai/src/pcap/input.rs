//! Bytes of a capture file with their position, in the file's byte order.

use std::io::{self, Read};

use super::CaptureError;

/// Longest record or block taken for real.
pub(super) const RECORD_MAX: usize = 16 << 20;

/// A reader that knows where it is, and holds the record last read.
#[derive(Debug)]
pub(super) struct Input<R> {
    inner: R,
    /// Bytes read so far.
    pub offset: u64,
    pub big_endian: bool,
    pub record: Vec<u8>,
}

impl<R: Read> Input<R> {
    pub fn new(inner: R) -> Self {
        Self {
            inner,
            offset: 0,
            big_endian: false,
            record: Vec::new(),
        }
    }

    /// Reads `len` bytes into `record`; `false` if the file ends right before them.
    ///
    /// `what` names them in errors. A length the file does not have costs no memory.
    pub fn take(&mut self, len: usize, what: &'static str) -> Result<bool, CaptureError> {
        self.record.clear();
        self.take_more(len, what)
    }

    /// As [`take`](Self::take), keeping what is in `record`.
    pub fn take_more(&mut self, len: usize, what: &'static str) -> Result<bool, CaptureError> {
        let (start, before) = (self.offset, self.record.len());
        let bytes = u64::try_from(len).unwrap_or(u64::MAX);
        let result = self
            .inner
            .by_ref()
            .take(bytes)
            .read_to_end(&mut self.record);
        let actual = self.record.len() - before;
        self.offset += u64::try_from(actual).unwrap_or(0);
        match result {
            Err(source) if source.kind() != io::ErrorKind::UnexpectedEof => Err(CaptureError::Io {
                offset: self.offset,
                source,
            }),
            _ if actual == len => Ok(true),
            _ if actual == 0 => Ok(false),
            _ => Err(CaptureError::Truncated {
                offset: start,
                what,
                needed: len,
                actual,
            }),
        }
    }

    pub fn u16(&self, at: usize) -> u16 {
        let bytes = [self.record[at], self.record[at + 1]];
        if self.big_endian {
            u16::from_be_bytes(bytes)
        } else {
            u16::from_le_bytes(bytes)
        }
    }

    pub fn u32(&self, at: usize) -> u32 {
        let bytes = core::array::from_fn(|i| self.record[at + i]);
        if self.big_endian {
            u32::from_be_bytes(bytes)
        } else {
            u32::from_le_bytes(bytes)
        }
    }
}

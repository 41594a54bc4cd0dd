//! What is missing at the end of a stream, counted.

/// What a stream's files lack. A recording that was cut off is read as far as it goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Faults {
    /// Last rows that were cut off in the middle.
    pub truncated_rows: u64,
    /// Bytes that rows name and the data file does not have.
    pub truncated_bytes: u64,
    /// Bytes of the data file that no row names.
    pub unlisted_bytes: u64,
    /// Rows or packets that the finished recording counted and that are not there.
    pub absent_rows: u64,
}

impl Faults {
    /// Whether nothing is missing.
    #[must_use]
    pub fn is_clean(&self) -> bool {
        *self == Self::default()
    }
}

/// Rows still to come by the recording's own count, and whether the stream has ended.
#[derive(Debug)]
pub(crate) struct Left {
    counted: Option<u64>,
    seen: u64,
    ended: bool,
}

impl Left {
    pub(crate) const fn new(counted: Option<u64>) -> Self {
        Self {
            counted,
            seen: 0,
            ended: false,
        }
    }

    /// Passes the next item of a stream through; nothing follows an end or an error.
    pub(crate) fn take<T, E>(&mut self, next: Option<Result<T, E>>) -> Option<Result<T, E>> {
        if self.ended {
            return None;
        }
        match next {
            Some(Ok(_)) => self.seen += 1,
            Some(Err(_)) | None => self.ended = true,
        }
        next
    }

    pub(crate) fn faults(&self, truncated_rows: u64) -> Faults {
        let counted = self.counted.filter(|_| self.ended).unwrap_or(0);
        Faults {
            truncated_rows,
            absent_rows: counted.saturating_sub(self.seen),
            ..Faults::default()
        }
    }
}

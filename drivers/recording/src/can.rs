//! The CAN frames of a recording.

use std::path::Path;

use noctule_can::Record;

use crate::faults::Left;
use crate::layout;
use crate::table::Lines;
use crate::{Faults, RecordingError};

/// The frames in the order in which they arrived.
#[derive(Debug)]
pub struct CanFrames {
    lines: Lines,
    left: Left,
}

impl CanFrames {
    pub(crate) fn open(dir: &Path, counted: Option<u64>) -> Result<Self, RecordingError> {
        Ok(Self {
            lines: Lines::open(&dir.join(layout::CAN))?,
            left: Left::new(counted),
        })
    }

    /// What was cut off; complete once the iterator has ended.
    #[must_use]
    pub fn faults(&self) -> Faults {
        self.left.faults(self.lines.truncated())
    }

    fn read(&mut self) -> Result<Option<Record>, RecordingError> {
        let Some(line) = self.lines.next_line()? else {
            return Ok(None);
        };
        match Record::parse(line.text) {
            Ok(record) => Ok(Some(record)),
            Err(source) => Err(RecordingError::Can {
                path: line.path.to_owned(),
                line: line.number,
                source,
            }),
        }
    }
}

impl Iterator for CanFrames {
    type Item = Result<Record, RecordingError>;

    fn next(&mut self) -> Option<Self::Item> {
        let next = self.read().transpose();
        self.left.take(next)
    }
}

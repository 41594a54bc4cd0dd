//! The images of a recording, row by row; pixels are decoded on demand.

use std::path::Path;

use noctule_camera::{FrameStamp, StampedAt};
use noctule_sensor::{Clock, Monotonic, Stamp};

use crate::faults::Left;
use crate::layout;
use crate::table::{Row, Table};
use crate::{Faults, RecordingError};

/// One row of `raw/rgb.csv`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImageRow {
    /// Number of the picture's file.
    pub index: u32,
    /// Its stamps and settings.
    pub stamp: FrameStamp,
}

/// The images in the order in which they arrived.
#[derive(Debug)]
pub struct ImageRows {
    table: Table,
    left: Left,
}

impl ImageRows {
    pub(crate) fn open(dir: &Path, counted: Option<u64>) -> Result<Self, RecordingError> {
        let table = Table::open(&dir.join(layout::IMAGE_ROWS), layout::IMAGE_COLUMNS)?;
        Ok(Self {
            table,
            left: Left::new(counted),
        })
    }

    /// What was cut off; complete once the iterator has ended.
    #[must_use]
    pub fn faults(&self) -> Faults {
        self.left.faults(self.table.truncated())
    }
}

impl Iterator for ImageRows {
    type Item = Result<ImageRow, RecordingError>;

    fn next(&mut self) -> Option<Self::Item> {
        let next = self
            .table
            .next_row()
            .and_then(|row| row.map(read).transpose());
        self.left.take(next.transpose())
    }
}

fn read(row: Row<'_>) -> Result<ImageRow, RecordingError> {
    if row.text(3) != Monotonic::NAME {
        return Err(row.error(3, "the driver's clock must be monotonic"));
    }
    let at = [StampedAt::StartOfExposure, StampedAt::EndOfExposure]
        .into_iter()
        .find(|&at| stamped_at_name(at) == row.text(4))
        .ok_or_else(|| row.error(4, "neither start_of_exposure nor end_of_exposure"))?;
    let gain_db: f32 = row.get(7)?;
    if !gain_db.is_finite() {
        return Err(row.error(7, "not finite"));
    }
    Ok(ImageRow {
        index: row.get(0)?,
        stamp: FrameStamp {
            sequence: row.get(1)?,
            driver: Stamp::from_nanos(row.get(2)?),
            at,
            arrival: Stamp::from_nanos(row.get(5)?),
            exposure_set_ns: row.get(6)?,
            gain_db,
        },
    })
}

/// As written in the table.
pub(crate) const fn stamped_at_name(at: StampedAt) -> &'static str {
    match at {
        StampedAt::StartOfExposure => "start_of_exposure",
        StampedAt::EndOfExposure => "end_of_exposure",
    }
}

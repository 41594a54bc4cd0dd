//! When the shutter truly was open: `truth/exposures.csv` (synthetic recordings only).

use std::path::Path;

use noctule_sensor::{Evk4, Stamp, Tai};

use crate::faults::Left;
use crate::layout;
use crate::table::{Row, Table};
use crate::{Faults, RecordingError};

/// What the strobe line did at one end of an exposure.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EdgeTruth {
    /// One edge was reported.
    Once,
    /// The edge was not reported.
    Missed,
    /// The edge was reported twice.
    Doubled,
}

impl EdgeTruth {
    const ALL: [Self; 3] = [Self::Once, Self::Missed, Self::Doubled];

    /// As written in the table.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Once => "once",
            Self::Missed => "missed",
            Self::Doubled => "doubled",
        }
    }
}

/// One exposure as it truly was.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ExposureTruth {
    /// Number of the exposure, from 0; also the number of its derived sample.
    pub index: u32,
    /// When the shutter opened.
    pub open_tai: Stamp<Tai>,
    /// When it closed.
    pub close_tai: Stamp<Tai>,
    /// The same opening on the event camera's counter.
    pub open_evk4: Stamp<Evk4>,
    /// The same closing on the event camera's counter.
    pub close_evk4: Stamp<Evk4>,
    /// The driver's sequence of its image; `None` when the camera made none.
    pub image_sequence: Option<u32>,
    /// Whether that image never reached the host.
    pub image_dropped: bool,
    /// What the strobe reported at the opening.
    pub open_edge: EdgeTruth,
    /// What the strobe reported at the closing.
    pub close_edge: EdgeTruth,
}

/// The true exposures of a recording, in order.
#[derive(Debug)]
pub struct ExposureTruths {
    table: Table,
    left: Left,
}

impl ExposureTruths {
    pub(crate) fn open(dir: &Path) -> Result<Self, RecordingError> {
        Ok(Self {
            table: Table::open(&dir.join(layout::TRUTH_EXPOSURES), layout::EXPOSURE_COLUMNS)?,
            left: Left::new(None),
        })
    }

    /// What was cut off; complete once the iterator has ended.
    #[must_use]
    pub fn faults(&self) -> Faults {
        self.left.faults(self.table.truncated())
    }
}

impl Iterator for ExposureTruths {
    type Item = Result<ExposureTruth, RecordingError>;

    fn next(&mut self) -> Option<Self::Item> {
        let next = self
            .table
            .next_row()
            .and_then(|row| row.map(read).transpose());
        self.left.take(next.transpose())
    }
}

fn read(row: Row<'_>) -> Result<ExposureTruth, RecordingError> {
    let edge = |column: usize| {
        EdgeTruth::ALL
            .into_iter()
            .find(|edge| edge.name() == row.text(column))
            .ok_or_else(|| row.error(column, "neither once, missed nor doubled"))
    };
    let truth = ExposureTruth {
        index: row.get(0)?,
        open_tai: Stamp::from_nanos(row.get(1)?),
        close_tai: Stamp::from_nanos(row.get(2)?),
        open_evk4: Stamp::from_nanos(row.get(3)?),
        close_evk4: Stamp::from_nanos(row.get(4)?),
        image_sequence: row.optional(5)?,
        image_dropped: match row.text(6) {
            "0" => false,
            "1" => true,
            _ => return Err(row.error(6, "neither 0 nor 1")),
        },
        open_edge: edge(7)?,
        close_edge: edge(8)?,
    };
    if truth.close_tai <= truth.open_tai || truth.close_evk4 <= truth.open_evk4 {
        return Err(row.error(2, "closes no later than it opens"));
    }
    Ok(truth)
}

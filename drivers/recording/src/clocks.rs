//! What the clocks read, and (synthetic recordings only) what they truly were.

use std::fs;
use std::path::Path;

use noctule_sensor::{Clock, ClockMap, Monotonic, Phc, Realtime, Stamp, Tai};
use serde::{Deserialize, Serialize};

use crate::faults::Left;
use crate::layout;
use crate::table::{Row, Table};
use crate::{Faults, RecordingError};

/// The host's clocks, read together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ClockReading {
    /// `CLOCK_REALTIME`.
    pub realtime: Stamp<Realtime>,
    /// `CLOCK_MONOTONIC`.
    pub monotonic: Stamp<Monotonic>,
    /// The kernel's TAI - UTC, seconds; 0 when nobody told it.
    pub tai_offset_s: i32,
    /// The network card's clock, if it has one.
    pub phc: Option<Stamp<Phc>>,
}

/// One clock's true relation to TAI: exact at one pair of readings, and a constant rate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClockTruth {
    /// What the clock read, nanoseconds.
    pub clock_ns: u64,
    /// When it did, TAI nanoseconds.
    pub tai_ns: u64,
    /// How much more TAI advances than the clock, parts per billion; negative when the clock runs
    /// fast.
    pub rate_ppb: i64,
}

impl ClockTruth {
    /// The same as an exact map.
    #[must_use]
    pub const fn to_map<C: Clock>(&self) -> ClockMap<C, Tai> {
        ClockMap {
            anchor: (
                Stamp::from_nanos(self.clock_ns),
                Stamp::from_nanos(self.tai_ns),
            ),
            rate_ppb: self.rate_ppb,
            uncertainty_ns: 0,
            growth_ppb: 0,
            epoch: 0,
        }
    }
}

/// Every clock's true relation to TAI: `truth/clocks.toml`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TruthClocks {
    /// The event camera's counter.
    pub evk4: ClockTruth,
    /// The LiDAR's clock.
    pub lidar: ClockTruth,
    /// The host's `CLOCK_MONOTONIC`.
    pub monotonic: ClockTruth,
    /// The host's `CLOCK_REALTIME`.
    pub realtime: ClockTruth,
    /// The network card's clock, if there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub phc: Option<ClockTruth>,
}

impl TruthClocks {
    pub(crate) fn load(path: &Path) -> Result<Self, RecordingError> {
        let text = fs::read_to_string(path).map_err(|e| RecordingError::io(path, e))?;
        toml::from_str(&text).map_err(|e| RecordingError::toml(path, &text, &e))
    }
}

/// The readings of a recording's host clocks, in order.
#[derive(Debug)]
pub struct ClockReadings {
    table: Table,
    left: Left,
}

impl ClockReadings {
    pub(crate) fn open(dir: &Path, counted: Option<u64>) -> Result<Self, RecordingError> {
        Ok(Self {
            table: Table::open(&dir.join(layout::CLOCKS), layout::CLOCK_COLUMNS)?,
            left: Left::new(counted),
        })
    }

    /// What was cut off; complete once the iterator has ended.
    #[must_use]
    pub fn faults(&self) -> Faults {
        self.left.faults(self.table.truncated())
    }
}

impl Iterator for ClockReadings {
    type Item = Result<ClockReading, RecordingError>;

    fn next(&mut self) -> Option<Self::Item> {
        let next = self
            .table
            .next_row()
            .and_then(|row| row.map(read).transpose());
        self.left.take(next.transpose())
    }
}

fn read(row: Row<'_>) -> Result<ClockReading, RecordingError> {
    Ok(ClockReading {
        realtime: Stamp::from_nanos(row.get(0)?),
        monotonic: Stamp::from_nanos(row.get(1)?),
        tai_offset_s: row.get(2)?,
        phc: row.optional(3)?.map(Stamp::from_nanos),
    })
}

//! The voxel raster: begin at the opening, advance while events come, finish at the close.

use super::history::{EventHistory, PackedEvent};
use super::retime::{Changes, EventList};
use super::sums::Sums;
use super::tally::Tally;
use super::timing::{BINS, EXPOSURE_US_MAX, Exposure, STEPS_MAX, Timing, WHOLE};
use crate::error::check_len;
use crate::geometry::PixelMap;
use crate::{Grid, RasterError};

/// Events one step may hold without any sum leaving 32 bits, were they all in one cell.
const STEP_EVENTS_MAX: u64 = (i32::MAX / WHOLE) as u64;
/// How far off a prediction may be to be met without looking through the history, microseconds:
/// both edges are read to the microsecond, so even a perfect strobe jitters by one.
const JITTER_US: u32 = 2;
/// Most events kept for that, and most events moved; 8 bytes each.
const MOVES_MAX: usize = 1 << 20;

/// Shape of a voxel grid: `[steps, BINS, height, width]`, row-major.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct VoxelShape {
    /// Slices of the exposure, T.
    pub steps: usize,
    /// Rows and columns.
    pub grid: Grid,
}

impl VoxelShape {
    /// Elements of one step, `[BINS, height, width]`.
    #[must_use]
    pub const fn step_len(self) -> usize {
        BINS * self.grid.cells()
    }

    /// Elements of the whole.
    #[must_use]
    #[expect(clippy::len_without_is_empty, reason = "a grid always has cells")]
    pub const fn len(self) -> usize {
        self.steps * self.step_len()
    }
}

/// How the exposure's true width was met.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Retimed {
    /// The prediction was right to the microsecond.
    Exact,
    /// A little off: so many events were moved to another weight, bin or step.
    Delta {
        /// Events moved.
        moved: u64,
    },
    /// Far off: the whole exposure was rastered again.
    Full,
}

/// What [`VoxelRaster::finish`] did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FinishReport {
    /// How the true width was met.
    pub retimed: Retimed,
    /// What became of the events, under the true exposure.
    pub tally: Tally,
    /// Events of the exposure the history had overwritten when they were needed: never rastered,
    /// or left where the prediction had put them. 0 means the grid is exact.
    pub forgotten: u64,
}

/// The exposure being rastered.
#[derive(Debug, Clone, Copy)]
struct Open {
    predicted: Exposure,
    timing: Timing,
    /// Sequence number of the first event of interest.
    first: u64,
    /// Sequence number of the first event not yet rastered.
    next: u64,
    /// Planes that hold sums so far.
    ready: usize,
    tally: Tally,
    forgotten: u64,
}

/// Turns events into voxel grids in the caller's memory.
///
/// Between [`begin`](Self::begin) and [`finish`](Self::finish) that memory holds integer sums in
/// place of floats; it must be the same slice throughout, and nobody may look at it. What it held
/// before does not matter: it is zeroed plane by plane as events reach it.
#[derive(Debug)]
pub struct VoxelRaster {
    shape: VoxelShape,
    map: PixelMap,
    /// Microseconds whose place a jittering close would change.
    unsure: Changes,
    /// The events at those microseconds.
    candidates: EventList,
    /// Microseconds whose place the true close changed, and the events there.
    changes: Changes,
    moves: EventList,
    open: Option<Open>,
}

impl VoxelRaster {
    /// A raster of `steps` slices on the map's grid. Allocates 17 MiB beside the map.
    ///
    /// # Errors
    /// [`RasterError::Steps`], when `steps` is not in 1..=[`STEPS_MAX`].
    pub fn new(steps: usize, map: PixelMap) -> Result<Self, RasterError> {
        if !(1..=STEPS_MAX).contains(&steps) {
            return Err(RasterError::Steps {
                steps,
                limit: STEPS_MAX,
            });
        }
        Ok(Self {
            shape: VoxelShape {
                steps,
                grid: map.grid(),
            },
            map,
            unsure: Changes::new(),
            candidates: EventList::new(MOVES_MAX),
            changes: Changes::new(),
            moves: EventList::new(MOVES_MAX),
            open: None,
        })
    }

    /// Shape of the grids it makes.
    #[must_use]
    pub const fn shape(&self) -> VoxelShape {
        self.shape
    }

    /// Starts an exposure, and remembers where the prediction says it will close.
    ///
    /// `from` is the sequence number in the history from which on events may belong to it
    /// ([`EventHistory::first_since`] its opening, or the history's `next` at that moment); earlier
    /// ones are never looked at. An exposure begun before and not finished is abandoned.
    pub fn begin(&mut self, predicted: Exposure, from: u64) {
        let steps = self.shape.steps;
        let timing = Timing::new(predicted, steps);
        let longer = timing.with_width((timing.width + JITTER_US).min(EXPOSURE_US_MAX), steps);
        let shorter = timing.with_width(timing.width.saturating_sub(JITTER_US).max(1), steps);
        let can_jitter = Changes::hold(&timing, &longer);
        self.candidates.clear(can_jitter);
        if can_jitter {
            self.unsure.clear(longer.width);
            self.unsure.mark(&timing, &longer, steps);
            self.unsure.mark(&timing, &shorter, steps);
        }
        let tally = Tally::default();
        let (first, next) = (from, from);
        self.open = Some(Open {
            predicted,
            timing,
            first,
            next,
            ready: 0,
            tally,
            forgotten: 0,
        });
    }

    /// Rasters the events that were added to `history` since the last call.
    ///
    /// # Errors
    /// [`RasterError::NotOpen`] before [`begin`](Self::begin); [`RasterError::Length`], when `out`
    /// is not `[steps, BINS, height, width]`.
    pub fn advance(&mut self, history: &EventHistory, out: &mut [f32]) -> Result<(), RasterError> {
        check_len("voxel grid", self.shape.len(), out.len())?;
        let open = self.open.as_mut().ok_or(RasterError::NotOpen)?;
        open.forgotten += history.oldest().saturating_sub(open.next);
        let mut sums = Sums {
            out,
            cells: self.shape.grid.cells(),
            ready: open.ready,
        };
        for events in history.slices(open.next, history.next()) {
            open.tally.add(sums.add(&open.timing, &self.map, events));
            self.candidates.gather(&self.unsure, &open.timing, events);
        }
        open.ready = sums.ready;
        open.next = open.next.max(history.next());
        Ok(())
    }

    /// Rasters what is left in `history`, moves what the true exposure puts elsewhere, and turns
    /// the sums into floats: `out` is the finished grid.
    ///
    /// All events of the exposure must be in `history` by now (the event stream's watermark has
    /// passed the close); later ones in it do no harm.
    ///
    /// # Errors
    /// [`RasterError::NotOpen`] before [`begin`](Self::begin), [`RasterError::Length`] for another
    /// `out`, [`RasterError::StepOverflow`] when more than 8,388,607 events fall into one step. The
    /// exposure stays open after the second, and is closed after the third.
    pub fn finish(
        &mut self,
        exposure: Exposure,
        history: &EventHistory,
        out: &mut [f32],
    ) -> Result<FinishReport, RasterError> {
        self.advance(history, out)?;
        let mut open = self.open.take().ok_or(RasterError::NotOpen)?;
        let new = Timing::new(exposure, self.shape.steps);
        let held = history.slices(open.first, open.next);
        let lost = history.oldest().min(open.next).saturating_sub(open.first);
        let mut sums = Sums {
            out,
            cells: self.shape.grid.cells(),
            ready: open.ready,
        };
        let retimed = if open.predicted == exposure {
            sums.finish();
            Retimed::Exact
        } else if open.predicted.open() == exposure.open() && self.find_moves(&open, &new, held) {
            if !self.candidates.is_complete() {
                open.forgotten = lost;
            }
            let moves = self.moves.events();
            sums.finish_moved([&open.timing, &new], &self.map, moves, &mut open.tally);
            Retimed::Delta {
                moved: moves.len() as u64,
            }
        } else {
            open.forgotten = lost;
            open.tally = Tally::default();
            sums.ready = 0;
            for events in held {
                open.tally.add(sums.add(&new, &self.map, events));
            }
            sums.finish();
            Retimed::Full
        };
        check_steps(&new, self.shape.steps, open.tally.rastered, held)?;
        Ok(FinishReport {
            retimed,
            tally: open.tally,
            forgotten: open.forgotten,
        })
    }

    /// Collects the events whose place differs, in order of time: among the candidates when the
    /// prediction was off by a jitter, else among all. `false`, when rastering anew is better.
    fn find_moves(&mut self, open: &Open, new: &Timing, held: [&[PackedEvent]; 2]) -> bool {
        let (old, steps) = (&open.timing, self.shape.steps);
        let is_jitter = old.width.abs_diff(new.width) <= JITTER_US && self.candidates.is_complete();
        if !is_jitter && !Changes::is_worth_it(old, new, steps) {
            return false;
        }
        self.changes.clear(old.width.max(new.width));
        self.changes.mark(old, new, steps);
        self.moves.clear(true);
        if is_jitter {
            self.moves
                .gather(&self.changes, old, self.candidates.events());
        } else {
            self.candidates.clear(false);
            held.iter()
                .for_each(|events| self.moves.gather(&self.changes, old, events));
        }
        self.moves.sort(old);
        self.moves.is_complete()
    }

    /// Rasters a whole exposure at once: what training does, and what the incremental way equals.
    ///
    /// # Errors
    /// [`RasterError::Length`], when `out` is not `[steps, BINS, height, width]`,
    /// [`RasterError::StepOverflow`] as [`finish`](Self::finish).
    pub fn raster(
        &self,
        exposure: Exposure,
        events: &[PackedEvent],
        out: &mut [f32],
    ) -> Result<Tally, RasterError> {
        check_len("voxel grid", self.shape.len(), out.len())?;
        let timing = Timing::new(exposure, self.shape.steps);
        let mut sums = Sums {
            out,
            cells: self.shape.grid.cells(),
            ready: 0,
        };
        let tally = sums.add(&timing, &self.map, events);
        sums.finish();
        check_steps(&timing, self.shape.steps, tally.rastered, [events, &[]])?;
        Ok(tally)
    }
}

/// Makes sure that no sum can have left 32 bits; costs nothing unless millions of events came.
fn check_steps(
    timing: &Timing,
    steps: usize,
    rastered: u64,
    events: [&[PackedEvent]; 2],
) -> Result<(), RasterError> {
    if rastered <= STEP_EVENTS_MAX {
        return Ok(());
    }
    let mut counts = [0u64; STEPS_MAX];
    for event in events.into_iter().flatten() {
        let elapsed = timing.elapsed(event.t_us);
        if elapsed < timing.width {
            counts[timing.place(elapsed).plane / BINS] += 1;
        }
    }
    match counts[..steps]
        .iter()
        .position(|count| *count > STEP_EVENTS_MAX)
    {
        None => Ok(()),
        Some(step) => Err(RasterError::StepOverflow {
            step,
            events: counts[step],
            limit: STEP_EVENTS_MAX,
        }),
    }
}

//! The voxel raster: begin at the opening, advance while events come, finish at the close.

use super::history::{EventHistory, PackedEvent};
use super::retime::Changes;
use super::timing::{BINS, Exposure, Place, STEPS_MAX, Timing, WHOLE};
use crate::error::check_len;
use crate::geometry::{Lookup, PixelMap, axes_cell, table_cell};
use crate::{Grid, RasterError};

/// Sum at which a cell saturates, in weights.
const CLAMP: i32 = 10 * WHOLE;
/// Events one step may hold without any sum leaving 32 bits, were they all in one cell.
const STEP_EVENTS_MAX: u64 = (i32::MAX / WHOLE) as u64;
/// Changed events gathered before they are moved.
const BATCH: usize = 256;

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

/// What became of events: every one examined is in exactly one of the three counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Tally {
    /// Inside the exposure and the grid.
    pub rastered: u64,
    /// Inside the exposure, outside the grid.
    pub outside_grid: u64,
    /// Before the exposure opened, or after it closed.
    pub outside_exposure: u64,
}

impl Tally {
    /// Events examined.
    #[must_use]
    pub const fn examined(&self) -> u64 {
        self.rastered + self.outside_grid + self.outside_exposure
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
    /// Sequence number of the first event of interest.
    first: u64,
    /// Sequence number of the first event not yet rastered.
    next: u64,
    tally: Tally,
    forgotten: u64,
}

/// Turns events into voxel grids in the caller's memory.
///
/// Between [`begin`](Self::begin) and [`finish`](Self::finish) that memory holds integer sums in
/// place of floats; it must be the same slice throughout, and nobody may look at it.
#[derive(Debug)]
pub struct VoxelRaster {
    shape: VoxelShape,
    map: PixelMap,
    changes: Changes,
    open: Option<Open>,
}

impl VoxelRaster {
    /// A raster of `steps` slices on the map's grid.
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
        let shape = VoxelShape {
            steps,
            grid: map.grid(),
        };
        Ok(Self {
            shape,
            map,
            changes: Changes::new(),
            open: None,
        })
    }

    /// Shape of the grids it makes.
    #[must_use]
    pub const fn shape(&self) -> VoxelShape {
        self.shape
    }

    /// Starts an exposure: zeroes `out` and remembers where the prediction says it will close.
    ///
    /// `from` is the sequence number in the history from which on events may belong to it
    /// ([`EventHistory::first_since`] its opening, or the history's `next` at that moment); earlier
    /// ones are never looked at. An exposure begun before and not finished is abandoned.
    ///
    /// # Errors
    /// [`RasterError::Length`], when `out` is not `[steps, BINS, height, width]`.
    pub fn begin(
        &mut self,
        predicted: Exposure,
        from: u64,
        out: &mut [f32],
    ) -> Result<(), RasterError> {
        self.open = None;
        check_len("voxel grid", self.shape.len(), out.len())?;
        out.fill(0.0);
        let tally = Tally::default();
        self.open = Some(Open {
            predicted,
            first: from,
            next: from,
            tally,
            forgotten: 0,
        });
        Ok(())
    }

    /// Rasters the events that were added to `history` since the last call.
    ///
    /// # Errors
    /// [`RasterError::NotOpen`] before [`begin`](Self::begin), [`RasterError::Length`] for another
    /// `out`.
    pub fn advance(&mut self, history: &EventHistory, out: &mut [f32]) -> Result<(), RasterError> {
        check_len("voxel grid", self.shape.len(), out.len())?;
        let open = self.open.as_mut().ok_or(RasterError::NotOpen)?;
        let timing = Timing::new(open.predicted, self.shape.steps);
        open.forgotten += history.oldest().saturating_sub(open.next);
        for events in history.slices(open.next, history.next()) {
            open.tally.add(add(&timing, &self.map, events, out));
        }
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
        let steps = self.shape.steps;
        let (old, new) = (
            Timing::new(open.predicted, steps),
            Timing::new(exposure, steps),
        );
        let held = history.slices(open.first, open.next);
        let lost = history.oldest().min(open.next).saturating_sub(open.first);
        let retimed = if open.predicted == exposure {
            Retimed::Exact
        } else if Changes::is_worth_it(&old, &new, steps) {
            open.forgotten = open.forgotten.max(lost);
            self.changes.mark(&old, &new, steps);
            let mut moved = 0;
            for events in held {
                moved += shift(
                    &self.changes,
                    [&old, &new],
                    &self.map,
                    events,
                    out,
                    &mut open.tally,
                );
            }
            Retimed::Delta { moved }
        } else {
            open.forgotten = lost;
            open.tally = Tally::default();
            out.fill(0.0);
            for events in held {
                open.tally.add(add(&new, &self.map, events, out));
            }
            Retimed::Full
        };
        check_steps(&new, steps, open.tally.rastered, held)?;
        finalise(out);
        Ok(FinishReport {
            retimed,
            tally: open.tally,
            forgotten: open.forgotten,
        })
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
        out.fill(0.0);
        let tally = add(&timing, &self.map, events, out);
        check_steps(&timing, self.shape.steps, tally.rastered, [events, &[]])?;
        finalise(out);
        Ok(tally)
    }
}

impl Tally {
    fn add(&mut self, other: Self) {
        self.rastered += other.rastered;
        self.outside_grid += other.outside_grid;
        self.outside_exposure += other.outside_exposure;
    }
}

/// Adds `weight` to the integer kept in a cell of the output.
#[inline(always)]
fn bump(cell: &mut f32, weight: i32) {
    let sum = cell.to_bits().cast_signed().wrapping_add(weight);
    *cell = f32::from_bits(sum.cast_unsigned());
}

/// Adds `sign` times an event at `place` and `cell` to the sums.
#[inline(always)]
fn put(out: &mut [f32], cells: usize, place: Place, cell: u32, sign: i32) {
    let start = place.plane * cells + cell as usize;
    let pair = &mut out[start..=start + cells];
    bump(&mut pair[0], sign * (WHOLE - place.later));
    bump(&mut pair[cells], sign * place.later);
}

/// Adds all events to the sums.
fn add(timing: &Timing, map: &PixelMap, events: &[PackedEvent], out: &mut [f32]) -> Tally {
    let cells = map.grid().cells();
    match &map.lookup {
        Lookup::Axes { columns, rows } => {
            let (columns, rows) = (&columns[..2048], &rows[..2048]);
            add_with(
                timing,
                cells,
                |x, y| axes_cell(columns, rows, x, y),
                events,
                out,
            )
        }
        Lookup::Table {
            width,
            cells: table,
        } => add_with(
            timing,
            cells,
            |x, y| table_cell(*width, table, x, y),
            events,
            out,
        ),
    }
}

#[inline(always)]
fn add_with(
    timing: &Timing,
    cells: usize,
    cell_of: impl Fn(u32, u32) -> u32,
    events: &[PackedEvent],
    out: &mut [f32],
) -> Tally {
    let (mut rastered, mut outside_grid) = (0, 0);
    for event in events {
        let elapsed = timing.elapsed(event.t_us);
        if elapsed >= timing.width {
            continue;
        }
        let cell = cell_of(event.x(), event.y());
        if cell as usize >= cells {
            outside_grid += 1;
            continue;
        }
        put(out, cells, timing.place(elapsed), cell, event.sign());
        rastered += 1;
    }
    let outside_exposure = events.len() as u64 - rastered - outside_grid;
    Tally {
        rastered,
        outside_grid,
        outside_exposure,
    }
}

/// Moves the events whose place differs between `old` and `new`; returns how many.
fn shift(
    changes: &Changes,
    [old, new]: [&Timing; 2],
    map: &PixelMap,
    events: &[PackedEvent],
    out: &mut [f32],
    tally: &mut Tally,
) -> u64 {
    let mut moved = 0;
    for batch in events.chunks(BATCH) {
        // Gathers without branching; the moves are few.
        let mut changed = [PackedEvent::default(); BATCH];
        let mut count = 0;
        for event in batch {
            changed[count % BATCH] = *event;
            count += changes.at(old.elapsed(event.t_us));
        }
        for event in &changed[..count] {
            moved += u64::from(shift_one([old, new], map, *event, out, tally));
        }
    }
    moved
}

/// Takes one event out of its old place and puts it into its new one; `false` when it has none.
fn shift_one(
    [old, new]: [&Timing; 2],
    map: &PixelMap,
    event: PackedEvent,
    out: &mut [f32],
    tally: &mut Tally,
) -> bool {
    let elapsed = old.elapsed(event.t_us);
    let (was, is) = (elapsed < old.width, elapsed < new.width);
    let cells = map.grid().cells();
    let cell = match &map.lookup {
        Lookup::Axes { columns, rows } => axes_cell(columns, rows, event.x(), event.y()),
        Lookup::Table { width, cells } => table_cell(*width, cells, event.x(), event.y()),
    };
    let inside = (cell as usize) < cells;
    if was != is {
        let count = if inside {
            &mut tally.rastered
        } else {
            &mut tally.outside_grid
        };
        let (from, to) = if is {
            (&mut tally.outside_exposure, count)
        } else {
            (count, &mut tally.outside_exposure)
        };
        *from -= 1;
        *to += 1;
    }
    if inside && was {
        put(out, cells, old.place(elapsed), cell, -event.sign());
    }
    if inside && is {
        put(out, cells, new.place(elapsed), cell, event.sign());
    }
    inside
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

/// Sums of weights -> clamped, scaled floats, in place.
///
/// The quotient is rounded once: a clamped sum of 256ths over 2560 is that sum over 10.
fn finalise(out: &mut [f32]) {
    for cell in out {
        let sum = cell.to_bits().cast_signed().clamp(-CLAMP, CLAMP);
        *cell = sum as f32 / CLAMP as f32;
    }
}

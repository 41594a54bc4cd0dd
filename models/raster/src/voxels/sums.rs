//! Integer sums kept in the output's own memory, plane by plane.

use super::history::PackedEvent;
use super::tally::Tally;
use super::timing::{Place, Timing, WHOLE};
use crate::geometry::{Lookup, PixelMap, axes_cell, table_cell};

/// Sum at which a cell saturates, in weights.
const CLAMP: i32 = 10 * WHOLE;
/// Cells of 4 bytes in a cache line.
const LINE: usize = 16;
/// Moves per plane from which on reading the plane into cache first is the faster way.
const MOVES_PER_PLANE: usize = 128;

/// The planes of a voxel grid while they hold sums.
///
/// A plane is zeroed when the first event reaches it, not before: that is when it has to come into
/// cache anyway. INVARIANT: planes below `ready` hold sums, those from there on hold anything.
pub(super) struct Sums<'a> {
    pub out: &'a mut [f32],
    pub cells: usize,
    pub ready: usize,
}

impl Sums<'_> {
    /// Adds all events.
    pub fn add(&mut self, timing: &Timing, map: &PixelMap, events: &[PackedEvent]) -> Tally {
        match &map.lookup {
            Lookup::Axes { columns, rows } => {
                let (columns, rows) = (&columns[..2048], &rows[..2048]);
                self.add_with(timing, |x, y| axes_cell(columns, rows, x, y), events)
            }
            Lookup::Table { width, cells } => {
                self.add_with(timing, |x, y| table_cell(*width, cells, x, y), events)
            }
        }
    }

    #[inline(always)]
    fn add_with(
        &mut self,
        timing: &Timing,
        cell_of: impl Fn(u32, u32) -> u32,
        events: &[PackedEvent],
    ) -> Tally {
        let (mut rastered, mut outside_grid) = (0, 0);
        for event in events {
            let elapsed = timing.elapsed(event.t_us);
            if elapsed >= timing.width {
                continue;
            }
            let cell = cell_of(event.x(), event.y());
            if cell as usize >= self.cells {
                outside_grid += 1;
                continue;
            }
            self.put(timing.place(elapsed), cell, event.sign());
            rastered += 1;
        }
        let outside_exposure = events.len() as u64 - rastered - outside_grid;
        Tally {
            rastered,
            outside_grid,
            outside_exposure,
        }
    }

    /// Adds `sign` times an event.
    #[inline(always)]
    fn put(&mut self, place: Place, cell: u32, sign: i32) {
        if place.plane + 2 > self.ready {
            self.make_ready(place.plane + 2);
        }
        let start = place.plane * self.cells + cell as usize;
        let pair = &mut self.out[start..=start + self.cells];
        bump(&mut pair[0], sign * (WHOLE - place.later));
        bump(&mut pair[self.cells], sign * place.later);
    }

    #[cold]
    fn make_ready(&mut self, planes: usize) {
        self.out[self.ready * self.cells..planes * self.cells].fill(0.0);
        self.ready = planes;
    }

    /// Turns all sums into floats.
    pub fn finish(mut self) {
        self.finish_planes(0, self.out.len() / self.cells);
    }

    /// Moves events from where `old` puts them to where `new` does, and turns all sums into floats,
    /// plane by plane while each is in cache. `moves` is in order of time.
    pub fn finish_moved(
        mut self,
        [old, new]: [&Timing; 2],
        map: &PixelMap,
        moves: &[PackedEvent],
        tally: &mut Tally,
    ) {
        let planes = self.out.len() / self.cells;
        let read_ahead = moves.len() >= MOVES_PER_PLANE * planes;
        let (mut finished, mut read) = (0, 0);
        for event in moves {
            let elapsed = old.elapsed(event.t_us);
            let place = |timing: &Timing| (elapsed < timing.width).then(|| timing.place(elapsed));
            let (was, is) = (place(old), place(new));
            let Some(cell) = cell_of(map, *event) else {
                recount(
                    was.is_some(),
                    is.is_some(),
                    &mut tally.outside_grid,
                    &mut tally.outside_exposure,
                );
                continue;
            };
            recount(
                was.is_some(),
                is.is_some(),
                &mut tally.rastered,
                &mut tally.outside_exposure,
            );
            // Places only ever grow with time, so no later move reaches below the lower one.
            let (Some(low), Some(high)) = (was.min(is).or(was).or(is), was.max(is)) else {
                continue;
            };
            if finished < low.plane {
                self.finish_planes(finished, low.plane);
                finished = low.plane;
            }
            if read_ahead && read < high.plane + 2 {
                self.read_planes(read.max(finished), high.plane + 2);
                read = high.plane + 2;
            }
            if let Some(place) = was {
                self.put(place, cell, -event.sign());
            }
            if let Some(place) = is {
                self.put(place, cell, event.sign());
            }
        }
        self.finish_planes(finished, planes);
    }

    /// Sums -> clamped, scaled floats, in place.
    ///
    /// The quotient is rounded once: a clamped sum of 256ths over 2560 is that sum over 10.
    fn finish_planes(&mut self, from: usize, to: usize) {
        if to > self.ready {
            self.make_ready(to);
        }
        for cell in &mut self.out[from * self.cells..to * self.cells] {
            let sum = cell.to_bits().cast_signed().clamp(-CLAMP, CLAMP);
            *cell = sum as f32 / CLAMP as f32;
        }
    }

    /// Reads planes in order, a cache line at a time, so that random access finds them near.
    fn read_planes(&self, from: usize, to: usize) {
        let to = to.min(self.ready);
        if from < to {
            let lines = self.out[from * self.cells..to * self.cells]
                .iter()
                .step_by(LINE);
            std::hint::black_box(lines.fold(0, |all, cell| all ^ cell.to_bits()));
        }
    }
}

/// Adds `weight` to the integer kept in a cell of the output.
#[inline(always)]
fn bump(cell: &mut f32, weight: i32) {
    let sum = cell.to_bits().cast_signed().wrapping_add(weight);
    *cell = f32::from_bits(sum.cast_unsigned());
}

fn cell_of(map: &PixelMap, event: PackedEvent) -> Option<u32> {
    let cell = match &map.lookup {
        Lookup::Axes { columns, rows } => axes_cell(columns, rows, event.x(), event.y()),
        Lookup::Table { width, cells } => table_cell(*width, cells, event.x(), event.y()),
    };
    ((cell as usize) < map.grid().cells()).then_some(cell)
}

/// An event entered the exposure, or left it.
fn recount(was: bool, is: bool, inside: &mut u64, outside: &mut u64) {
    if is && !was {
        (*inside, *outside) = (*inside + 1, *outside - 1);
    } else if was && !is {
        (*inside, *outside) = (*inside - 1, *outside + 1);
    }
}

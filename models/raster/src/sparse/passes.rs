//! Cuts the stream of returns into passes over the camera's field of view, and keeps the newest.

use std::time::Duration;

use noctule_sensor::{Return, Stamp, Tai};

use super::window::{AzimuthWindow, SLACK_CDEG, TURN_CDEG};
use crate::RasterError;

/// A return inside the window.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PassPoint {
    /// When the laser fired.
    pub at: Stamp<Tai>,
    /// Metres, in the LiDAR's frame at that instant.
    pub xyz_m: [f32; 3],
}

/// One sweep of the beams over the camera's field of view.
#[derive(Debug, Clone)]
pub struct Pass {
    id: u64,
    ended: Stamp<Tai>,
    points: Vec<PassPoint>,
    gap_cdeg_max: u32,
    overflowed: u64,
}

impl Pass {
    /// Counts passes, gaps included: a later pass has a higher number.
    #[must_use]
    pub const fn id(&self) -> u64 {
        self.id
    }

    /// When its last return was fired; for a pass without returns, when the beams were seen to have
    /// left the window.
    #[must_use]
    pub const fn ended(&self) -> Stamp<Tai> {
        self.ended
    }

    /// Its returns, in the order they came.
    #[must_use]
    pub fn points(&self) -> &[PassPoint] {
        &self.points
    }

    /// Widest step of block azimuth inside the window, hundredths of a degree: a firing's width,
    /// unless packets were lost (or nothing but sky was there, where only returns tell).
    #[must_use]
    pub const fn gap_cdeg_max(&self) -> u32 {
        self.gap_cdeg_max
    }

    /// Returns that found no room.
    #[must_use]
    pub const fn overflowed(&self) -> u64 {
        self.overflowed
    }
}

/// What became of passes and returns so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PassCounts {
    /// Passes seen from their entry to beyond their exit.
    pub complete: u64,
    /// Passes thrown away because their entry or their exit was missed.
    pub partial: u64,
    /// Returns kept.
    pub kept: u64,
    /// Returns outside the camera's window.
    pub outside_window: u64,
    /// Returns that came when their pass was over, or inside a pass of which the entry was missed.
    pub unplaced: u64,
    /// Returns that found their pass full.
    pub overflowed: u64,
    /// Returns of a channel the correction table does not have.
    pub unknown_channel: u64,
    /// Times the clock went back by more than a turn, upon which all passes were forgotten.
    pub clock_steps: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    /// Between passes, or in one whose entry was missed.
    Idle,
    /// Inside a pass that was seen from its entry.
    Inside,
}

/// Cuts returns into passes and keeps the newest complete ones, in memory allocated once.
///
/// A pass is complete when every channel that the camera can see has moved beyond the window's far
/// edge, judged by the azimuth of whatever block arrives, so a lost packet does not matter. Each
/// return belongs to the pass its channel's corrected azimuth lies in.
#[derive(Debug)]
pub struct PassTracker {
    window: AzimuthWindow,
    rotation_ns: u64,
    /// Complete passes; `slots[current]` is the one being filled. A slot with id 0 is empty.
    slots: Vec<Pass>,
    current: usize,
    phase: Phase,
    last: Option<Progress>,
    next_id: u64,
    counts: PassCounts,
}

/// How far the beams were when last seen.
#[derive(Debug, Clone, Copy)]
struct Progress {
    at: Stamp<Tai>,
    along_cdeg: u32,
}

impl PassTracker {
    /// Keeps the newest `passes` complete passes of at most `points_max` returns each. `rotation`
    /// is the nominal time of one turn.
    ///
    /// # Errors
    /// [`RasterError::Setting`] for a number out of bounds.
    pub fn new(
        window: AzimuthWindow,
        rotation: Duration,
        passes: usize,
        points_max: usize,
    ) -> Result<Self, RasterError> {
        let check = |name, value: f64, min, max| {
            let ok = (min..=max).contains(&value);
            ok.then_some(()).ok_or(RasterError::Setting {
                name,
                value,
                min,
                max,
            })
        };
        check("rotation in s", rotation.as_secs_f64(), 0.01, 10.0)?;
        check("passes kept", passes as f64, 1.0, 256.0)?;
        check("returns per pass", points_max as f64, 1.0, 1e6)?;
        let empty = || Pass {
            id: 0,
            ended: Stamp::ZERO,
            points: Vec::with_capacity(points_max),
            gap_cdeg_max: 0,
            overflowed: 0,
        };
        Ok(Self {
            window,
            rotation_ns: rotation.as_nanos() as u64, // at most 10^10
            slots: (0..=passes).map(|_| empty()).collect(),
            current: 0,
            phase: Phase::Idle,
            last: None,
            next_id: 1,
            counts: PassCounts::default(),
        })
    }

    /// The arc of azimuths and the channels it looks at.
    #[must_use]
    pub const fn window(&self) -> &AzimuthWindow {
        &self.window
    }

    /// What became of passes and returns so far.
    #[must_use]
    pub const fn counts(&self) -> PassCounts {
        self.counts
    }

    /// The complete passes held, in no order.
    pub fn passes(&self) -> impl Iterator<Item = &Pass> {
        self.slots().map(|(_, pass)| pass)
    }

    /// The newest complete pass that ended before `instant`.
    #[must_use]
    pub fn newest_before(&self, instant: Stamp<Tai>) -> Option<&Pass> {
        self.slot_before(instant).map(|slot| &self.slots[slot])
    }

    pub(super) fn slot_before(&self, instant: Stamp<Tai>) -> Option<usize> {
        let ended = self.slots().filter(|(_, pass)| pass.ended < instant);
        ended.max_by_key(|(_, pass)| pass.id).map(|(slot, _)| slot)
    }

    pub(super) fn slot_pass(&self, slot: usize) -> &Pass {
        &self.slots[slot]
    }

    fn slots(&self) -> impl Iterator<Item = (usize, &Pass)> {
        let held = move |(slot, pass): &(usize, &Pass)| pass.id != 0 && *slot != self.current;
        self.slots.iter().enumerate().filter(held)
    }

    /// Takes a return, fired at `at`; returns come in the order of arrival.
    pub fn push(&mut self, at: Stamp<Tai>, echo: &Return) {
        let Some(block_cdeg) = self.window.block_of(echo.channel, echo.azimuth_cdeg) else {
            self.counts.unknown_channel += 1;
            return;
        };
        self.note_block(at, block_cdeg);
        if !self.window.holds(echo.channel, echo.azimuth_cdeg) {
            self.counts.outside_window += 1;
            return;
        }
        if self.phase != Phase::Inside {
            self.counts.unplaced += 1;
            return;
        }
        let pass = &mut self.slots[self.current];
        if pass.points.len() == pass.points.capacity() {
            pass.overflowed += 1;
            self.counts.overflowed += 1;
            return;
        }
        pass.points.push(PassPoint {
            at,
            xyz_m: [echo.x_m, echo.y_m, echo.z_m],
        });
        pass.ended = pass.ended.max(at);
        self.counts.kept += 1;
    }

    /// Notes that a block at `block_cdeg` (raw, hundredths of a degree) was fired at `at`, whether
    /// or not it held a return. Returns say so themselves; calling this for every packet makes
    /// progress visible where there is nothing but sky.
    pub fn note_block(&mut self, at: Stamp<Tai>, block_cdeg: u32) {
        let along_cdeg = self.window.along(block_cdeg);
        let now = Progress { at, along_cdeg };
        let Some(last) = self.last else {
            self.last = Some(now);
            return;
        };
        let Some(passed) = at.since(last.at) else {
            self.note_earlier(last, now);
            return;
        };
        let forward = (along_cdeg + TURN_CDEG - last.along_cdeg) % TURN_CDEG;
        if passed.as_nanos() > u128::from(self.rotation_ns) * 3 / 4 {
            // Too long a silence to know which turn this is.
            self.abandon();
            self.last = Some(now);
        } else if forward > TURN_CDEG - SLACK_CDEG {
            self.last = Some(Progress { at, ..last }); // a rounding step back: the same block
        } else {
            self.last = Some(now);
            self.move_on(last, now, forward);
        }
    }

    /// An instant before the newest: blocks of one firing share their times, packets may swap; a
    /// whole turn back is a step of the clock.
    fn note_earlier(&mut self, last: Progress, now: Progress) {
        if last.at.diff_nanos(now.at).unsigned_abs() <= self.rotation_ns {
            return;
        }
        self.abandon();
        for pass in &mut self.slots {
            pass.id = 0;
        }
        self.counts.clock_steps += 1;
        self.last = Some(now);
    }

    fn move_on(&mut self, last: Progress, now: Progress, forward_cdeg: u32) {
        let exit = self.window.exit() + SLACK_CDEG;
        let wrapped = now.along_cdeg < last.along_cdeg;
        if self.phase == Phase::Inside {
            let inside_cdeg = forward_cdeg.min(exit - last.along_cdeg.min(exit));
            let pass = &mut self.slots[self.current];
            pass.gap_cdeg_max = pass.gap_cdeg_max.max(inside_cdeg);
            if wrapped || now.along_cdeg > exit {
                self.complete(now.at);
            }
        }
        if wrapped {
            self.enter(now.along_cdeg);
            if now.along_cdeg > exit {
                self.complete(now.at); // nothing was seen of it but that it is over
            }
        }
    }

    fn enter(&mut self, along_cdeg: u32) {
        let pass = &mut self.slots[self.current];
        pass.id = self.next_id;
        pass.ended = Stamp::ZERO;
        pass.points.clear();
        pass.gap_cdeg_max = along_cdeg;
        pass.overflowed = 0;
        self.next_id += 1;
        self.phase = Phase::Inside;
    }

    fn complete(&mut self, now: Stamp<Tai>) {
        let pass = &mut self.slots[self.current];
        if pass.points.is_empty() {
            pass.ended = now;
        }
        self.counts.complete += 1;
        self.phase = Phase::Idle;
        // The oldest slot (an empty one, id 0, before all others) is filled next.
        let oldest = (0..self.slots.len()).min_by_key(|slot| self.slots[*slot].id);
        self.current = oldest.unwrap_or(0);
    }

    fn abandon(&mut self) {
        if self.phase == Phase::Inside {
            self.slots[self.current].id = 0;
            self.counts.partial += 1;
            self.phase = Phase::Idle;
        }
    }
}

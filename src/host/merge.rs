//! Merges the lanes into one order: by arrival, equal arrivals by lane.
//!
//! A block is taken when no other lane can still deliver an earlier one, which lanes promise. So
//! the order is that of the arrival stamps, whoever ran first.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use noctule_sensor::{Realtime, Stamp};

use super::assembler::Assembler;
use super::blocks::{EventBlock, ImageBlock, MotionBlock, ReturnBlock};
use super::outlet::Outlet;
use crate::bus::BusError;
use crate::lane::Consumer;

/// The longest sleep when nothing can be taken.
const NAP: Duration = Duration::from_millis(2);

/// The lanes into the host; a sensor that is not there has none.
#[derive(Debug, Default)]
pub struct Lanes {
    /// Event camera.
    pub events: Option<Consumer<EventBlock>>,
    /// LiDAR.
    pub lidar: Option<Consumer<ReturnBlock>>,
    /// Frame camera.
    pub images: Option<Consumer<ImageBlock>>,
    /// CAN and host clocks.
    pub motion: Option<Consumer<MotionBlock>>,
}

/// How far each lane has promised; the bound that merging works with.
pub type Promises = [Stamp<Realtime>; 4];

/// One lane's oldest block, or how early the next can be.
struct Head<T> {
    lane: Option<Consumer<T>>,
    block: Option<Box<T>>,
    floor: Stamp<Realtime>,
}

impl<T> Head<T> {
    fn new(lane: Option<Consumer<T>>) -> Self {
        let floor = if lane.is_some() {
            Stamp::ZERO
        } else {
            Stamp::MAX
        };
        Self {
            lane,
            block: None,
            floor,
        }
    }

    /// Looks for a block; `arrival` reads its stamp.
    fn look(&mut self, arrival: impl Fn(&T) -> Stamp<Realtime>) {
        if self.block.is_some() {
            return;
        }
        let Some(lane) = &mut self.lane else { return };
        // Both are read before the lane is found empty.
        let (closed, promised) = (lane.is_closed(), lane.promised());
        match lane.pop() {
            Some(block) => {
                self.floor = arrival(&block);
                self.block = Some(block);
            }
            None if closed => {
                self.floor = Stamp::MAX;
                self.lane = None;
            }
            None => self.floor = self.floor.max(promised),
        }
    }

    fn give_back(&mut self, block: Box<T>) {
        if let Some(lane) = &mut self.lane {
            lane.give_back(block);
        }
    }

    fn is_over(&self) -> bool {
        self.lane.is_none() && self.block.is_none()
    }
}

/// Runs the host until all lanes are closed and empty, or `stop` is set.
///
/// # Errors
/// When the outlet fails.
pub fn run<O: Outlet>(
    assembler: &mut Assembler<O>,
    lanes: Lanes,
    stop: &AtomicBool,
) -> Result<(), BusError> {
    let mut events = Head::new(lanes.events);
    let mut lidar = Head::new(lanes.lidar);
    let mut images = Head::new(lanes.images);
    let mut motion = Head::new(lanes.motion);
    let mut now = Stamp::ZERO;
    while !stop.load(Ordering::Relaxed) {
        events.look(|b| b.arrival);
        lidar.look(|b| b.arrival);
        images.look(|b| b.stamp.arrival);
        motion.look(MotionBlock::arrival);
        let floors: Promises = [events.floor, lidar.floor, images.floor, motion.floor];
        let ready = [
            events.block.is_some(),
            lidar.block.is_some(),
            images.block.is_some(),
            motion.block.is_some(),
        ];
        let (next, earliest) = earliest(&floors);
        if !ready[next] {
            if events.is_over() && lidar.is_over() && images.is_over() && motion.is_over() {
                break;
            }
            if earliest > now && earliest < Stamp::MAX {
                now = earliest;
                assembler.due(now)?;
            } else {
                std::thread::park_timeout(NAP);
            }
            continue;
        }
        now = now.max(earliest);
        match next {
            0 => {
                if let Some(block) = events.block.take() {
                    assembler.events(&block)?;
                    events.give_back(block);
                }
            }
            1 => {
                if let Some(block) = lidar.block.take() {
                    assembler.returns(&block)?;
                    lidar.give_back(block);
                }
            }
            2 => {
                if let Some(block) = images.block.take() {
                    assembler.image(block)?;
                }
            }
            _ => {
                if let Some(block) = motion.block.take() {
                    assembler.motion(&block)?;
                    motion.give_back(block);
                }
            }
        }
        while let Some(image) = assembler.take_returned() {
            images.give_back(image);
        }
    }
    assembler.finish(now)
}

/// The lane whose next block is due first, and when; of equals the first lane.
fn earliest(floors: &Promises) -> (usize, Stamp<Realtime>) {
    let mut best = (0, floors[0]);
    for (lane, &floor) in floors.iter().enumerate().skip(1) {
        if floor < best.1 {
            best = (lane, floor);
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_equal_arrivals_the_first_lane_goes_first() {
        let at = |n| Stamp::from_nanos(n);
        assert_eq!(earliest(&[at(5), at(3), at(3), at(9)]), (1, at(3)));
        assert_eq!(earliest(&[at(3), at(3), at(3), at(3)]), (0, at(3)));
    }
}

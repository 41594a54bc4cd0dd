//! Exposures between their opening and their sending, each with the memory it is written to.

use noctule_sensor::{Evk4, Stamp, Tai};

use crate::frame::STEPS_MAX;

/// The instants of an exposure on the common timeline.
#[derive(Debug, Clone, Copy)]
pub(super) struct Times {
    pub open: Stamp<Tai>,
    pub close: Stamp<Tai>,
    pub centres: [Stamp<Tai>; STEPS_MAX],
    pub uncertainty_ns: u64,
    pub is_settled: bool,
}

/// One exposure under construction.
#[derive(Debug)]
pub(super) struct Berth<L> {
    /// The exposure's number.
    pub id: u64,
    pub slot: L,
    pub open: Stamp<Evk4>,
    pub close: Option<Stamp<Evk4>>,
    /// Width its voxels were finished for; `None` while they are not.
    pub voxels: Option<(Stamp<Evk4>, Stamp<Evk4>)>,
    pub events: u64,
    pub events_outside: u64,
    pub events_forgotten: u64,
    pub times: Option<Times>,
    pub sparse_drawn: bool,
    pub returns: u32,
    pub has_pass: bool,
    pub has_motion: bool,
    pub image: Option<u32>,
    pub close_received_ns: u64,
    pub inputs_received_ns: u64,
}

/// A bounded set of berths.
#[derive(Debug)]
pub(super) struct Bay<L> {
    berths: Vec<Berth<L>>,
}

impl<L> Bay<L> {
    pub fn new(capacity: usize) -> Self {
        Self {
            berths: Vec::with_capacity(capacity),
        }
    }

    pub fn add(&mut self, id: u64, slot: L, open: Stamp<Evk4>) {
        if self.berths.len() == self.berths.capacity() {
            return;
        }
        self.berths.push(Berth {
            id,
            slot,
            open,
            close: None,
            voxels: None,
            events: 0,
            events_outside: 0,
            events_forgotten: 0,
            times: None,
            sparse_drawn: false,
            returns: 0,
            has_pass: false,
            has_motion: false,
            image: None,
            close_received_ns: 0,
            inputs_received_ns: 0,
        });
    }

    pub fn is_full(&self) -> bool {
        self.berths.len() == self.berths.capacity()
    }

    pub fn get(&mut self, id: u64) -> Option<&mut Berth<L>> {
        self.berths.iter_mut().find(|b| b.id == id)
    }

    pub fn take(&mut self, id: u64) -> Option<Berth<L>> {
        let index = self.berths.iter().position(|b| b.id == id)?;
        Some(self.berths.remove(index))
    }

    pub fn iter_mut(&mut self) -> impl Iterator<Item = &mut Berth<L>> {
        self.berths.iter_mut()
    }
}

//! An outlet that sends no faster than everything sent is consumed: for lossless runs.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use crate::bus::BusError;
use crate::frame::BundleHeader;
use crate::host::Outlet;
use crate::observe::Gate;

/// Wraps an outlet; with a gate, every send waits until the sequences before it are finished.
pub struct GatedOutlet<O: Outlet> {
    inner: O,
    gate: Option<(Arc<Gate>, Arc<AtomicBool>)>,
}

impl<O: Outlet> GatedOutlet<O> {
    /// No gate: sends at once.
    pub fn open(inner: O) -> Self {
        Self { inner, gate: None }
    }

    /// Waits at `gate`; gives up waiting when `stop` is set.
    pub fn gated(inner: O, gate: Arc<Gate>, stop: Arc<AtomicBool>) -> Self {
        Self {
            inner,
            gate: Some((gate, stop)),
        }
    }

    fn wait(&self, sequence: u64) {
        let Some((gate, stop)) = &self.gate else {
            return;
        };
        while !gate.is_clear() && !stop.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_micros(200));
        }
        gate.passes(sequence);
    }
}

impl<O: Outlet> Outlet for GatedOutlet<O> {
    type Slot = O::Slot;

    fn lend(&mut self) -> Option<Self::Slot> {
        self.inner.lend()
    }

    fn send(&mut self, slot: Self::Slot, header: BundleHeader) -> Result<BundleHeader, BusError> {
        self.wait(header.sequence);
        self.inner.send(slot, header)
    }

    fn now_ns(&self) -> u64 {
        self.inner.now_ns()
    }
}

//! An outlet that sends no faster than everything sent is consumed: for lossless runs.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use crate::bus::BusError;
use crate::frame::BundleHeader;
use crate::host::Outlet;
use crate::observe::Gate;

/// Bundles on their way at once.
const IN_FLIGHT_MAX: u64 = 1;

/// Wraps an outlet; with a gate, every send waits until the sequences before it are finished.
pub struct GatedOutlet<O: Outlet> {
    inner: O,
    gate: Option<(Arc<Gate>, Arc<AtomicBool>)>,
    sent: u64,
}

impl<O: Outlet> GatedOutlet<O> {
    /// No gate: sends at once.
    pub fn open(inner: O) -> Self {
        Self { inner, gate: None, sent: 0 }
    }

    /// Waits at `gate`; gives up waiting when `stop` is set.
    pub fn gated(inner: O, gate: Arc<Gate>, stop: Arc<AtomicBool>) -> Self {
        Self { inner, gate: Some((gate, stop)), sent: 0 }
    }

    fn wait(&self) {
        let Some((gate, stop)) = &self.gate else { return };
        let ready = || {
            // Acquire pairs with the observer's Release.
            gate.finished.load(Ordering::Acquire) + IN_FLIGHT_MAX > self.sent
                && gate.bundles_seen.load(Ordering::Acquire) + IN_FLIGHT_MAX > self.sent
        };
        while !ready() && !stop.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_micros(200));
        }
    }
}

impl<O: Outlet> Outlet for GatedOutlet<O> {
    type Slot = O::Slot;

    fn lend(&mut self) -> Option<Self::Slot> {
        self.inner.lend()
    }

    fn send(&mut self, slot: Self::Slot, header: BundleHeader) -> Result<BundleHeader, BusError> {
        self.wait();
        self.sent += 1;
        self.inner.send(slot, header)
    }

    fn now_ns(&self) -> u64 {
        self.inner.now_ns()
    }
}

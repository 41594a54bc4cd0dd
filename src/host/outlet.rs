//! Where bundles go: shared memory in the product, plain memory in tests.

use iceoryx2::service::Service;

use crate::bus::{BusError, Loan, Sender};
use crate::frame::{BundleHeader, BundleLayout, BundlePlanesMut};

/// Memory that a bundle is being written to.
pub trait Slot {
    /// Its planes.
    fn planes(&mut self, layout: &BundleLayout) -> Option<BundlePlanesMut<'_>>;
}

/// Lends memory, sends it, and knows the time of day.
pub trait Outlet {
    /// What it lends.
    type Slot: Slot;

    /// Memory for one bundle; `None` when all is lent.
    fn lend(&mut self) -> Option<Self::Slot>;

    /// Sends a written bundle; stamps `sent_ns`.
    ///
    /// # Errors
    /// When the transport fails.
    fn send(&mut self, slot: Self::Slot, header: BundleHeader) -> Result<BundleHeader, BusError>;

    /// `CLOCK_MONOTONIC`, nanoseconds; used for stage stamps and nothing else.
    fn now_ns(&self) -> u64;
}

/// The bus as outlet.
pub struct BusOutlet<S: Service> {
    sender: Sender<S, BundleHeader>,
}

impl<S: Service> BusOutlet<S> {
    /// Sends over `sender`.
    #[must_use]
    pub fn new(sender: Sender<S, BundleHeader>) -> Self {
        Self { sender }
    }
}

impl<S: Service> Slot for Loan<S, BundleHeader> {
    fn planes(&mut self, layout: &BundleLayout) -> Option<BundlePlanesMut<'_>> {
        layout.planes_mut(self.payload_mut()).ok()
    }
}

impl<S: Service> Outlet for BusOutlet<S> {
    type Slot = Loan<S, BundleHeader>;

    fn lend(&mut self) -> Option<Self::Slot> {
        self.sender.loan().ok()
    }

    fn send(
        &mut self,
        mut slot: Self::Slot,
        mut header: BundleHeader,
    ) -> Result<BundleHeader, BusError> {
        header.stages.sent_ns = self.now_ns();
        *slot.header_mut() = header;
        self.sender.send(slot)?;
        Ok(header)
    }

    fn now_ns(&self) -> u64 {
        crate::latency::monotonic_ns()
    }
}

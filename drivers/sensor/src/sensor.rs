//! The face every device and every recorded capture shows the host.

use crate::{Clock, Stamp};

/// Takes samples one by one; a ring's producer in the host, a `Vec` in tests.
pub trait Sink<T> {
    /// Takes `sample`, or gives it back when there is no room; the caller decides and counts.
    ///
    /// # Errors
    /// The sample itself, when the sink is full.
    fn push(&mut self, sample: T) -> Result<(), T>;
}

/// A device that hands its samples to the caller.
///
/// `poll` does not block, allocates nothing after the device was opened, and reports loss rather
/// than hiding it. The caller owns the pace and the thread.
pub trait Sensor {
    /// The clock its samples are stamped with.
    type Clock: Clock;
    /// What it delivers.
    type Sample;
    /// Why it can deliver no more.
    type Error: core::error::Error;

    /// Hands over what is there.
    ///
    /// # Errors
    /// When the device is gone or unusable; bad data is counted, not an error.
    fn poll(&mut self, out: &mut impl Sink<Self::Sample>)
    -> Result<Poll<Self::Clock>, Self::Error>;
}

/// What one call to [`Sensor::poll`] did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Poll<C: Clock> {
    /// Samples handed over.
    pub samples: u32,
    /// Samples the device produced and the host never saw.
    pub lost: u32,
    /// No sample stamped earlier than this will ever follow.
    pub watermark: Option<Stamp<C>>,
}

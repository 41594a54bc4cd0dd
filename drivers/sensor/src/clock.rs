//! One type per oscillator.

use core::fmt::Debug;
use core::hash::Hash;

/// A clock domain; its implementors are markers that have no values' worth of state.
pub trait Clock: Debug + Copy + Eq + Ord + Hash + Send + Sync + 'static {
    /// Short lower-case name, as written in files and reports.
    const NAME: &'static str;
}

macro_rules! clocks {
    ($($(#[$doc:meta])* $name:ident = $text:literal;)*) => {$(
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub enum $name {}
        impl Clock for $name {
            const NAME: &'static str = $text;
        }
    )*};
}

clocks! {
    /// The EVK4's counter: 1 us ticks since the sensor was started, widened past its 24-bit wrap.
    Evk4 = "evk4";
    /// The LiDAR's clock: what its packets carry, read as nanoseconds since 1970 on that clock
    /// (PTP/TAI, UTC or free-running, as configured).
    Lidar = "lidar";
    /// `CLOCK_MONOTONIC` of the host: what V4L2 drivers stamp frames with.
    Monotonic = "monotonic";
    /// `CLOCK_REALTIME` of the host: what the kernel stamps received datagrams and CAN frames with.
    Realtime = "realtime";
    /// The network card's PTP hardware clock.
    Phc = "phc";
    /// International atomic time on the host: the one timeline everything is mapped onto.
    Tai = "tai";
}

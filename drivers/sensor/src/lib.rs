//! The contract between sensors and host: clocks, stamps, clock maps, and what sensors deliver.
//!
//! Nothing here allocates, reads a clock, opens a device or knows a wire format: instants and
//! samples are plain values that name their clock and their units.
#![no_std]
#![forbid(unsafe_code)]

mod clock;
mod map;
mod sample;
mod sensor;
mod stamp;

pub use clock::{Clock, Evk4, Lidar, Monotonic, Phc, Realtime, Tai};
pub use map::{ClockMap, Uncertain};
pub use sample::{Event, Motion, Return, TriggerEdge};
pub use sensor::{Poll, Sensor, Sink};
pub use stamp::Stamp;

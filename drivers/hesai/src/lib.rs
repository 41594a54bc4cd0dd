//! Hesai LiDAR packets to returns and sweeps, and back.
//!
//! PandarQT64 (both directions), QT128, XT32, XT16, XT32M, Pandar64 and Pandar40P share one
//! decoder. It checks a packet once, stamps every return in whole nanoseconds on the sensor's own
//! clock, cuts sweeps per channel and counts what is lost, late, doubled or damaged. It reads no
//! clock, opens nothing and allocates nothing per packet.
//!
//! ```
//! use noctule_hesai::{Decoder, Model, Options, Qt64Echoes, Qt64Encoder, ReturnMode};
//! use noctule_sensor::{Return, Stamp};
//!
//! let mut wall = Qt64Echoes::NONE;
//! wall.set(32, 5.0, 80);
//! let mut sensor = Qt64Encoder::new(ReturnMode::FirstLast, 600, 0)?;
//! let t = Stamp::from_nanos(1_700_000_000_000_000_000);
//! let packet = sensor.dual(t, &[(9_000, [wall; 2]), (9_060, [wall; 2])])?;
//!
//! let mut decoder = Decoder::new(Options::new(Model::Qt64))?;
//! let mut xs = Vec::new();
//! decoder.decode(&packet, &mut |r: Return, _sweep: u32| xs.push(r.x_m))?;
//! assert_eq!(xs.len(), 2);
//! assert!(xs.iter().all(|x| (x - 5.0).abs() < 0.1));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
#![forbid(unsafe_code)]

pub mod pcap;
mod survey;
mod wire;

pub use survey::{Summary, Survey};
pub use wire::{
    Arrival, Block, Correction, Counts, Decoder, Echo, EncodeError, FireTimes, LaserAngles, Model,
    Options, OptionsError, Packet, PacketError, PacketInfo, QT64_PACKET_LEN, Qt64Echoes,
    Qt64Encoder, Rejected, ReturnMode, ReturnSink, Returns, TableError,
};

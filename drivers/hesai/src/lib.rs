//! Hesai LiDAR packets to returns and sweeps, and back.
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

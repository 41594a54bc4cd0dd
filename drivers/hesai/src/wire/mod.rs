//! The wire format, pure: bytes in, returns out, and back.

mod correction;
mod counts;
mod date;
mod decoder;
mod encode;
mod fire_times;
mod firing;
mod geometry;
mod mode;
mod model;
mod nominal;
mod packet;
mod stream;
mod sweep;
mod table;

pub use correction::{Correction, LaserAngles};
pub use counts::{Counts, Rejected};
pub use decoder::{Decoder, Options, OptionsError, PacketInfo, ReturnSink, Returns};
pub use encode::{EncodeError, QT64_PACKET_LEN, Qt64Echoes, Qt64Encoder};
pub use fire_times::FireTimes;
pub use firing::Block;
pub use mode::{Echo, ReturnMode};
pub use model::Model;
pub use packet::{Packet, PacketError};
pub use stream::Arrival;
pub use table::TableError;

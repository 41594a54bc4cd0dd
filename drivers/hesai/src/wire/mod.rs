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
mod options;
mod packet;
mod packet_error;
mod sink;
mod stream;
mod sweep;
mod table;

pub use correction::{Correction, LaserAngles};
pub use counts::{Counts, Rejected};
pub use decoder::{Decoder, PacketInfo};
pub use encode::{EncodeError, QT64_PACKET_LEN, Qt64Echoes, Qt64Encoder};
pub use fire_times::FireTimes;
pub use mode::{Echo, ReturnMode};
pub use model::Model;
pub use options::{Options, OptionsError, Returns};
pub use packet::Packet;
pub use packet_error::PacketError;
pub use sink::{Block, ReturnSink};
pub use stream::Arrival;
pub use table::TableError;

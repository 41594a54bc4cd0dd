//! What can be wrong with a datagram.

use thiserror::Error;

/// Why a datagram is no point packet of the model expected.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum PacketError {
    /// Fewer bytes than the fields need.
    #[error("packet is {actual} bytes, needs {needed}")]
    Short {
        /// Bytes needed.
        needed: usize,
        /// Bytes there.
        actual: usize,
    },
    /// The first two bytes are not those of a packet.
    #[error("packet starts with {:02x} {:02x}, not ee ff", .0[0], .0[1])]
    Magic([u8; 2]),
    /// Another protocol version.
    #[error("protocol version is {}.{}, which is not this model's", .0[0], .0[1])]
    Version([u8; 2]),
    /// Other counts of lasers or blocks than the model has.
    #[error("packet has {lasers} lasers and {blocks} blocks, which is not this model's geometry")]
    Geometry {
        /// Lasers per block.
        lasers: u8,
        /// Blocks per packet.
        blocks: u8,
    },
    /// The distance unit is zero.
    #[error("distance unit is 0 mm")]
    Unit,
    /// A return mode no manual lists, or one this model's blocks cannot hold.
    #[error("return mode {0:#04x} is unknown or does not fit the model")]
    ReturnMode(u8),
    /// A block's azimuth is not on the circle.
    #[error(
        "block {block} has azimuth {azimuth_cdeg}, needs less than 36000 hundredths of a degree"
    )]
    Azimuth {
        /// Index of the block.
        block: u8,
        /// What it says, hundredths of a degree.
        azimuth_cdeg: u16,
    },
    /// A Pandar40P block does not start with its marker.
    #[error("block {block} starts with {:02x} {:02x}, not ff ee", found[0], found[1])]
    BlockMarker {
        /// Index of the block.
        block: u8,
        /// What it starts with.
        found: [u8; 2],
    },
    /// More microseconds than a second has.
    #[error("{0} us inside the second, needs at most 1000000")]
    Micros(u32),
    /// Year, month, day, hour, minute, second that are no date.
    #[error("year {} month {} day {} {}:{}:{} is no date", .0[0], .0[1], .0[2], .0[3], .0[4], .0[5])]
    Date([u8; 6]),
}

impl PacketError {
    /// Keys of the kinds, as reports write them, in the order of [`kind`](Self::kind).
    pub const KINDS: [&'static str; 10] = [
        "short",
        "magic",
        "version",
        "geometry",
        "unit",
        "return_mode",
        "azimuth",
        "block_marker",
        "micros",
        "date",
    ];

    /// Index of this error's key in [`KINDS`](Self::KINDS).
    #[must_use]
    pub const fn kind(&self) -> usize {
        match self {
            Self::Short { .. } => 0,
            Self::Magic(_) => 1,
            Self::Version(_) => 2,
            Self::Geometry { .. } => 3,
            Self::Unit => 4,
            Self::ReturnMode(_) => 5,
            Self::Azimuth { .. } => 6,
            Self::BlockMarker { .. } => 7,
            Self::Micros(_) => 8,
            Self::Date(_) => 9,
        }
    }

    /// This error's key in reports.
    #[must_use]
    pub const fn key(&self) -> &'static str {
        Self::KINDS[self.kind()]
    }
}

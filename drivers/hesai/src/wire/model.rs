//! One small table per model: where its packets keep what, and when its lasers fire.

use super::packet_error::PacketError;

/// The sensors this driver reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Model {
    /// PandarQT64, protocol 3.1.
    Qt64,
    /// PandarQT128, protocol 3.2.
    Qt128,
    /// PandarXT-32, protocol 6.1.
    Xt32,
    /// PandarXT-16, protocol 6.1.
    Xt16,
    /// PandarXT-32M, protocol 6.1.
    Xt32m,
    /// Pandar64.
    Pandar64,
    /// Pandar40P.
    Pandar40p,
}

impl Model {
    /// Every model, in the order of the enum.
    pub const ALL: [Self; 7] = [
        Self::Qt64,
        Self::Qt128,
        Self::Xt32,
        Self::Xt16,
        Self::Xt32m,
        Self::Pandar64,
        Self::Pandar40p,
    ];

    /// The model that sends packets beginning like `payload`; `None` when none does.
    ///
    /// Looks at the start only: the packet may still be cut short or damaged further on.
    #[must_use]
    pub fn detect(payload: &[u8]) -> Option<Self> {
        Self::identify(payload).ok()
    }

    /// As [`detect`](Self::detect), saying what stood in the way.
    ///
    /// # Errors
    /// `Short`, `Magic`, `Version` or `Geometry`, with the bytes found.
    pub fn identify(payload: &[u8]) -> Result<Self, PacketError> {
        if payload.len() < 12 {
            return Err(PacketError::Short {
                needed: 12,
                actual: payload.len(),
            });
        }
        match [payload[0], payload[1]] {
            [0xee, 0xff] => {}
            [0xff, 0xee] => return identify_pandar40p(payload),
            magic => return Err(PacketError::Magic(magic)),
        }
        let version = [payload[2], payload[3]];
        let (lasers, blocks) = (payload[6], payload[7]);
        match (version, lasers, blocks) {
            ([64, 6], _, _) => Ok(Self::Pandar64),
            ([3, 1], 64, 4) => Ok(Self::Qt64),
            ([3, 2], 128, 2) => Ok(Self::Qt128),
            ([6, 1], 32, 8) => Ok(Self::Xt32),
            ([6, 1], 16, 8) => Ok(Self::Xt16),
            ([6, 1], 32, 6) => Ok(Self::Xt32m),
            ([3, 1 | 2] | [6, 1], _, _) => Err(PacketError::Geometry { lasers, blocks }),
            _ => Err(PacketError::Version(version)),
        }
    }

    /// Short lower-case name, as written in reports and configuration files.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Qt64 => "qt64",
            Self::Qt128 => "qt128",
            Self::Xt32 => "xt32",
            Self::Xt16 => "xt16",
            Self::Xt32m => "xt32m",
            Self::Pandar64 => "pandar64",
            Self::Pandar40p => "pandar40p",
        }
    }

    /// The model of that [`name`](Self::name).
    #[must_use]
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|model| model.name() == name)
    }

    /// Lasers, which is also the number of rows of its correction table.
    #[must_use]
    pub const fn channels(self) -> usize {
        self.spec().channels
    }

    /// Firings or returns of firings in one packet.
    #[must_use]
    pub const fn blocks(self) -> usize {
        self.spec().blocks
    }

    /// Time between two firings of one laser, nanoseconds.
    #[must_use]
    pub const fn firing_interval_ns(self) -> u32 {
        self.spec().firing_ns
    }

    pub(crate) const fn spec(self) -> &'static Spec {
        match self {
            Self::Qt64 => &QT64,
            Self::Qt128 => &QT128,
            Self::Xt32 => &XT32,
            Self::Xt16 => &XT16,
            Self::Xt32m => &XT32M,
            Self::Pandar64 => &PANDAR64,
            Self::Pandar40p => &PANDAR40P,
        }
    }
}

/// Pandar40P has no header: its packet starts with the first block's marker, as every block does.
fn identify_pandar40p(payload: &[u8]) -> Result<Model, PacketError> {
    let second = PANDAR40P.block_header + PANDAR40P.channels * 3;
    match payload.get(second..second + 2) {
        Some([0xff, 0xee]) => Ok(Model::Pandar40p),
        Some(marker) => Err(PacketError::BlockMarker {
            block: 1,
            found: [marker[0], marker[1]],
        }),
        None => Err(PacketError::Short {
            needed: second + 2,
            actual: payload.len(),
        }),
    }
}

/// How the start of a packet is laid out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Header {
    /// EE FF, version, 12 bytes: counts at 6 and 7, distance unit at 9, flags at 11.
    Versioned { version: [u8; 2] },
    /// EE FF, counts at 2 and 3, distance unit at 5; 8 bytes.
    Counts,
    /// None; every block starts with FF EE and distances are in units of 4 mm.
    Blocks,
}

/// Offsets from the start of the tail.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Tail {
    pub mode: usize,
    pub rpm: usize,
    pub date: usize,
    pub micros: usize,
    pub sequence: usize,
    /// Bytes a tail has at least.
    pub len: usize,
}

/// When block `b` fires, relative to the packet's time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum BlockTime {
    /// The packet's time is its start: `offset + step * floor(b / returns)`.
    FromStart { offset_ns: i32, step_ns: i32 },
    /// The packet's time is its end: `offset - step * floor((last - b) / returns)`.
    FromEnd { offset_ns: i32, step_ns: i32 },
}

/// What tells one model's packets from another's.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Spec {
    pub model: Model,
    pub header: Header,
    pub header_len: usize,
    pub blocks: usize,
    pub channels: usize,
    /// Bytes before a block's first channel, azimuth included (its last two).
    pub block_header: usize,
    /// Bytes per channel; one fewer where a flag says that there is no confidence byte.
    pub stride: usize,
    /// Whether that flag (bit 4) exists and functional safety (bit 2) comes before the tail.
    pub flagged: bool,
    pub tail: Tail,
    pub firing_ns: u32,
    pub block_time: BlockTime,
    /// Whether times without a fire-time file are the packet's own, with no block or channel term.
    pub packet_time_only: bool,
}

/// Constant the vendor's general SDK adds to a QT64's channel times; SDK 2.0 leaves it out.
const QT64_TRANSMIT_NS: i32 = 10_000;

const XT_TAIL: Tail = Tail {
    mode: 10,
    rpm: 11,
    date: 13,
    micros: 19,
    sequence: 24,
    len: 24,
};
const PANDAR_TAIL: Tail = Tail {
    mode: 14,
    rpm: 8,
    date: 16,
    micros: 10,
    sequence: 22,
    len: 22,
};

static QT64: Spec = Spec {
    model: Model::Qt64,
    header: Header::Versioned { version: [3, 1] },
    header_len: 12,
    blocks: 4,
    channels: 64,
    block_header: 2,
    stride: 4,
    flagged: false,
    tail: Tail {
        mode: 16,
        rpm: 10,
        date: 18,
        micros: 12,
        sequence: 24,
        len: 24,
    },
    firing_ns: 166_666,
    block_time: BlockTime::FromStart {
        offset_ns: 25_710 + QT64_TRANSMIT_NS,
        step_ns: 166_666,
    },
    packet_time_only: false,
};

static QT128: Spec = Spec {
    model: Model::Qt128,
    header: Header::Versioned { version: [3, 2] },
    header_len: 12,
    blocks: 2,
    channels: 128,
    block_header: 2,
    stride: 4,
    flagged: true,
    tail: Tail {
        mode: 12,
        rpm: 13,
        date: 15,
        micros: 21,
        sequence: 26,
        len: 26,
    },
    firing_ns: 111_110,
    block_time: BlockTime::FromStart {
        offset_ns: 9_000,
        step_ns: 111_110,
    },
    packet_time_only: true,
};

static XT32: Spec = Spec {
    model: Model::Xt32,
    header: Header::Versioned { version: [6, 1] },
    header_len: 12,
    blocks: 8,
    channels: 32,
    block_header: 2,
    stride: 4,
    flagged: false,
    tail: XT_TAIL,
    firing_ns: 50_000,
    block_time: BlockTime::FromEnd {
        offset_ns: 5_632,
        step_ns: 50_000,
    },
    packet_time_only: false,
};

static XT16: Spec = Spec {
    model: Model::Xt16,
    channels: 16,
    ..XT32
};

static XT32M: Spec = Spec {
    model: Model::Xt32m,
    blocks: 6,
    ..XT32
};

static PANDAR64: Spec = Spec {
    model: Model::Pandar64,
    header: Header::Counts,
    header_len: 8,
    blocks: 6,
    channels: 64,
    block_header: 2,
    stride: 3,
    flagged: false,
    tail: PANDAR_TAIL,
    firing_ns: 55_560,
    block_time: BlockTime::FromEnd {
        offset_ns: -42_580,
        step_ns: 55_560,
    },
    packet_time_only: true,
};

static PANDAR40P: Spec = Spec {
    model: Model::Pandar40p,
    header: Header::Blocks,
    header_len: 0,
    blocks: 10,
    channels: 40,
    block_header: 4,
    stride: 3,
    flagged: false,
    tail: PANDAR_TAIL,
    firing_ns: 55_560,
    block_time: BlockTime::FromEnd {
        offset_ns: -28_580,
        step_ns: 55_560,
    },
    packet_time_only: false,
};

impl BlockTime {
    /// Nanoseconds from the packet's time to the start of block `block` of `blocks`.
    pub fn nanos(self, block: usize, blocks: usize, returns: usize) -> i64 {
        // Counts of blocks are at most ten: the conversions cannot fail.
        let steps = |n: usize| i64::try_from(n / returns).unwrap_or(0);
        match self {
            Self::FromStart { offset_ns, step_ns } => {
                i64::from(offset_ns) + i64::from(step_ns) * steps(block)
            }
            Self::FromEnd { offset_ns, step_ns } => {
                i64::from(offset_ns) - i64::from(step_ns) * steps(blocks - 1 - block)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_lead_back_to_their_models() {
        for model in Model::ALL {
            assert_eq!(Model::from_name(model.name()), Some(model));
            assert_eq!(model.spec().model, model);
        }
        assert_eq!(Model::from_name("vlp16"), None);
    }

    #[test]
    fn a_start_that_belongs_to_no_model_says_why() {
        let start = |bytes: [u8; 12]| Model::identify(&bytes);
        assert_eq!(
            Model::identify(&[]),
            Err(PacketError::Short {
                needed: 12,
                actual: 0
            })
        );
        assert_eq!(start([0; 12]), Err(PacketError::Magic([0, 0])));
        let qt = [0xee, 0xff, 3, 1, 0, 0, 64, 5, 0, 4, 2, 1];
        assert_eq!(
            start(qt),
            Err(PacketError::Geometry {
                lasers: 64,
                blocks: 5
            })
        );
        let future = [0xee, 0xff, 9, 1, 0, 0, 64, 4, 0, 4, 2, 1];
        assert_eq!(start(future), Err(PacketError::Version([9, 1])));
        let gps = [0xff, 0xee, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];
        assert_eq!(
            start(gps),
            Err(PacketError::Short {
                needed: 126,
                actual: 12
            })
        );
    }

    #[test]
    fn blocks_count_up_from_the_start_or_down_to_the_end() {
        let qt = Model::Qt64.spec().block_time;
        assert_eq!(
            (0..4).map(|b| qt.nanos(b, 4, 2)).collect::<Vec<_>>(),
            [35_710, 35_710, 202_376, 202_376]
        );
        let xt = Model::Xt32.spec().block_time;
        assert_eq!(
            (xt.nanos(0, 8, 1), xt.nanos(7, 8, 1)),
            (5_632 - 350_000, 5_632)
        );
        assert_eq!(
            (xt.nanos(0, 8, 2), xt.nanos(6, 8, 2)),
            (5_632 - 150_000, 5_632)
        );
    }
}

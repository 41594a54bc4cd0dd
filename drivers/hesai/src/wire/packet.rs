//! A point packet as a view over its bytes: checked once, then read without a branch.

use super::model::{Header, Spec};
use super::{Model, PacketError, ReturnMode, date};

/// Byte offsets of the 12-byte header that all models but the Pandars share.
mod field {
    pub const VERSION: usize = 2;
    pub const LASERS: usize = 6;
    pub const BLOCKS: usize = 7;
    pub const UNIT_MM: usize = 9;
    pub const FLAGS: usize = 11;
    pub const HAS_SEQUENCE: u8 = 1 << 0;
    pub const HAS_SAFETY: u8 = 1 << 2;
    pub const HAS_CONFIDENCE: u8 = 1 << 4;
    pub const PANDAR_LASERS: usize = 2;
    pub const PANDAR_BLOCKS: usize = 3;
    pub const PANDAR_UNIT_MM: usize = 5;
}

/// Body checksum and functional-safety block of flagged packets (QT128), before the tail.
const BODY_CRC_LEN: usize = 4;
const SAFETY_LEN: usize = 17;
const SEQUENCE_LEN: usize = 4;

/// A point packet whose length, counts, unit, mode, azimuths and date have been checked.
///
/// INVARIANT: `bytes` reaches past the last field any accessor reads.
#[derive(Debug, Clone, Copy)]
pub struct Packet<'a> {
    bytes: &'a [u8],
    spec: &'static Spec,
    stride: usize,
    tail: usize,
    unit_mm: u8,
    has_sequence: bool,
    mode: ReturnMode,
    seconds: u64,
}

impl<'a> Packet<'a> {
    /// Checks everything that can be wrong with `bytes` as a packet of `model`.
    ///
    /// Bytes after the last known field are allowed: newer firmware appends.
    ///
    /// # Errors
    /// The first thing found wrong, with the values found.
    pub fn new(model: Model, bytes: &'a [u8]) -> Result<Self, PacketError> {
        let spec = model.spec();
        let mut packet = Self {
            bytes,
            spec,
            stride: spec.stride,
            tail: 0,
            unit_mm: 4,
            has_sequence: false,
            mode: ReturnMode::Last,
            seconds: 0,
        };
        packet.check_header()?;
        packet.check_blocks()?;
        packet.check_tail()?;
        Ok(packet)
    }

    fn check_header(&mut self) -> Result<(), PacketError> {
        let (bytes, spec) = (self.bytes, self.spec);
        let body = spec.blocks * (spec.block_header + spec.channels * spec.stride);
        self.tail = spec.header_len + body;
        self.needs(spec.header_len.max(4))?;
        match spec.header {
            Header::Versioned { version } => {
                let found = [bytes[field::VERSION], bytes[field::VERSION + 1]];
                check_magic(bytes)?;
                if found != version {
                    return Err(PacketError::Version(found));
                }
                self.check_geometry(bytes[field::LASERS], bytes[field::BLOCKS])?;
                self.unit_mm = bytes[field::UNIT_MM];
                let flags = bytes[field::FLAGS];
                self.has_sequence = flags & field::HAS_SEQUENCE != 0;
                if spec.flagged {
                    self.apply_flags(flags);
                }
            }
            Header::Counts => {
                check_magic(bytes)?;
                self.check_geometry(bytes[field::PANDAR_LASERS], bytes[field::PANDAR_BLOCKS])?;
                self.unit_mm = bytes[field::PANDAR_UNIT_MM];
                self.has_sequence = bytes.len() >= self.sequence_end();
            }
            Header::Blocks => self.has_sequence = bytes.len() >= self.sequence_end(),
        }
        if self.unit_mm == 0 {
            return Err(PacketError::Unit);
        }
        let sequence_end = if self.has_sequence {
            self.sequence_end()
        } else {
            0
        };
        self.needs(sequence_end.max(self.tail + spec.tail.len))
    }

    fn apply_flags(&mut self, flags: u8) {
        if flags & field::HAS_CONFIDENCE == 0 {
            self.stride -= 1;
            self.tail -= self.spec.blocks * self.spec.channels;
        }
        self.tail += BODY_CRC_LEN;
        if flags & field::HAS_SAFETY != 0 {
            self.tail += SAFETY_LEN;
        }
    }

    fn sequence_end(&self) -> usize {
        self.tail + self.spec.tail.sequence + SEQUENCE_LEN
    }

    fn needs(&self, needed: usize) -> Result<(), PacketError> {
        let actual = self.bytes.len();
        if actual < needed {
            Err(PacketError::Short { needed, actual })
        } else {
            Ok(())
        }
    }

    fn check_geometry(&self, lasers: u8, blocks: u8) -> Result<(), PacketError> {
        if usize::from(lasers) == self.spec.channels && usize::from(blocks) == self.spec.blocks {
            Ok(())
        } else {
            Err(PacketError::Geometry { lasers, blocks })
        }
    }

    fn check_blocks(&self) -> Result<(), PacketError> {
        for (index, block) in (0..self.spec.blocks).zip(0u8..) {
            let start = self.block_start(index);
            let found = [self.bytes[start], self.bytes[start + 1]];
            if self.spec.header == Header::Blocks && found != [0xff, 0xee] {
                // A first block without its marker is a packet without its magic.
                return Err(if block == 0 {
                    PacketError::Magic(found)
                } else {
                    PacketError::BlockMarker { block, found }
                });
            }
            let azimuth_cdeg = self.azimuth_cdeg(index);
            if azimuth_cdeg >= 36_000 {
                return Err(PacketError::Azimuth {
                    block,
                    azimuth_cdeg,
                });
            }
        }
        Ok(())
    }

    fn check_tail(&mut self) -> Result<(), PacketError> {
        let byte = self.bytes[self.tail + self.spec.tail.mode];
        self.mode = ReturnMode::from_byte(byte)
            .filter(|mode| self.spec.blocks.is_multiple_of(mode.returns()))
            .filter(|mode| *mode != ReturnMode::Triple || self.spec.model == Model::Xt32m)
            .ok_or(PacketError::ReturnMode(byte))?;
        if self.micros() > 1_000_000 {
            return Err(PacketError::Micros(self.micros()));
        }
        let at = self.tail + self.spec.tail.date;
        let b = &self.bytes[at..at + 6];
        let bytes = [b[0], b[1], b[2], b[3], b[4], b[5]];
        self.seconds = date::seconds(bytes).ok_or(PacketError::Date(bytes))?;
        Ok(())
    }

    #[inline]
    fn block_start(&self, index: usize) -> usize {
        self.spec.header_len + index * (self.spec.block_header + self.spec.channels * self.stride)
    }

    #[inline]
    fn u16_at(&self, at: usize) -> u16 {
        u16::from_le_bytes([self.bytes[at], self.bytes[at + 1]])
    }

    #[inline]
    fn u32_at(&self, at: usize) -> u32 {
        let b = &self.bytes[at..at + 4];
        u32::from_le_bytes([b[0], b[1], b[2], b[3]])
    }

    /// The model it was checked against.
    #[inline]
    #[must_use]
    pub fn model(&self) -> Model {
        self.spec.model
    }

    /// Which echoes the blocks hold.
    #[inline]
    #[must_use]
    pub fn return_mode(&self) -> ReturnMode {
        self.mode
    }

    /// One unit of distance, millimetres, at least 1.
    #[inline]
    #[must_use]
    pub fn unit_mm(&self) -> u8 {
        self.unit_mm
    }

    /// Motor speed, turns per minute.
    #[inline]
    #[must_use]
    pub fn rpm(&self) -> u16 {
        self.u16_at(self.tail + self.spec.tail.rpm)
    }

    /// Microseconds inside the second, `0..=1_000_000`, on the LiDAR's clock.
    #[inline]
    #[must_use]
    pub fn micros(&self) -> u32 {
        self.u32_at(self.tail + self.spec.tail.micros)
    }

    /// The packet's time, nanoseconds since 1970 on the LiDAR's clock.
    #[inline]
    #[must_use]
    pub fn time_ns(&self) -> u64 {
        self.seconds * 1_000_000_000 + u64::from(self.micros()) * 1000
    }

    /// UDP sequence number, where the sensor sends one; wraps at 2^32.
    #[inline]
    #[must_use]
    pub fn sequence(&self) -> Option<u32> {
        self.has_sequence
            .then(|| self.u32_at(self.tail + self.spec.tail.sequence))
    }

    /// Azimuth of block `index`, hundredths of a degree, below 36000.
    ///
    /// # Panics
    /// When the model has no such block.
    #[inline]
    #[must_use]
    pub fn azimuth_cdeg(&self, index: usize) -> u16 {
        assert!(
            index < self.spec.blocks,
            "block {index} of {}",
            self.spec.blocks
        );
        self.u16_at(self.block_start(index) + self.spec.block_header - 2)
    }

    /// Bytes per channel in [`channels`](Self::channels): distance, reflectivity, maybe confidence.
    #[inline]
    #[must_use]
    pub fn stride(&self) -> usize {
        self.stride
    }

    /// The channels of block `index`, [`stride`](Self::stride) bytes each.
    ///
    /// # Panics
    /// When the model has no such block.
    #[inline]
    #[must_use]
    pub fn channels(&self, index: usize) -> &'a [u8] {
        assert!(
            index < self.spec.blocks,
            "block {index} of {}",
            self.spec.blocks
        );
        let start = self.block_start(index) + self.spec.block_header;
        &self.bytes[start..start + self.spec.channels * self.stride]
    }
}

fn check_magic(bytes: &[u8]) -> Result<(), PacketError> {
    match [bytes[0], bytes[1]] {
        [0xee, 0xff] => Ok(()),
        magic => Err(PacketError::Magic(magic)),
    }
}

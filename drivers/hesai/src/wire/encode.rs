//! PandarQT64 packets as the sensor sends them, from distances and intensities.

use noctule_sensor::{Lidar, Stamp};
use thiserror::Error;

use super::{ReturnMode, date};

/// Bytes of an encoded packet, sequence number included.
pub const QT64_PACKET_LEN: usize = 1072;

const CHANNELS: usize = 64;
const BLOCKS: usize = 4;
const BLOCK_LEN: usize = 258;

/// One echo per channel as the wire has it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Qt64Echoes {
    /// Distance in units of 4 mm; 0 is no return.
    pub distance: [u16; CHANNELS],
    /// Reflectivity.
    pub intensity: [u8; CHANNELS],
}

impl Qt64Echoes {
    /// Nothing came back on any channel.
    pub const NONE: Self = Self {
        distance: [0; CHANNELS],
        intensity: [0; CHANNELS],
    };
    /// One unit of distance, metres.
    pub const UNIT_M: f32 = 0.004;

    /// Sets channel `channel`; distances that do not fit 16 bits are no return.
    ///
    /// # Panics
    /// When there is no such channel.
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "float to integer, checked to be in range"
    )]
    pub fn set(&mut self, channel: usize, distance_m: f32, intensity: u8) {
        let units = (distance_m / Self::UNIT_M).round();
        let fits = (1.0..=65_535.0).contains(&units);
        self.distance[channel] = if fits { units as u16 } else { 0 };
        self.intensity[channel] = if fits { intensity } else { 0 };
    }
}

/// What cannot be put in a packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum EncodeError {
    /// An azimuth that is not on the circle.
    #[error("azimuth {0} is not on the circle, needs less than 36000 hundredths of a degree")]
    Azimuth(u16),
    /// The date does not fit the year byte.
    #[error("{0} is after the year 2155")]
    Date(Stamp<Lidar>),
    /// A mode whose number of echoes per firing is not the packet's.
    #[error("return mode {mode:?} has {needed} echoes per firing, packet has {given}")]
    Mode {
        /// The encoder's mode.
        mode: ReturnMode,
        /// Echoes it has.
        needed: usize,
        /// Echoes given.
        given: usize,
    },
}

/// Builds the packets of one PandarQT64, numbering them.
#[derive(Debug, Clone)]
pub struct Qt64Encoder {
    mode: ReturnMode,
    rpm: u16,
    next_sequence: u32,
}

impl Qt64Encoder {
    /// A sensor in `mode` at `rpm` turns per minute, whose first packet is number `sequence`.
    ///
    /// # Errors
    /// When the sensor has no such mode (triple return).
    pub fn new(mode: ReturnMode, rpm: u16, sequence: u32) -> Result<Self, EncodeError> {
        if mode.returns() > 2 {
            return Err(EncodeError::Mode {
                mode,
                needed: mode.returns(),
                given: 2,
            });
        }
        Ok(Self {
            mode,
            rpm,
            next_sequence: sequence,
        })
    }

    /// The number of the next packet.
    #[must_use]
    pub fn next_sequence(&self) -> u32 {
        self.next_sequence
    }

    /// Firings in a packet: 4 in single return, 2 in dual.
    #[must_use]
    pub fn firings(&self) -> usize {
        BLOCKS / self.mode.returns()
    }

    /// A dual-return packet: two firings, each with its azimuth (hundredths of a degree) and its
    /// two echoes in the order of the mode (0x3B: first, last).
    ///
    /// `t` is the packet's time; returns fire from 38 us after it on (see `FireTimes`). Below a
    /// microsecond it is cut off.
    ///
    /// # Errors
    /// What does not fit the packet; it is not counted then.
    pub fn dual(
        &mut self,
        t: Stamp<Lidar>,
        firings: &[(u16, [Qt64Echoes; 2]); 2],
    ) -> Result<[u8; QT64_PACKET_LEN], EncodeError> {
        let [(a, [a0, a1]), (b, [b0, b1])] = firings;
        self.packet(t, 2, [(*a, a0), (*a, a1), (*b, b0), (*b, b1)])
    }

    /// A single-return packet: four firings, each with its azimuth (hundredths of a degree).
    ///
    /// # Errors
    /// As [`dual`](Self::dual).
    pub fn single(
        &mut self,
        t: Stamp<Lidar>,
        firings: &[(u16, Qt64Echoes); 4],
    ) -> Result<[u8; QT64_PACKET_LEN], EncodeError> {
        self.packet(
            t,
            1,
            core::array::from_fn(|b| (firings[b].0, &firings[b].1)),
        )
    }

    fn packet(
        &mut self,
        t: Stamp<Lidar>,
        given: usize,
        blocks: [(u16, &Qt64Echoes); BLOCKS],
    ) -> Result<[u8; QT64_PACKET_LEN], EncodeError> {
        let needed = self.mode.returns();
        if given != needed {
            return Err(EncodeError::Mode {
                mode: self.mode,
                needed,
                given,
            });
        }
        let (date, micros) = date::encode(t).ok_or(EncodeError::Date(t))?;
        let mut bytes = [0; QT64_PACKET_LEN];
        self.put_header(&mut bytes);
        for (index, (azimuth_cdeg, echoes)) in blocks.into_iter().enumerate() {
            if azimuth_cdeg >= 36_000 {
                return Err(EncodeError::Azimuth(azimuth_cdeg));
            }
            let start = 12 + index * BLOCK_LEN;
            put_block(&mut bytes[start..start + BLOCK_LEN], azimuth_cdeg, echoes);
        }
        self.put_tail(&mut bytes, date, micros);
        self.next_sequence = self.next_sequence.wrapping_add(1);
        Ok(bytes)
    }

    /// Version 3.1, 64 lasers, 4 blocks, 4 mm, sequence number present (hesai QT64 manual).
    fn put_header(&self, bytes: &mut [u8; QT64_PACKET_LEN]) {
        let dual = self.mode.returns() == 2;
        // Real packets say 1 in dual return although block 0 holds the first echo.
        let first_block = match self.mode {
            ReturnMode::Last => 1,
            ReturnMode::Strongest => 2,
            _ => u8::from(dual),
        };
        let returns = if dual { 2 } else { 1 };
        bytes[..12].copy_from_slice(&[0xee, 0xff, 3, 1, 0, 0, 64, 4, first_block, 4, returns, 1]);
    }

    fn put_tail(&self, bytes: &mut [u8; QT64_PACKET_LEN], date: [u8; 6], micros: u32) {
        bytes[1054..1056].copy_from_slice(&self.rpm.to_le_bytes());
        bytes[1056..1060].copy_from_slice(&micros.to_le_bytes());
        bytes[1060] = self.mode.byte();
        bytes[1061] = 0x42;
        bytes[1062..1068].copy_from_slice(&date);
        bytes[1068..1072].copy_from_slice(&self.next_sequence.to_le_bytes());
    }
}

fn put_block(bytes: &mut [u8], azimuth_cdeg: u16, echoes: &Qt64Echoes) {
    let (azimuth, units) = bytes.split_at_mut(2);
    azimuth.copy_from_slice(&azimuth_cdeg.to_le_bytes());
    let values = echoes.distance.iter().zip(echoes.intensity);
    for (unit, (distance, intensity)) in units.chunks_exact_mut(4).zip(values) {
        unit[..2].copy_from_slice(&distance.to_le_bytes());
        unit[2] = intensity;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Model, Packet};

    #[test]
    fn distances_round_to_units_and_what_does_not_fit_is_no_return() {
        let mut echoes = Qt64Echoes::NONE;
        for (channel, metres) in [0.0, 0.001, 0.0021, 262.14, 262.2, -1.0, f32::NAN, 10.0]
            .into_iter()
            .enumerate()
        {
            echoes.set(channel, metres, 9);
        }
        assert_eq!(echoes.distance[..8], [0, 0, 1, 65_535, 0, 0, 0, 2_500]);
        assert_eq!(echoes.intensity[..8], [0, 0, 9, 9, 0, 0, 0, 9]);
    }

    #[test]
    fn a_packet_says_what_it_was_given() {
        let mut encoder = Qt64Encoder::new(ReturnMode::FirstLast, 598, u32::MAX).unwrap();
        let none = [Qt64Echoes::NONE; 2];
        let t = Stamp::from_nanos(1_504_708_282_999_999_999);
        let bytes = encoder.dual(t, &[(35_990, none), (50, none)]).unwrap();
        let packet = Packet::new(Model::Qt64, &bytes).unwrap();
        assert_eq!(packet.time_ns(), 1_504_708_282_999_999_000);
        assert_eq!((packet.sequence(), packet.rpm()), (Some(u32::MAX), 598));
        assert_eq!(
            [0, 1, 2, 3].map(|b| packet.azimuth_cdeg(b)),
            [35_990, 35_990, 50, 50]
        );
        assert_eq!(encoder.next_sequence(), 0);
    }

    #[test]
    fn what_does_not_fit_is_refused_and_costs_no_number() {
        let mut encoder = Qt64Encoder::new(ReturnMode::Last, 600, 7).unwrap();
        let none = Qt64Echoes::NONE;
        let t = Stamp::ZERO;
        let dual = encoder.dual(t, &[(0, [none; 2]), (60, [none; 2])]);
        let mode = ReturnMode::Last;
        assert_eq!(
            dual,
            Err(EncodeError::Mode {
                mode,
                needed: 1,
                given: 2
            })
        );
        let off = encoder.single(t, &[(0, none), (60, none), (120, none), (36_000, none)]);
        assert_eq!(off, Err(EncodeError::Azimuth(36_000)));
        let late = Stamp::MAX;
        let firings = [(0, none), (60, none), (120, none), (180, none)];
        assert_eq!(encoder.single(late, &firings), Err(EncodeError::Date(late)));
        assert_eq!(encoder.next_sequence(), 7);
        assert!(Qt64Encoder::new(ReturnMode::Triple, 600, 0).is_err());
    }
}

//! pcapng blocks: sections, interfaces with their clocks, packets.

use std::io::Read;
use std::ops::Range;

use super::input::{Input, RECORD_MAX};
use super::{CaptureError, link};

pub(super) const SECTION_HEADER: u32 = 0x0a0d_0d0a;
const BYTE_ORDER: u32 = 0x1a2b_3c4d;
const INTERFACE: u32 = 1;
const PACKET: u32 = 2;
const SIMPLE_PACKET: u32 = 3;
const ENHANCED_PACKET: u32 = 6;

const OPTION_TSRESOL: u16 = 9;
const OPTION_TSOFFSET: u16 = 14;

/// Interfaces a section may describe.
const INTERFACES_MAX: usize = 1024;

/// One packet's frame in `Input::record`.
#[derive(Debug)]
pub(super) struct Packet {
    pub t_ns: u64,
    pub link: u16,
    pub frame: Range<usize>,
}

#[derive(Debug, Clone, Copy)]
struct Interface {
    link: u16,
    /// Ticks per second.
    ticks: u64,
    /// Seconds added to every stamp.
    offset_s: i64,
}

/// The section being read.
#[derive(Debug, Default)]
pub(super) struct Section {
    interfaces: Vec<Interface>,
}

impl Section {
    /// Reads the rest of the first section header, whose type `input` holds already.
    pub fn open<R: Read>(input: &mut Input<R>) -> Result<Self, CaptureError> {
        let mut section = Self::default();
        section.block(input, 0)?;
        Ok(section)
    }

    /// The next packet; `None` at the end of the file.
    pub fn next<R: Read>(&mut self, input: &mut Input<R>) -> Result<Option<Packet>, CaptureError> {
        loop {
            let start = input.offset;
            if !input.take(4, "a block header")? {
                return Ok(None);
            }
            if let Some(packet) = self.block(input, start)? {
                return Ok(Some(packet));
            }
        }
    }

    /// Reads the block at `start`, whose type is in `record`; gives its packet if it has one.
    fn block<R: Read>(
        &mut self,
        input: &mut Input<R>,
        start: u64,
    ) -> Result<Option<Packet>, CaptureError> {
        // The section header's type reads the same both ways; what follows tells the order.
        let is_section = input.u32(0) == SECTION_HEADER;
        rest(input, start, if is_section { 8 } else { 4 })?;
        if is_section {
            input.big_endian = false;
            let found = input.u32(8);
            input.big_endian = found == BYTE_ORDER.swap_bytes();
            if input.u32(8) != BYTE_ORDER {
                return Err(CaptureError::Magic {
                    offset: start + 8,
                    found,
                });
            }
            self.interfaces.clear();
        }
        let kind = input.u32(0);
        let len = input.u32(4) as usize;
        let min = match kind {
            SECTION_HEADER | ENHANCED_PACKET | PACKET => 28 + 4 * usize::from(!is_section),
            INTERFACE => 20,
            SIMPLE_PACKET => 16,
            _ => 12,
        };
        if !(min..=RECORD_MAX).contains(&len) || !len.is_multiple_of(4) {
            return Err(length(start, "a block", len, min, RECORD_MAX));
        }
        rest(input, start, len - input.record.len())?;
        // The body, without the length repeated after it.
        let end = len - 4;
        match kind {
            INTERFACE => self.interface(input, start, end).map(|()| None),
            ENHANCED_PACKET => self.packet(input, start, input.u32(8), end).map(Some),
            PACKET => self
                .packet(input, start, u32::from(input.u16(8)), end)
                .map(Some),
            SIMPLE_PACKET => self.simple(input, start, end).map(Some),
            _ => Ok(None),
        }
    }

    fn interface<R: Read>(
        &mut self,
        input: &Input<R>,
        start: u64,
        end: usize,
    ) -> Result<(), CaptureError> {
        let link = input.u16(8);
        let mut interface = Interface {
            link,
            ticks: 1_000_000,
            offset_s: 0,
        };
        let mut at = 16;
        while at + 4 <= end {
            let (code, len) = (input.u16(at), usize::from(input.u16(at + 2)));
            if at + 4 + len > end {
                return Err(length(start, "an option", len, 0, end - at - 4));
            }
            match (code, len) {
                (0, _) => break,
                (OPTION_TSRESOL, 1..) => interface.ticks = ticks(input.record[at + 4]),
                (OPTION_TSOFFSET, 8..) => interface.offset_s = i64_at(input, at + 4),
                _ => {}
            }
            at += 4 + len.next_multiple_of(4);
        }
        if self.interfaces.len() >= INTERFACES_MAX {
            return Err(length(
                start,
                "an interface list",
                INTERFACES_MAX + 1,
                0,
                INTERFACES_MAX,
            ));
        }
        self.interfaces.push(interface);
        Ok(())
    }

    /// Enhanced and (obsolete) plain packet blocks: stamp at 12, lengths at 20, frame from 28 on.
    fn packet<R: Read>(
        &self,
        input: &Input<R>,
        start: u64,
        interface: u32,
        end: usize,
    ) -> Result<Packet, CaptureError> {
        let Interface {
            link,
            ticks,
            offset_s,
        } = self.interface_of(start, interface)?;
        let count = u128::from(input.u32(12)) << 32 | u128::from(input.u32(16));
        let nanos = i128::from(offset_s) * 1_000_000_000
            + i128::try_from(count * 1_000_000_000 / u128::from(ticks)).unwrap_or(i128::MAX);
        let t_ns = u64::try_from(nanos.max(0)).unwrap_or(u64::MAX);
        let len = input.u32(20) as usize;
        frame(start, len, 28, end).map(|frame| Packet { t_ns, link, frame })
    }

    /// No stamp: time zero.
    fn simple<R: Read>(
        &self,
        input: &Input<R>,
        start: u64,
        end: usize,
    ) -> Result<Packet, CaptureError> {
        let link = self.interface_of(start, 0)?.link;
        // The frame's length before it was cut to the capture's.
        let len = (input.u32(8) as usize).min(end - 12);
        frame(start, len, 12, end).map(|frame| Packet {
            t_ns: 0,
            link,
            frame,
        })
    }

    fn interface_of(&self, offset: u64, interface: u32) -> Result<Interface, CaptureError> {
        let known = self.interfaces.len();
        let found = self.interfaces.get(interface as usize).copied();
        let found = found.ok_or(CaptureError::Interface {
            offset,
            interface,
            known,
        })?;
        if link::is_known(found.link) {
            Ok(found)
        } else {
            Err(CaptureError::LinkType {
                offset,
                link: found.link,
            })
        }
    }
}

/// Appends `len` bytes of the block at `start`.
fn rest<R: Read>(input: &mut Input<R>, start: u64, len: usize) -> Result<(), CaptureError> {
    let before = input.record.len();
    let cut = |actual| CaptureError::Truncated {
        offset: start,
        what: "a block",
        needed: before + len,
        actual,
    };
    match input.take_more(len, "a block") {
        Ok(true) => Ok(()),
        Ok(false) if len == 0 => Ok(()),
        Ok(false) => Err(cut(before)),
        Err(CaptureError::Truncated { actual, .. }) => Err(cut(before + actual)),
        Err(error) => Err(error),
    }
}

fn frame(start: u64, len: usize, at: usize, end: usize) -> Result<Range<usize>, CaptureError> {
    if len > end - at {
        return Err(length(start, "a frame", len, 0, end - at));
    }
    Ok(at..at + len)
}

/// Ticks per second: a power of ten, or of two where the top bit is set; 64 bits' worth at most.
fn ticks(resolution: u8) -> u64 {
    let exponent = u32::from(resolution & 0x7f);
    let power = if resolution & 0x80 == 0 { 10u64 } else { 2 }.checked_pow(exponent);
    power.unwrap_or(u64::MAX)
}

fn i64_at<R: Read>(input: &Input<R>, at: usize) -> i64 {
    let (a, b) = (u64::from(input.u32(at)), u64::from(input.u32(at + 4)));
    let bits = if input.big_endian {
        a << 32 | b
    } else {
        b << 32 | a
    };
    bits.cast_signed()
}

fn length(offset: u64, what: &'static str, len: usize, min: usize, max: usize) -> CaptureError {
    let wide = |n| u64::try_from(n).unwrap_or(u64::MAX);
    CaptureError::Length {
        offset,
        what,
        len: wide(len),
        min: wide(min),
        max: wide(max),
    }
}

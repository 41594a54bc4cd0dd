//! The text that `candump -L` writes and `canplayer` reads: one frame per line.
//!
//! `(1700000000.123456) can0 123#DEADBEEF`, with `##` and a flag digit for FD frames, `#R` and a
//! length digit for remote requests, and the error flag 0x20000000 in an eight-digit identifier
//! for error reports. An arrival that is not a whole microsecond is written with nine decimals.

use std::fmt;

use noctule_sensor::{Realtime, Stamp};

use crate::{Frame, FrameError, FrameKind, Id};

/// SocketCAN's mark of an error report in the identifier word.
const ERROR_FLAG: u32 = 0x2000_0000;
/// Most bytes in a network interface's name (Linux `IFNAMSIZ` less its terminating zero).
const NAME_LEN_MAX: usize = 15;

/// The name of a network interface, held inline.
///
/// INVARIANT: the first `len` bytes are printable ASCII without spaces; the rest are zero.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct Interface {
    len: u8,
    name: [u8; NAME_LEN_MAX],
}

impl Interface {
    /// Checks a name.
    ///
    /// # Errors
    /// When it is empty, longer than 15 bytes, or not printable ASCII without spaces.
    pub fn new(name: &str) -> Result<Self, LineError> {
        let error = || LineError::Interface(name.chars().take(40).collect());
        if name.is_empty() || !name.bytes().all(|b| b.is_ascii_graphic()) {
            return Err(error());
        }
        let mut bytes = [0; NAME_LEN_MAX];
        bytes
            .get_mut(..name.len())
            .ok_or_else(error)?
            .copy_from_slice(name.as_bytes());
        Ok(Self {
            len: u8::try_from(name.len()).map_err(|_| error())?,
            name: bytes,
        })
    }

    /// The name.
    #[must_use]
    pub fn as_str(&self) -> &str {
        std::str::from_utf8(&self.name[..usize::from(self.len)]).unwrap_or_default()
    }
}

impl fmt::Debug for Interface {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(self.as_str(), f)
    }
}

/// Which way a frame went, where the log says so (`candump -x`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Direction {
    /// Received from the bus.
    Received,
    /// Sent by this host.
    Sent,
}

/// One line of the log; [`Display`](fmt::Display) writes it without the line end.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Record {
    /// When the kernel had received the frame.
    pub arrival: Stamp<Realtime>,
    /// On which interface.
    pub interface: Interface,
    /// The frame.
    pub frame: Frame,
    /// Which way it went, if known.
    pub direction: Option<Direction>,
}

impl Record {
    /// Reads one line; a line end is allowed.
    ///
    /// # Errors
    /// Names the part of the line that is wrong, with what stands there.
    pub fn parse(line: &str) -> Result<Self, LineError> {
        let mut parts = line.split_ascii_whitespace();
        let mut part = |name| parts.next().ok_or(LineError::Missing(name));
        let arrival = parse_arrival(part("arrival")?)?;
        let interface = Interface::new(part("interface")?)?;
        let frame = parse_frame(part("frame")?)?;
        let direction = match parts.next() {
            None => None,
            Some("R") => Some(Direction::Received),
            Some("T") => Some(Direction::Sent),
            Some(other) => return Err(LineError::Trailing(excerpt(other))),
        };
        if let Some(other) = parts.next() {
            return Err(LineError::Trailing(excerpt(other)));
        }
        Ok(Self {
            arrival,
            interface,
            frame,
            direction,
        })
    }
}

impl fmt::Display for Record {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let nanos = self.arrival.as_nanos();
        let (seconds, rest) = (nanos / 1_000_000_000, nanos % 1_000_000_000);
        if rest.is_multiple_of(1000) {
            write!(f, "({seconds:010}.{:06}) ", rest / 1000)?;
        } else {
            write!(f, "({seconds:010}.{rest:09}) ")?;
        }
        write!(f, "{} ", self.interface.as_str())?;
        write_frame(&self.frame, f)?;
        match self.direction {
            None => Ok(()),
            Some(Direction::Received) => f.write_str(" R"),
            Some(Direction::Sent) => f.write_str(" T"),
        }
    }
}

fn write_frame(frame: &Frame, f: &mut fmt::Formatter<'_>) -> fmt::Result {
    match frame.kind() {
        FrameKind::Data => write!(f, "{}#", frame.id())?,
        FrameKind::Fd { flags } => write!(f, "{}##{flags:X}", frame.id())?,
        FrameKind::Error => write!(f, "{:08X}#", frame.id().value() | ERROR_FLAG)?,
        FrameKind::Remote if frame.is_empty() => return write!(f, "{}#R", frame.id()),
        FrameKind::Remote => return write!(f, "{}#R{}", frame.id(), frame.len()),
    }
    frame
        .payload()
        .iter()
        .try_for_each(|byte| write!(f, "{byte:02X}"))
}

/// `(seconds.decimals)`, one to nine decimals.
fn parse_arrival(text: &str) -> Result<Stamp<Realtime>, LineError> {
    let parse = || {
        let inner = text.strip_prefix('(')?.strip_suffix(')')?;
        let (seconds, decimals) = inner.split_once('.')?;
        let digits = |s: &str| s.bytes().all(|b| b.is_ascii_digit());
        if !digits(seconds) || !digits(decimals) {
            return None;
        }
        let missing = 9u32.checked_sub(u32::try_from(decimals.len()).ok()?)?;
        let nanos = decimals.parse::<u64>().ok()? * 10u64.pow(missing);
        seconds
            .parse::<u64>()
            .ok()?
            .checked_mul(1_000_000_000)?
            .checked_add(nanos)
    };
    parse()
        .map(Stamp::from_nanos)
        .ok_or_else(|| LineError::Arrival(excerpt(text)))
}

fn parse_frame(text: &str) -> Result<Frame, LineError> {
    let (id_text, rest) = text
        .split_once('#')
        .ok_or_else(|| LineError::Frame(excerpt(text)))?;
    let word = parse_hex(id_text).ok_or_else(|| LineError::Id(excerpt(id_text)))?;
    let id = match id_text.len() {
        3 => Id::standard(word)?,
        8 if word & ERROR_FLAG != 0 => {
            let mut bytes = [0; 64];
            return Ok(Frame::error(
                word ^ ERROR_FLAG,
                parse_data(rest, &mut bytes)?,
            )?);
        }
        8 => Id::extended(word)?,
        _ => return Err(LineError::Id(excerpt(id_text))),
    };
    let mut bytes = [0; 64];
    if let Some(fd) = rest.strip_prefix('#') {
        let digit = fd.chars().next().and_then(|c| c.to_digit(16));
        let flags = digit.and_then(|d| u8::try_from(d).ok());
        let flags = flags.ok_or_else(|| LineError::Flags(excerpt(fd)))?;
        return Ok(Frame::fd(id, flags, parse_data(&fd[1..], &mut bytes)?)?);
    }
    if let Some(remote) = rest.strip_prefix('R') {
        let len = match remote.as_bytes() {
            [] => 0,
            [digit @ b'0'..=b'8'] => digit - b'0',
            _ => return Err(LineError::RemoteLength(excerpt(remote))),
        };
        return Ok(Frame::remote(id, len)?);
    }
    Ok(Frame::data(id, parse_data(rest, &mut bytes)?)?)
}

/// Hexadecimal digits and nothing else, at most eight.
fn parse_hex(text: &str) -> Option<u32> {
    let plain = text.len() <= 8 && text.bytes().all(|b| b.is_ascii_hexdigit());
    plain.then(|| u32::from_str_radix(text, 16).ok()).flatten()
}

fn parse_data<'a>(text: &str, bytes: &'a mut [u8; 64]) -> Result<&'a [u8], LineError> {
    let digits = text.as_bytes();
    if !digits.len().is_multiple_of(2) || digits.len() > 128 {
        return Err(LineError::Data(excerpt(text)));
    }
    for (byte, pair) in bytes.iter_mut().zip(digits.chunks_exact(2)) {
        *byte = std::str::from_utf8(pair)
            .ok()
            .and_then(parse_hex)
            .and_then(|value| u8::try_from(value).ok())
            .ok_or_else(|| LineError::Data(excerpt(text)))?;
    }
    Ok(&bytes[..digits.len() / 2])
}

/// Enough of the text to find it again.
fn excerpt(text: &str) -> String {
    text.chars().take(40).collect()
}

/// What is wrong with a line of the log.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LineError {
    /// The line ends before this part.
    #[error("{0} is missing")]
    Missing(&'static str),
    /// Not `(seconds.decimals)`, or beyond the year 2554.
    #[error("arrival {0:?} is not (seconds.decimals)")]
    Arrival(String),
    /// Not a name of a network interface.
    #[error("interface {0:?} is not 1 to 15 printable characters")]
    Interface(String),
    /// No `#` between identifier and data.
    #[error("frame {0:?} has no '#'")]
    Frame(String),
    /// Not three or eight hexadecimal digits.
    #[error("identifier {0:?} is not three or eight hexadecimal digits")]
    Id(String),
    /// Not a hexadecimal digit where an FD frame's flags stand.
    #[error("fd flags missing at {0:?}")]
    Flags(String),
    /// Not a digit `0..=8` after `#R`.
    #[error("remote length {0:?} is not a digit 0 to 8")]
    RemoteLength(String),
    /// Not an even number of hexadecimal digits, or too many.
    #[error("data {0:?} is not up to 64 bytes of hexadecimal digits")]
    Data(String),
    /// Something follows the frame.
    #[error("{0:?} follows the frame")]
    Trailing(String),
    /// The parts make no frame.
    #[error(transparent)]
    Invalid(#[from] FrameError),
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Lines as can-utils 2023.03 prints them.
    #[test]
    fn every_kind_of_line_reads_and_writes_back_the_same() {
        let id = Id::standard(0x123).unwrap();
        let lines = [
            (
                "(1700000000.123456) can0 123#DEADBEEF",
                Frame::data(id, &[0xDE, 0xAD, 0xBE, 0xEF]),
            ),
            (
                "(1700000000.123456789) vcan12 18FEF100#",
                Frame::data(Id::extended(0x18FE_F100).unwrap(), &[]),
            ),
            (
                "(1700000000.000000) can0 123##5112233445566778899AABBCC",
                Frame::fd(
                    id,
                    5,
                    &[
                        0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0x77, 0x88, 0x99, 0xAA, 0xBB, 0xCC,
                    ],
                ),
            ),
            ("(0000000001.500000) can0 123#R", Frame::remote(id, 0)),
            ("(0000000001.500000) can0 123#R8 T", Frame::remote(id, 8)),
            (
                "(1700000000.123456) can0 20000004#0004000000000000 R",
                Frame::error(4, &[0, 4, 0, 0, 0, 0, 0, 0]),
            ),
        ];
        for (line, frame) in lines {
            let record = Record::parse(line).unwrap();
            assert_eq!(record.frame, frame.unwrap());
            assert_eq!(record.to_string(), line);
        }
        let record = Record::parse("(1700000000.123456) can0 123#DEADBEEF\n").unwrap();
        assert_eq!(record.arrival.as_nanos(), 1_700_000_000_123_456_000);
        assert_eq!(record.interface.as_str(), "can0");
    }

    #[test]
    fn errors_name_the_part_and_what_stands_there() {
        let cases = [
            ("", "arrival is missing"),
            ("(1.5) can0", "frame is missing"),
            ("1.5 can0 123#", "arrival \"1.5\" is not (seconds.decimals)"),
            (
                "(99999999999.0) can0 123#",
                "arrival \"(99999999999.0)\" is not (seconds.decimals)",
            ),
            (
                "(1.+5) can0 123#",
                "arrival \"(1.+5)\" is not (seconds.decimals)",
            ),
            (
                "(1.5) sixteen_letters_ 123#",
                "interface \"sixteen_letters_\" is not 1 to 15 printable characters",
            ),
            ("(1.5) can0 123", "frame \"123\" has no '#'"),
            (
                "(1.5) can0 1234#",
                "identifier \"1234\" is not three or eight hexadecimal digits",
            ),
            (
                "(1.5) can0 +12#",
                "identifier \"+12\" is not three or eight hexadecimal digits",
            ),
            ("(1.5) can0 800#", "identifier 0x800 is above 0x7FF"),
            ("(1.5) can0 123##", "fd flags missing at \"\""),
            (
                "(1.5) can0 123##1112233445566778899",
                "9 bytes is no length of an fd frame (0..=8, 12, 16, 20, 24, 32, 48, 64)",
            ),
            (
                "(1.5) can0 123#R9",
                "remote length \"9\" is not a digit 0 to 8",
            ),
            (
                "(1.5) can0 123#ABC",
                "data \"ABC\" is not up to 64 bytes of hexadecimal digits",
            ),
            (
                "(1.5) can0 123#1122334455667788_9",
                "data \"1122334455667788_9\" is not up to 64 bytes of hexadecimal digits",
            ),
            (
                "(1.5) can0 123#112233445566778899",
                "9 bytes in a frame of at most 8",
            ),
            ("(1.5) can0 123#11 X", "\"X\" follows the frame"),
        ];
        for (line, text) in cases {
            assert_eq!(Record::parse(line).unwrap_err().to_string(), text, "{line}");
        }
    }

    fn any_frame() -> impl Strategy<Value = Frame> {
        let id = (any::<bool>(), any::<u32>()).prop_map(|(extended, value)| {
            let mask = if extended { 0x1FFF_FFFF } else { 0x7FF };
            Id::new(value & mask, extended).unwrap()
        });
        let fd_len = proptest::sample::select(vec![0usize, 1, 8, 12, 16, 20, 24, 32, 48, 64]);
        (id, 0..4u8, any::<[u8; 64]>(), 0..=8u8, fd_len, 0..16u8).prop_map(
            |(id, kind, bytes, len, fd_len, flags)| {
                let data = &bytes[..usize::from(len)];
                match kind {
                    0 => Frame::data(id, data),
                    1 => Frame::fd(id, flags, &bytes[..fd_len]),
                    2 => Frame::remote(id, len),
                    _ => Frame::error(id.value(), data),
                }
                .unwrap()
            },
        )
    }

    proptest! {
        #[test]
        fn what_is_written_is_read(
            frame in any_frame(), nanos: u64, name in "[!-~]{1,15}", direction in 0..3u8,
        ) {
            let record = Record {
                arrival: Stamp::from_nanos(nanos),
                interface: Interface::new(&name).unwrap(),
                frame,
                direction: [None, Some(Direction::Received), Some(Direction::Sent)]
                    [usize::from(direction)],
            };
            prop_assert_eq!(Record::parse(&record.to_string()), Ok(record));
        }

        #[test]
        fn no_text_panics(line in "\\PC{0,80}") {
            let _ = Record::parse(&line);
        }

        #[test]
        fn near_misses_do_not_panic(
            line in "\\([0-9]{0,3}\\.[0-9]{0,12}\\) ?[a-z]{0,4}[0-9]? ?[0-9A-Fé]{0,9}#{0,2}[R0-9A-Fé_]{0,20}( [RTX])?"
        ) {
            if let Ok(record) = Record::parse(&line) {
                prop_assert_eq!(Record::parse(&record.to_string()), Ok(record));
            }
        }
    }
}

//! CAN frames as values: classic and FD data, remote requests, error reports.

use std::fmt;

/// Largest identifier of a base-format frame (11 bits).
const STANDARD_MAX: u32 = 0x7FF;
/// Largest identifier of an extended-format frame (29 bits).
const EXTENDED_MAX: u32 = 0x1FFF_FFFF;
/// Most data bytes of a classic frame.
const CLASSIC_LEN_MAX: usize = 8;
/// Most data bytes of an FD frame.
const FD_LEN_MAX: usize = 64;

/// A message identifier, within its format's range.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Id {
    extended: bool,
    value: u32,
}

impl Id {
    /// A base-format (11 bit) identifier.
    ///
    /// # Errors
    /// When `value` is above 0x7FF.
    pub const fn standard(value: u32) -> Result<Self, FrameError> {
        Self::new(value, false)
    }

    /// An extended-format (29 bit) identifier.
    ///
    /// # Errors
    /// When `value` is above `0x1FFF_FFFF`.
    pub const fn extended(value: u32) -> Result<Self, FrameError> {
        Self::new(value, true)
    }

    /// An identifier of either format.
    ///
    /// # Errors
    /// When `value` does not fit the format.
    pub const fn new(value: u32, extended: bool) -> Result<Self, FrameError> {
        let max = if extended { EXTENDED_MAX } else { STANDARD_MAX };
        if value > max {
            return Err(FrameError::Id { value, max });
        }
        Ok(Self { extended, value })
    }

    /// The number, without flags.
    #[must_use]
    pub const fn value(self) -> u32 {
        self.value
    }

    /// Whether the identifier has 29 bits.
    #[must_use]
    pub const fn is_extended(self) -> bool {
        self.extended
    }
}

impl fmt::Display for Id {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.extended {
            write!(f, "{:08X}", self.value)
        } else {
            write!(f, "{:03X}", self.value)
        }
    }
}

/// What kind of frame it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum FrameKind {
    /// Classic data frame, at most 8 bytes.
    Data,
    /// FD data frame, at most 64 bytes; the low four flag bits as SocketCAN numbers them
    /// (1 bit rate switch, 2 error state indicator, 4 FD format).
    Fd {
        /// Flag bits, `0..16`.
        flags: u8,
    },
    /// Remote request: a length and no data.
    Remote,
    /// Error report of the local controller; the identifier is SocketCAN's error class.
    Error,
}

/// One frame, held inline.
///
/// INVARIANT: `len` is a length its kind can have, and bytes from `len` on (all bytes of a remote
/// request) are zero, so equal frames compare equal.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct Frame {
    id: Id,
    kind: FrameKind,
    len: u8,
    bytes: [u8; FD_LEN_MAX],
}

impl Frame {
    /// A classic data frame.
    ///
    /// # Errors
    /// When `data` is longer than 8 bytes.
    pub fn data(id: Id, data: &[u8]) -> Result<Self, FrameError> {
        Self::classic(id, FrameKind::Data, data)
    }

    /// An FD data frame; `flags` as in [`FrameKind::Fd`].
    ///
    /// # Errors
    /// When no FD frame has `data`'s length (0..=8, 12, 16, 20, 24, 32, 48, 64) or `flags` has more
    /// than four bits.
    pub fn fd(id: Id, flags: u8, data: &[u8]) -> Result<Self, FrameError> {
        if flags > 0xF {
            return Err(FrameError::FdFlags(flags));
        }
        if !is_fd_len(data.len()) {
            return Err(FrameError::FdLength(data.len()));
        }
        Self::with(id, FrameKind::Fd { flags }, data, FD_LEN_MAX)
    }

    /// A remote request for `len` bytes.
    ///
    /// # Errors
    /// When `len` is above 8.
    pub fn remote(id: Id, len: u8) -> Result<Self, FrameError> {
        if usize::from(len) > CLASSIC_LEN_MAX {
            return Err(FrameError::Length {
                actual: usize::from(len),
                max: CLASSIC_LEN_MAX,
            });
        }
        Ok(Self {
            id,
            kind: FrameKind::Remote,
            len,
            bytes: [0; FD_LEN_MAX],
        })
    }

    /// An error report: `class` is SocketCAN's error class (29 bits, without the error flag).
    ///
    /// # Errors
    /// When `class` has more than 29 bits or `data` more than 8 bytes.
    pub fn error(class: u32, data: &[u8]) -> Result<Self, FrameError> {
        Self::classic(Id::extended(class)?, FrameKind::Error, data)
    }

    fn classic(id: Id, kind: FrameKind, data: &[u8]) -> Result<Self, FrameError> {
        Self::with(id, kind, data, CLASSIC_LEN_MAX)
    }

    fn with(id: Id, kind: FrameKind, data: &[u8], max: usize) -> Result<Self, FrameError> {
        let too_long = FrameError::Length {
            actual: data.len(),
            max,
        };
        if data.len() > max {
            return Err(too_long);
        }
        let len = u8::try_from(data.len()).map_err(|_| too_long)?;
        let mut bytes = [0; FD_LEN_MAX];
        bytes[..data.len()].copy_from_slice(data);
        Ok(Self {
            id,
            kind,
            len,
            bytes,
        })
    }

    /// The identifier (of an error report: its class).
    #[must_use]
    pub const fn id(&self) -> Id {
        self.id
    }

    /// The kind.
    #[must_use]
    pub const fn kind(&self) -> FrameKind {
        self.kind
    }

    /// Length in bytes: of the data, or what a remote request asks for.
    #[must_use]
    pub fn len(&self) -> usize {
        usize::from(self.len)
    }

    /// Whether the length is zero.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// The data; empty for a remote request.
    #[must_use]
    pub fn payload(&self) -> &[u8] {
        match self.kind {
            FrameKind::Remote => &[],
            _ => &self.bytes[..usize::from(self.len)],
        }
    }
}

impl fmt::Debug for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?} {} {:02X?}", self.kind, self.id, self.payload())
    }
}

/// Lengths an FD frame can have (ISO 11898-1:2015, data length code).
pub(crate) const fn is_fd_len(len: usize) -> bool {
    matches!(len, 0..=8 | 12 | 16 | 20 | 24 | 32 | 48 | 64)
}

/// Why these values make no frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum FrameError {
    /// The identifier does not fit its format.
    #[error("identifier {value:#X} is above {max:#X}")]
    Id {
        /// What was given.
        value: u32,
        /// Largest identifier of the format.
        max: u32,
    },
    /// More bytes than the kind can carry.
    #[error("{actual} bytes in a frame of at most {max}")]
    Length {
        /// What was given.
        actual: usize,
        /// Most bytes of the kind.
        max: usize,
    },
    /// Not a length of FD frames.
    #[error("{0} bytes is no length of an fd frame (0..=8, 12, 16, 20, 24, 32, 48, 64)")]
    FdLength(usize),
    /// More than four flag bits.
    #[error("fd flags {0:#X} have more than four bits")]
    FdFlags(u8),
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_of_each_kind_are_kept() {
        let id = Id::standard(0x7FF).unwrap();
        assert_eq!(
            Id::standard(0x800),
            Err(FrameError::Id {
                value: 0x800,
                max: 0x7FF
            })
        );
        assert!(Id::extended(0x2000_0000).is_err());
        assert!(Frame::data(id, &[0; 8]).is_ok());
        assert_eq!(
            Frame::data(id, &[0; 9]),
            Err(FrameError::Length { actual: 9, max: 8 })
        );
        assert_eq!(Frame::fd(id, 0, &[0; 9]), Err(FrameError::FdLength(9)));
        assert_eq!(Frame::fd(id, 16, &[]), Err(FrameError::FdFlags(16)));
        assert_eq!(Frame::fd(id, 1, &[3; 64]).unwrap().payload(), [3; 64]);
        assert!(Frame::remote(id, 9).is_err());
        let remote = Frame::remote(id, 8).unwrap();
        assert_eq!((remote.len(), remote.payload().len()), (8, 0));
    }
}

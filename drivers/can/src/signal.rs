//! Signals: bit fields of a frame's data, read and written as physical values.

use crate::frame::is_fd_len;
use crate::{ByteOrder, Frame, FrameError, FrameKind, Id, SignalConfig};

/// A checked [`SignalConfig`].
///
/// INVARIANT: every bit of the signal lies in the first `frame_len` bytes, `length_bits` is in
/// `1..=64`, `factor` is finite and not zero, `offset` is finite.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Signal {
    id: Id,
    order: ByteOrder,
    /// Of the least significant bit (Intel), or of the most significant (Motorola) with bits
    /// counted downwards through each byte.
    first: u16,
    length_bits: u16,
    signed: bool,
    factor: f64,
    offset: f64,
    frame_len: u8,
}

impl Signal {
    /// Checks what the other methods rely on.
    ///
    /// # Errors
    /// When the identifier, the length, the scale or the frame length is out of range, or a bit
    /// lies outside the frame.
    pub fn new(config: &SignalConfig) -> Result<Self, SignalError> {
        let id = Id::new(config.id, config.extended)?;
        let (start, length) = (config.start_bit, config.length_bits);
        if !(1..=64).contains(&length) {
            return Err(SignalError::LengthBits(length));
        }
        if !config.factor.is_finite() || config.factor == 0.0 {
            return Err(SignalError::Factor(config.factor));
        }
        if !config.offset.is_finite() {
            return Err(SignalError::Offset(config.offset));
        }
        if config.frame_len == 0 || !is_fd_len(usize::from(config.frame_len)) {
            return Err(SignalError::FrameLength(config.frame_len));
        }
        let first = match config.byte_order {
            ByteOrder::LittleEndian => start,
            ByteOrder::BigEndian => start ^ 7,
        };
        let frame_bits = u16::from(config.frame_len) * 8;
        if u32::from(first) + u32::from(length) > u32::from(frame_bits) {
            return Err(SignalError::OutOfFrame {
                start_bit: start,
                length_bits: length,
                frame_bits,
            });
        }
        Ok(Self {
            id,
            order: config.byte_order,
            first,
            length_bits: length,
            signed: config.signed,
            factor: config.factor,
            offset: config.offset,
            frame_len: config.frame_len,
        })
    }

    /// The message that carries it.
    #[must_use]
    pub const fn id(&self) -> Id {
        self.id
    }

    /// Length in bytes of the message that carries it.
    #[must_use]
    pub const fn frame_len(&self) -> u8 {
        self.frame_len
    }

    /// Byte and bit of the signal's bit `k`, 0 the least significant.
    fn place(&self, k: u16) -> (usize, u32) {
        let (at, flip) = match self.order {
            ByteOrder::LittleEndian => (self.first + k, 0),
            ByteOrder::BigEndian => (self.first + self.length_bits - 1 - k, 7),
        };
        (usize::from(at / 8), u32::from(at % 8) ^ flip)
    }

    /// Bytes that must be there for the signal to be read.
    fn bytes_needed(&self) -> usize {
        usize::from((self.first + self.length_bits).div_ceil(8))
    }

    /// The raw bits, not sign-extended; `None` when `data` is too short.
    #[must_use]
    pub fn raw(&self, data: &[u8]) -> Option<u64> {
        if data.len() < self.bytes_needed() {
            return None;
        }
        Some((0..self.length_bits).fold(0, |raw, k| {
            let (byte, bit) = self.place(k);
            raw | u64::from(data[byte] >> bit & 1) << k
        }))
    }

    /// The physical value in a frame's data, in the configured unit; exact for raw values of up to
    /// 53 bits.
    ///
    /// # Errors
    /// When `data` is too short to hold the signal.
    pub fn decode(&self, data: &[u8]) -> Result<f64, ValueError> {
        let raw = self.raw(data).ok_or(ValueError::Short {
            needed: self.bytes_needed(),
            actual: data.len(),
        })?;
        let value = if self.signed {
            let unused = 64 - u32::from(self.length_bits);
            ((raw << unused).cast_signed() >> unused) as f64
        } else {
            raw as f64
        };
        Ok(value * self.factor + self.offset)
    }

    /// Writes the raw bits into `data`, leaving every other bit as it is.
    ///
    /// # Errors
    /// When `raw` has more bits than the signal or `data` is too short.
    pub fn set_raw(&self, raw: u64, data: &mut [u8]) -> Result<(), ValueError> {
        if self.length_bits < 64 && raw >> self.length_bits != 0 {
            return Err(ValueError::RawRange {
                raw,
                length_bits: self.length_bits,
            });
        }
        if data.len() < self.bytes_needed() {
            return Err(ValueError::Short {
                needed: self.bytes_needed(),
                actual: data.len(),
            });
        }
        for k in 0..self.length_bits {
            let (byte, bit) = self.place(k);
            let one = u8::from(raw >> k & 1 == 1);
            data[byte] = data[byte] & !(1 << bit) | one << bit;
        }
        Ok(())
    }

    /// Writes the raw value nearest to `value` (configured unit) into `data`, leaving every other
    /// bit as it is.
    ///
    /// # Errors
    /// When the signal cannot hold the value or `data` is too short.
    pub fn encode(&self, value: f64, data: &mut [u8]) -> Result<(), ValueError> {
        let raw = ((value - self.offset) / self.factor).round();
        let span = 2f64.powi(i32::from(self.length_bits));
        let (low, high) = if self.signed {
            (-span / 2.0, span / 2.0)
        } else {
            (0.0, span)
        };
        // Also refuses NaN.
        if !(raw >= low && raw < high) {
            return Err(ValueError::Range {
                value,
                min: low * self.factor + self.offset,
                max: (high - 1.0) * self.factor + self.offset,
            });
        }
        #[allow(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "in range"
        )]
        let bits = if raw < 0.0 {
            (raw as i64).cast_unsigned()
        } else {
            raw as u64
        };
        let unused = 64 - u32::from(self.length_bits);
        self.set_raw(bits << unused >> unused, data)
    }

    /// A frame of the configured length that carries `data`.
    ///
    /// # Errors
    /// When `data` is longer than the frame kind allows.
    pub(crate) fn frame(&self, data: &[u8]) -> Result<Frame, FrameError> {
        if self.frame_len > 8 {
            Frame::fd(self.id, 0, data)
        } else {
            Frame::data(self.id, data)
        }
    }

    /// Whether `frame` is a data frame of this signal's message.
    #[must_use]
    pub fn is_in(&self, frame: &Frame) -> bool {
        frame.id() == self.id && matches!(frame.kind(), FrameKind::Data | FrameKind::Fd { .. })
    }
}

/// Checks that two signals do not share a bit of the same message.
///
/// # Errors
/// [`SignalError::Overlap`] with the first shared bit.
pub fn check_overlap(a: &Signal, b: &Signal) -> Result<(), SignalError> {
    if a.id != b.id {
        return Ok(());
    }
    for k in 0..a.length_bits {
        let place = a.place(k);
        if (0..b.length_bits).any(|j| b.place(j) == place) {
            return Err(SignalError::Overlap {
                id: a.id,
                byte: place.0,
                bit: place.1,
            });
        }
    }
    Ok(())
}

/// Why a signal's description cannot be used.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum SignalError {
    /// The message identifier is out of range.
    #[error(transparent)]
    Id(#[from] FrameError),
    /// Not `1..=64` bits.
    #[error("length_bits {0} is not in 1..=64")]
    LengthBits(u16),
    /// Zero, infinite or not a number.
    #[error("factor {0} is zero or not finite")]
    Factor(f64),
    /// Infinite or not a number.
    #[error("offset {0} is not finite")]
    Offset(f64),
    /// No frame has this length.
    #[error("frame_len {0} is no length of a frame with data")]
    FrameLength(u8),
    /// Some bits lie behind the frame's end.
    #[error(
        "start_bit {start_bit} with length_bits {length_bits} leaves a frame of {frame_bits} bits"
    )]
    OutOfFrame {
        /// As configured.
        start_bit: u16,
        /// As configured.
        length_bits: u16,
        /// Bits in the frame.
        frame_bits: u16,
    },
    /// Two signals share a bit.
    #[error("two signals share bit {bit} of byte {byte} of message {id}")]
    Overlap {
        /// The message.
        id: Id,
        /// Byte of its data.
        byte: usize,
        /// Bit of that byte, 0 the least significant.
        bit: u32,
    },
}

/// Why a value could not be read or written.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum ValueError {
    /// The frame ends before the signal does.
    #[error("frame data is {actual} bytes, the signal needs {needed}")]
    Short {
        /// Bytes up to the signal's last bit.
        needed: usize,
        /// Bytes there.
        actual: usize,
    },
    /// The signal cannot represent the value.
    #[error("value {value} is outside {min}..{max}")]
    Range {
        /// What was to be written.
        value: f64,
        /// Physical value of the smallest raw value.
        min: f64,
        /// Physical value of the largest raw value.
        max: f64,
    },
    /// The raw value has too many bits.
    #[error("raw value {raw:#x} has more than {length_bits} bits")]
    RawRange {
        /// What was to be written.
        raw: u64,
        /// Bits of the signal.
        length_bits: u16,
    },
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn config(order: ByteOrder, start_bit: u16, length_bits: u16, signed: bool) -> SignalConfig {
        SignalConfig {
            id: 0x100,
            extended: false,
            start_bit,
            length_bits,
            byte_order: order,
            signed,
            factor: 1.0,
            offset: 0.0,
            unit: String::new(),
            frame_len: 8,
        }
    }

    /// Worked by hand: bits 12..24 little-endian are the high nibble of byte 1 and all of byte 2.
    #[test]
    fn intel_bits_grow_upwards() {
        let signal = Signal::new(&config(ByteOrder::LittleEndian, 12, 12, false)).unwrap();
        let data = [0, 0xA0, 0xBC, 0, 0, 0, 0, 0];
        assert_eq!(signal.raw(&data), Some(0xBCA));
    }

    /// Worked by hand: Motorola start 3, 12 bits is the low nibble of byte 0, then byte 1.
    #[test]
    fn motorola_bits_fall_and_go_on_in_the_next_byte() {
        let signal = Signal::new(&config(ByteOrder::BigEndian, 3, 12, false)).unwrap();
        let data = [0x0A, 0xBC, 0, 0, 0, 0, 0, 0];
        assert_eq!(signal.raw(&data), Some(0xABC));
        let signed = Signal::new(&config(ByteOrder::BigEndian, 3, 12, true)).unwrap();
        assert_eq!(signed.decode(&data), Ok(f64::from(0xABC - 0x1000)));
        assert_eq!(
            signed.decode(&data[..1]),
            Err(ValueError::Short {
                needed: 2,
                actual: 1
            })
        );
    }

    #[test]
    fn a_signal_that_leaves_the_frame_is_refused() {
        let out = |order, start, length| Signal::new(&config(order, start, length, false));
        assert!(out(ByteOrder::LittleEndian, 56, 8).is_ok());
        assert!(matches!(
            out(ByteOrder::LittleEndian, 57, 8),
            Err(SignalError::OutOfFrame { .. })
        ));
        // Bit 56 is the last bit of the last byte when counted downwards.
        assert!(out(ByteOrder::BigEndian, 56, 1).is_ok());
        assert!(out(ByteOrder::BigEndian, 56, 2).is_err());
        assert_eq!(
            out(ByteOrder::BigEndian, 7, 0),
            Err(SignalError::LengthBits(0))
        );
        assert!(out(ByteOrder::LittleEndian, u16::MAX, 64).is_err());
        let mut bad = config(ByteOrder::LittleEndian, 0, 8, false);
        bad.factor = 0.0;
        assert_eq!(Signal::new(&bad), Err(SignalError::Factor(0.0)));
        bad.factor = 1.0;
        bad.offset = f64::INFINITY;
        assert_eq!(Signal::new(&bad), Err(SignalError::Offset(f64::INFINITY)));
        bad.offset = 0.0;
        bad.frame_len = 9;
        assert_eq!(Signal::new(&bad), Err(SignalError::FrameLength(9)));
    }

    #[test]
    fn signals_that_share_a_bit_are_refused() {
        let a = Signal::new(&config(ByteOrder::LittleEndian, 0, 16, false)).unwrap();
        let b = Signal::new(&config(ByteOrder::BigEndian, 8, 4, false)).unwrap();
        assert!(matches!(
            check_overlap(&a, &b),
            Err(SignalError::Overlap {
                byte: 1,
                bit: 0,
                ..
            })
        ));
        let c = Signal::new(&config(ByteOrder::BigEndian, 23, 8, false)).unwrap();
        assert_eq!(check_overlap(&a, &c), Ok(()));
    }

    #[test]
    fn values_out_of_range_are_refused() {
        let signal = Signal::new(&config(ByteOrder::LittleEndian, 0, 8, true)).unwrap();
        let mut data = [0; 8];
        assert!(signal.encode(-128.0, &mut data).is_ok());
        assert_eq!(data[0], 0x80);
        for value in [-129.0, 128.0, f64::NAN, f64::INFINITY] {
            assert!(matches!(
                signal.encode(value, &mut data),
                Err(ValueError::Range { .. })
            ));
        }
        assert!(matches!(
            signal.set_raw(256, &mut data),
            Err(ValueError::RawRange { .. })
        ));
    }

    prop_compose! {
        fn any_signal()(length in 1u16..=64, big in any::<bool>(), signed in any::<bool>())
            (at in 0..=64 - length, length in Just(length), big in Just(big),
             signed in Just(signed)) -> Signal {
            let (order, start) = if big {
                (ByteOrder::BigEndian, at ^ 7)
            } else {
                (ByteOrder::LittleEndian, at)
            };
            Signal::new(&config(order, start, length, signed)).unwrap()
        }
    }

    proptest! {
        #[test]
        fn what_is_written_is_read_and_the_rest_is_untouched(
            signal in any_signal(), raw: u64, before: [u8; 8],
        ) {
            let raw = raw >> (64 - signal.length_bits);
            let mut data = before;
            signal.set_raw(raw, &mut data).unwrap();
            prop_assert_eq!(signal.raw(&data), Some(raw));
            signal.set_raw(signal.raw(&before).unwrap(), &mut data).unwrap();
            prop_assert_eq!(data, before);
        }

        #[test]
        fn physical_values_survive_up_to_53_bits(signal in any_signal(), bits: u64, data: [u8; 8]) {
            prop_assume!(signal.length_bits <= 53);
            let mut data = data;
            signal.set_raw(bits >> (64 - signal.length_bits), &mut data).unwrap();
            let value = signal.decode(&data).unwrap();
            let mut again = data;
            signal.encode(value, &mut again).unwrap();
            prop_assert_eq!(again, data);
        }

        #[test]
        fn no_description_and_no_data_panics(
            id: u32, extended: bool, start_bit: u16, length_bits in 0u16..80, big: bool,
            signed: bool, factor: f64, offset: f64, frame_len: u8,
            data in proptest::collection::vec(any::<u8>(), 0..65),
        ) {
            let byte_order = if big { ByteOrder::BigEndian } else { ByteOrder::LittleEndian };
            let config = SignalConfig { id, extended, start_bit, length_bits, byte_order, signed,
                factor, offset, unit: String::new(), frame_len };
            if let Ok(signal) = Signal::new(&config) {
                let _ = signal.decode(&data);
                let _ = signal.encode(offset, &mut data.clone());
            }
        }
    }
}

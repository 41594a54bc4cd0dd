//! The EVT3 word: 4 bits of type, 12 bits of payload, little-endian (EVT 3.0 format page).
//!
//! Shared by decoder and encoder, so that each code has one home.

pub(super) const ADDR_Y: u16 = 0x0;
pub(super) const ADDR_X: u16 = 0x2;
pub(super) const VECT_BASE_X: u16 = 0x3;
pub(super) const VECT_12: u16 = 0x4;
pub(super) const VECT_8: u16 = 0x5;
pub(super) const TIME_LOW: u16 = 0x6;
pub(super) const CONTINUED_4: u16 = 0x7;
pub(super) const TIME_HIGH: u16 = 0x8;
pub(super) const EXT_TRIGGER: u16 = 0xA;
pub(super) const OTHERS: u16 = 0xE;
pub(super) const CONTINUED_12: u16 = 0xF;

/// Bits of a row or column address.
pub(super) const ADDRESS_MASK: u16 = 0x7ff;
/// Polarity of `ADDR_X` and `VECT_BASE_X`: set when the pixel got brighter.
pub(super) const ON_BIT: u16 = 0x800;
/// Bits of a time word, a `VECT_12` or a `CONTINUED_12`.
pub(super) const PAYLOAD_MASK: u16 = 0xfff;
/// Microseconds per step of `TIME_HIGH`.
pub(super) const HIGH_UNIT_US: u64 = 1 << 12;
/// Width of `TIME_HIGH`, bits.
pub(super) const HIGH_BITS: u32 = 12;
/// Pixels covered by one group `VECT_12`, `VECT_12`, `VECT_8`.
pub(super) const GROUP_PIXELS: u16 = 32;

/// Type of `word`.
#[inline]
pub(super) const fn kind(word: u16) -> u16 {
    word >> 12
}

/// Word of type `kind`; bits of `payload` above 11 are cut off.
#[inline]
pub(super) const fn make(kind: u16, payload: u16) -> u16 {
    kind << 12 | payload & PAYLOAD_MASK
}

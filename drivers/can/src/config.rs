//! What a vehicle's bus carries, as written in a configuration file.

use serde::{Deserialize, Serialize};

/// Order of a signal's bytes, with DBC's bit numbering (bit `n` is bit `n % 8` of byte `n / 8`,
/// bit 0 of a byte being its least significant).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ByteOrder {
    /// Intel: the start bit is the least significant bit, the signal grows to higher bits.
    LittleEndian,
    /// Motorola: the start bit is the most significant bit, the signal falls within its byte and
    /// goes on at bit 7 of the next.
    BigEndian,
}

/// One signal in one message, as a DBC file describes it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SignalConfig {
    /// Message identifier.
    pub id: u32,
    /// Whether `id` is a 29-bit identifier.
    #[serde(default)]
    pub extended: bool,
    /// Start bit, DBC numbering; see [`ByteOrder`].
    pub start_bit: u16,
    /// Length in bits, `1..=64`.
    pub length_bits: u16,
    /// Byte order.
    pub byte_order: ByteOrder,
    /// Whether the raw value is two's complement.
    #[serde(default)]
    pub signed: bool,
    /// Physical value per raw unit: `physical = raw * factor + offset`.
    pub factor: f64,
    /// Physical value of raw zero.
    #[serde(default)]
    pub offset: f64,
    /// Unit of the physical value.
    pub unit: String,
    /// Length in bytes of the message that carries it; above 8 it is an FD frame.
    #[serde(default = "eight")]
    pub frame_len: u8,
}

const fn eight() -> u8 {
    8
}

/// The two signals that describe the vehicle's motion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MotionConfig {
    /// Forward speed; unit `m/s`, `km/h` or `mph`.
    pub speed: SignalConfig,
    /// Yaw rate, positive to the left; unit `rad/s` or `deg/s`. A bus that counts the other way
    /// takes a negative factor.
    pub yaw_rate: SignalConfig,
    /// A value older than this, milliseconds, is not paired with a newer one of the other signal.
    #[serde(default = "hundred")]
    pub age_ms_max: u32,
}

const fn hundred() -> u32 {
    100
}

impl Default for MotionConfig {
    /// The bus of the synthetic rig: speed in message 0x200 (Intel, 0.01 km/h), yaw rate in
    /// message 0x201 (Motorola, 0.01 deg/s).
    fn default() -> Self {
        Self {
            speed: SignalConfig {
                id: 0x200,
                extended: false,
                start_bit: 0,
                length_bits: 16,
                byte_order: ByteOrder::LittleEndian,
                signed: true,
                factor: 0.01,
                offset: 0.0,
                unit: "km/h".to_owned(),
                frame_len: 8,
            },
            yaw_rate: SignalConfig {
                id: 0x201,
                extended: false,
                start_bit: 7,
                length_bits: 16,
                byte_order: ByteOrder::BigEndian,
                signed: true,
                factor: 0.01,
                offset: 0.0,
                unit: "deg/s".to_owned(),
                frame_len: 8,
            },
            age_ms_max: hundred(),
        }
    }
}

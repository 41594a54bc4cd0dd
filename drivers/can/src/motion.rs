//! The vehicle's motion from the two signals that carry it, and back.

use noctule_sensor::{Motion, Realtime, Stamp};

use crate::{
    Frame, FrameError, FrameKind, MotionConfig, Signal, SignalError, ValueError, check_overlap,
};

/// What happened to the frames a [`MotionDecoder`] was given; every frame counts once in
/// `used`, `unknown`, `short`, `remote` or `error`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct MotionCounts {
    /// Data frames that carried a signal.
    pub used: u64,
    /// Data frames of messages that carry neither signal.
    pub unknown: u64,
    /// Data frames of a known message, too short for a signal they should carry.
    pub short: u64,
    /// Remote requests.
    pub remote: u64,
    /// Error reports.
    pub error: u64,
    /// Used frames whose partner signal was not there yet or too old, so that nothing was emitted.
    pub unpaired: u64,
}

/// A signal with the factor that takes its unit to SI.
#[derive(Debug, Clone, Copy)]
struct Channel {
    signal: Signal,
    si_per_unit: f64,
}

/// Both channels, checked against each other.
#[derive(Debug, Clone, Copy)]
struct Channels {
    speed: Channel,
    yaw_rate: Channel,
}

impl Channels {
    fn new(config: &MotionConfig) -> Result<Self, MotionError> {
        let speed = Channel {
            signal: Signal::new(&config.speed).map_err(MotionError::speed)?,
            si_per_unit: match config.speed.unit.as_str() {
                "m/s" => 1.0,
                "km/h" => 1.0 / 3.6,
                "mph" => 0.447_04,
                other => return Err(MotionError::unit("speed", other, "m/s, km/h or mph")),
            },
        };
        let yaw_rate = Channel {
            signal: Signal::new(&config.yaw_rate).map_err(MotionError::yaw_rate)?,
            si_per_unit: match config.yaw_rate.unit.as_str() {
                "rad/s" => 1.0,
                "deg/s" => std::f64::consts::PI / 180.0,
                other => return Err(MotionError::unit("yaw_rate", other, "rad/s or deg/s")),
            },
        };
        check_overlap(&speed.signal, &yaw_rate.signal).map_err(MotionError::yaw_rate)?;
        Ok(Self { speed, yaw_rate })
    }
}

/// Turns frames into [`Motion`].
///
/// The rule: the latest value of each signal is kept with its arrival. A frame that updates either
/// (or both) emits one `Motion`, stamped with that frame's arrival and made of the latest of both,
/// provided the other value has been seen and is at most `age_ms_max` older.
#[derive(Debug, Clone)]
pub struct MotionDecoder {
    channels: Channels,
    age_ns_max: i64,
    speed_mps: Option<(Stamp<Realtime>, f64)>,
    yaw_rate_rps: Option<(Stamp<Realtime>, f64)>,
    counts: MotionCounts,
}

impl MotionDecoder {
    /// A decoder that has seen nothing yet.
    ///
    /// # Errors
    /// When a signal is out of its frame, both share a bit, or a unit is unknown.
    pub fn new(config: &MotionConfig) -> Result<Self, MotionError> {
        Ok(Self {
            channels: Channels::new(config)?,
            age_ns_max: i64::from(config.age_ms_max) * 1_000_000,
            speed_mps: None,
            yaw_rate_rps: None,
            counts: MotionCounts::default(),
        })
    }

    /// Takes one frame as it arrived; gives the motion it completes.
    pub fn push(&mut self, frame: &Frame, arrival: Stamp<Realtime>) -> Option<Motion> {
        match frame.kind() {
            FrameKind::Remote => {
                self.counts.remote += 1;
                return None;
            }
            FrameKind::Error => {
                self.counts.error += 1;
                return None;
            }
            FrameKind::Data | FrameKind::Fd { .. } => {}
        }
        let speed = read(&self.channels.speed, frame);
        let yaw_rate = read(&self.channels.yaw_rate, frame);
        if speed.is_none() && yaw_rate.is_none() {
            self.counts.unknown += 1;
            return None;
        }
        let (Ok(speed), Ok(yaw_rate)) = (speed.transpose(), yaw_rate.transpose()) else {
            self.counts.short += 1;
            return None;
        };
        self.counts.used += 1;
        if let Some(value) = speed {
            self.speed_mps = Some((arrival, value));
        }
        if let Some(value) = yaw_rate {
            self.yaw_rate_rps = Some((arrival, value));
        }
        let motion = self.latest(arrival);
        self.counts.unpaired += u64::from(motion.is_none());
        motion
    }

    fn latest(&self, now: Stamp<Realtime>) -> Option<Motion> {
        let fresh = |(at, value): (Stamp<Realtime>, f64)| {
            (now.diff_nanos(at) <= self.age_ns_max).then_some(value)
        };
        let speed_mps = self.speed_mps.and_then(fresh)?;
        let yaw_rate_rps = self.yaw_rate_rps.and_then(fresh)?;
        #[allow(
            clippy::cast_possible_truncation,
            reason = "single precision is what is kept"
        )]
        Some(Motion {
            t: now,
            speed_mps: speed_mps as f32,
            yaw_rate_rps: yaw_rate_rps as f32,
        })
    }

    /// What happened to the frames so far.
    #[must_use]
    pub const fn counts(&self) -> MotionCounts {
        self.counts
    }
}

/// `None` when the frame's message does not carry the channel.
fn read(channel: &Channel, frame: &Frame) -> Option<Result<f64, ValueError>> {
    let signal = &channel.signal;
    signal
        .is_in(frame)
        .then(|| Ok(signal.decode(frame.payload())? * channel.si_per_unit))
}

/// Turns motion into the frames a vehicle would send.
#[derive(Debug, Clone, Copy)]
pub struct MotionEncoder {
    channels: Channels,
}

impl MotionEncoder {
    /// An encoder for the same description a [`MotionDecoder`] takes.
    ///
    /// # Errors
    /// As [`MotionDecoder::new`].
    pub fn new(config: &MotionConfig) -> Result<Self, MotionError> {
        Ok(Self {
            channels: Channels::new(config)?,
        })
    }

    /// The frame with the speed (metres per second) and, when the yaw rate (radians per second,
    /// positive to the left) travels in a message of its own, the frame with that. Values are
    /// rounded to the signals' resolution; all other bits are zero.
    ///
    /// # Errors
    /// When a signal cannot hold its value.
    pub fn encode(
        &self,
        speed_mps: f64,
        yaw_rate_rps: f64,
    ) -> Result<(Frame, Option<Frame>), MotionError> {
        let Channels { speed, yaw_rate } = &self.channels;
        let shared = speed.signal.id() == yaw_rate.signal.id();
        let (mut first, mut second) = ([0; 64], [0; 64]);
        let first = &mut first[..usize::from(speed.signal.frame_len())];
        let second = &mut second[..usize::from(yaw_rate.signal.frame_len())];
        write(speed, speed_mps, first).map_err(|e| MotionError::value("speed", e))?;
        let target = if shared { &mut *first } else { &mut *second };
        write(yaw_rate, yaw_rate_rps, target).map_err(|e| MotionError::value("yaw_rate", e))?;
        let other = if shared {
            None
        } else {
            Some(yaw_rate.signal.frame(second)?)
        };
        Ok((speed.signal.frame(first)?, other))
    }
}

fn write(channel: &Channel, value_si: f64, data: &mut [u8]) -> Result<(), ValueError> {
    channel.signal.encode(value_si / channel.si_per_unit, data)
}

/// Why motion could not be configured or encoded.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MotionError {
    /// A signal's description is unusable.
    #[error("signal {name}: {source}")]
    Signal {
        /// `speed` or `yaw_rate`.
        name: &'static str,
        /// What is wrong with it.
        source: SignalError,
    },
    /// A unit this decoder does not know.
    #[error("signal {name}: unit {unit:?} is not {expected}")]
    Unit {
        /// `speed` or `yaw_rate`.
        name: &'static str,
        /// As configured.
        unit: String,
        /// The units it can be.
        expected: &'static str,
    },
    /// A value does not fit its signal.
    #[error("signal {name}: {source}")]
    Value {
        /// `speed` or `yaw_rate`.
        name: &'static str,
        /// What is wrong with it.
        source: ValueError,
    },
    /// The frame could not be made.
    #[error(transparent)]
    Frame(#[from] FrameError),
}

impl MotionError {
    const fn speed(source: SignalError) -> Self {
        Self::Signal {
            name: "speed",
            source,
        }
    }

    const fn yaw_rate(source: SignalError) -> Self {
        Self::Signal {
            name: "yaw_rate",
            source,
        }
    }

    fn unit(name: &'static str, unit: &str, expected: &'static str) -> Self {
        Self::Unit {
            name,
            unit: unit.to_owned(),
            expected,
        }
    }

    const fn value(name: &'static str, source: ValueError) -> Self {
        Self::Value { name, source }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ByteOrder, Id};

    const MS: u64 = 1_000_000;

    fn at(ms: u64) -> Stamp<Realtime> {
        Stamp::from_nanos(ms * MS)
    }

    #[test]
    fn motion_comes_with_either_signal_once_both_are_known() {
        let config = MotionConfig::default();
        let mut decoder = MotionDecoder::new(&config).unwrap();
        let encoder = MotionEncoder::new(&config).unwrap();
        let (speed, yaw_rate) = encoder.encode(10.0, -0.1).unwrap();
        let yaw_rate = yaw_rate.unwrap();
        assert_eq!(decoder.push(&speed, at(0)), None);
        let motion = decoder.push(&yaw_rate, at(5)).unwrap();
        assert_eq!(motion.t, at(5));
        assert!((motion.speed_mps - 10.0).abs() < 0.005 / 3.6);
        assert!((motion.yaw_rate_rps + 0.1).abs() < 0.005_f32.to_radians());
        assert!(decoder.push(&speed, at(10)).is_some());
        // The yaw rate fell silent at 5 ms.
        assert!(decoder.push(&speed, at(105)).is_some());
        assert!(decoder.push(&speed, at(106)).is_none());
        let counts = decoder.counts();
        assert_eq!((counts.used, counts.unpaired), (5, 2));
    }

    #[test]
    fn one_message_with_both_signals_gives_one_motion_per_frame() {
        let mut config = MotionConfig::default();
        config.yaw_rate.id = config.speed.id;
        config.yaw_rate.start_bit = 23;
        let mut decoder = MotionDecoder::new(&config).unwrap();
        let encoder = MotionEncoder::new(&config).unwrap();
        let (frame, other) = encoder.encode(-2.0, 0.5).unwrap();
        assert_eq!(other, None);
        let motion = decoder.push(&frame, at(1)).unwrap();
        assert!((motion.speed_mps + 2.0).abs() < 0.002);
        assert!((motion.yaw_rate_rps - 0.5).abs() < 0.000_1);
    }

    #[test]
    fn every_other_frame_is_counted_by_kind() {
        let mut decoder = MotionDecoder::new(&MotionConfig::default()).unwrap();
        let known = Id::standard(0x200).unwrap();
        let unknown = Id::extended(0x200).unwrap();
        for frame in [
            Frame::data(unknown, &[0; 8]).unwrap(),
            Frame::data(known, &[0]).unwrap(),
            Frame::remote(known, 8).unwrap(),
            Frame::error(4, &[0; 8]).unwrap(),
        ] {
            assert_eq!(decoder.push(&frame, at(0)), None);
        }
        let expected = MotionCounts {
            unknown: 1,
            short: 1,
            remote: 1,
            error: 1,
            ..MotionCounts::default()
        };
        assert_eq!(decoder.counts(), expected);
    }

    #[test]
    fn an_fd_message_is_encoded_as_one() {
        let mut config = MotionConfig::default();
        config.speed.frame_len = 64;
        config.speed.start_bit = 480;
        let encoder = MotionEncoder::new(&config).unwrap();
        let (speed, _) = encoder.encode(1.0, 0.0).unwrap();
        assert_eq!(speed.kind(), FrameKind::Fd { flags: 0 });
        assert_eq!(speed.payload()[60..62], 360u16.to_le_bytes());
    }

    #[test]
    fn bad_descriptions_say_which_signal_and_why() {
        let refuse = |edit: fn(&mut MotionConfig)| {
            let mut config = MotionConfig::default();
            edit(&mut config);
            MotionDecoder::new(&config).unwrap_err().to_string()
        };
        assert_eq!(
            refuse(|c| c.speed.unit = "knots".into()),
            "signal speed: unit \"knots\" is not m/s, km/h or mph"
        );
        assert_eq!(
            refuse(|c| c.yaw_rate.start_bit = 56),
            "signal yaw_rate: start_bit 56 with length_bits 16 leaves a frame of 64 bits"
        );
        assert_eq!(
            refuse(|c| {
                c.yaw_rate.id = c.speed.id;
                c.yaw_rate.byte_order = ByteOrder::BigEndian;
            }),
            "signal yaw_rate: two signals share bit 0 of byte 0 of message 200"
        );
        let encoder = MotionEncoder::new(&MotionConfig::default()).unwrap();
        assert_eq!(
            encoder.encode(100.0, 0.0).unwrap_err().to_string(),
            "signal speed: value 360 is outside -327.68..327.67"
        );
    }

    #[test]
    fn a_description_reads_from_toml_and_unknown_keys_are_refused() {
        let text = r#"
            [speed]
            id = 0x18FEF100
            extended = true
            start_bit = 8
            length_bits = 16
            byte_order = "little_endian"
            factor = 0.00390625
            unit = "km/h"
            [yaw_rate]
            id = 0x300
            start_bit = 7
            length_bits = 12
            byte_order = "big_endian"
            signed = true
            factor = 0.001
            unit = "rad/s"
        "#;
        let config: MotionConfig = toml::from_str(text).unwrap();
        assert_eq!((config.speed.frame_len, config.age_ms_max), (8, 100));
        assert!(MotionDecoder::new(&config).is_ok());
        let unknown = format!("{text}\nsped = 3");
        assert!(toml::from_str::<MotionConfig>(&unknown).is_err());
    }
}

//! Files made up for tests: a RAW file, a QT64 capture and a recording, and what is in them.
#![allow(dead_code, reason = "every test program uses its part")]
#![allow(clippy::unwrap_used, reason = "what is made up is known to be valid")]

use std::fs;
use std::path::{Path, PathBuf};

use noctule_camera::{Encoding, FrameStamp, StampedAt};
use noctule_can::{MotionConfig, MotionEncoder};
use noctule_evk4::{Evt3Encoder, Format, Geometry, RawHeader};
use noctule_hesai::pcap::Writer;
use noctule_hesai::{Qt64Echoes, Qt64Encoder, ReturnMode};
use noctule_recording::{
    Calibration, CameraMeta, CanMeta, ClockReading, EdgeTruth, EventsMeta, ExposureTruth,
    Generator, GridSize, LidarMeta, Meta, RecordingWriter, Rectangle, StrobeMeta, StrobePolarity,
    TruthWriter,
};
use noctule_sensor::{Event, Lidar, Realtime, Stamp, TriggerEdge};

pub const PORT: u16 = 2368;
/// Packets of the capture, one lost among them.
pub const PACKETS: u64 = 700;
pub const LOST: u64 = 350;
/// Firings of a dual-return packet, echoes of a firing.
const FIRINGS: u64 = 2;

/// Below `$NOCTULE_DATA`; `None`, said aloud, where there is no such folder.
pub fn data(folder: &str, test: &str) -> Option<PathBuf> {
    let Some(data) = std::env::var_os("NOCTULE_DATA") else {
        eprintln!("{test}: SKIPPED, NOCTULE_DATA is not set: made-up files are tested alone");
        return None;
    };
    Some(PathBuf::from(data).join(folder))
}

pub fn arrival(k: u64) -> Stamp<Realtime> {
    Stamp::from_nanos(1_700_000_000_000_000_000 + k * 1_000_000)
}

/// A thousand events over 50 ms, in stream order.
pub fn events() -> Vec<Event> {
    let event = |k: u64| Event {
        t: Stamp::from_micros(1_000 + 50 * k),
        x: u16::try_from(k * 7 % 1280).unwrap(),
        y: u16::try_from(k * 11 % 720).unwrap(),
        on: k.is_multiple_of(3),
    };
    (0..1_000).map(event).collect()
}

/// Strobe edges between the events: microseconds and polarity.
pub const EDGES: [(u64, bool); 4] = [
    (2_010, true),
    (12_010, false),
    (22_020, true),
    (42_020, false),
];

/// A RAW file's header and payload.
pub fn raw() -> (Vec<u8>, Vec<u8>) {
    let geometry = Geometry {
        width: 1280,
        height: 720,
    };
    let (mut encoder, mut bytes) = (Evt3Encoder::new(), Vec::new());
    let mut edges = EDGES.into_iter().peekable();
    for event in events() {
        while let Some((us, rising)) = edges.next_if(|(us, _)| *us < event.t.as_micros()) {
            let t = Stamp::from_micros(us);
            encoder
                .trigger(
                    TriggerEdge {
                        t,
                        channel: 0,
                        rising,
                    },
                    &mut bytes,
                )
                .unwrap();
        }
        encoder.event(event, &mut bytes).unwrap();
    }
    encoder.flush(&mut bytes);
    (RawHeader::new(Format::Evt3, geometry).to_bytes(), bytes)
}

pub fn write_raw(path: &Path) {
    let (header, payload) = raw();
    fs::write(path, [header, payload].concat()).unwrap();
}

/// Distance of a channel's first echo, in the encoder's steps of 4 mm.
pub fn distance_m(channel: usize) -> f32 {
    2.0 + 0.1 * f32::from(u8::try_from(channel).unwrap())
}

/// Every packet of 2.3 turns at 600 rpm. Even channels have two equal echoes.
pub fn packets() -> Vec<(Vec<u8>, Stamp<Realtime>)> {
    let mut encoder = Qt64Encoder::new(ReturnMode::FirstLast, 600, 41).unwrap();
    let [mut first, mut last] = [Qt64Echoes::NONE; 2];
    for (channel, intensity) in (0..64).zip(0..) {
        first.set(channel, distance_m(channel), intensity);
        let further = if channel % 2 == 0 { 0.0 } else { 1.0 };
        last.set(channel, distance_m(channel) + further, intensity);
    }
    let mut packet = |k: u64| {
        let azimuth = |firing: u64| u16::try_from((k * 120 + firing * 60) % 36_000).unwrap();
        let t: Stamp<Lidar> = Stamp::from_nanos(1_700_000_000_000_000_000 + k * 333_332);
        let firings = [(azimuth(0), [first, last]), (azimuth(1), [first, last])];
        (encoder.dual(t, &firings).unwrap().to_vec(), arrival(k))
    };
    (0..PACKETS).map(&mut packet).collect()
}

/// Non-zero returns, and points without repeated ones, of `packets` packets.
pub const fn returns(packets: u64) -> (u64, u64) {
    (packets * FIRINGS * 128, packets * FIRINGS * 96)
}

pub fn write_pcap(path: &Path) {
    let mut writer = Writer::create(path, PORT).unwrap();
    for (k, (payload, t)) in (0..).zip(packets()) {
        if k != LOST {
            writer.datagram(t, &payload).unwrap();
        }
    }
    writer.finish().unwrap();
}

fn meta() -> Meta {
    Meta {
        name: "made up".to_owned(),
        generator: Some(Generator {
            name: "tests".to_owned(),
            version: "1".to_owned(),
            seed: 7,
        }),
        split: None,
        steps: 2,
        crop: Rectangle {
            x: 0,
            y: 0,
            width: 4,
            height: 4,
        },
        network: GridSize {
            width: 3,
            height: 2,
        },
        events: Some(EventsMeta {
            serial: String::new(),
            width: 1280,
            height: 720,
            strobe: Some(StrobeMeta {
                channel: 0,
                polarity: StrobePolarity::ActiveHigh,
                open_delay_ns: 0,
                close_delay_ns: 0,
            }),
        }),
        camera: Some(CameraMeta {
            serial: String::new(),
            width: 6,
            height: 4,
            encoding: Encoding::Gamma22,
            bit_depth: 8,
        }),
        lidar: Some(LidarMeta {
            serial: String::new(),
            model: String::new(),
            port: PORT,
        }),
        can: Some(CanMeta {
            interface: "can0".to_owned(),
            motion: MotionConfig::default(),
        }),
    }
}

/// True depth of every step of the recording's one sample, metres; 0 is empty.
pub const DEPTH_M: [f32; 6] = [1.0, 0.0, 2.5, 80.0, 10.25, 4.0];

/// A recording with every sensor: images 5, 6 and 8 of the driver's counter, ten CAN frames.
pub fn write_recording(dir: &Path) {
    let mut writer = RecordingWriter::create(dir, meta(), &Calibration::default_rig()).unwrap();
    let (header, payload) = raw();
    writer.events_header(&header).unwrap();
    for (k, bytes) in (0..).zip(payload.chunks(333)) {
        writer.event_transfer(bytes, arrival(k)).unwrap();
    }
    for (payload, t) in packets() {
        writer.datagram(&payload, t).unwrap();
    }
    for sequence in [5, 6, 8] {
        let stamp = FrameStamp {
            sequence,
            driver: Stamp::from_nanos(u64::from(sequence) * 200_000_000),
            at: StampedAt::StartOfExposure,
            arrival: arrival(u64::from(sequence) * 200),
            exposure_set_ns: 100_000_000,
            gain_db: 0.0,
        };
        writer.image(stamp, 6, 4, &[9; 6 * 4 * 3]).unwrap();
    }
    write_can(&mut writer);
    for k in 0..2 {
        let reading = ClockReading {
            realtime: arrival(1000 * k),
            monotonic: Stamp::from_nanos(1_000_000_000 * k),
            tai_offset_s: 37,
            phc: None,
        };
        writer.clock_reading(reading).unwrap();
    }
    writer.finish().unwrap();
    write_truth(dir);
}

/// Five samples of motion; the bus's two messages make ten frames.
fn write_can(writer: &mut RecordingWriter) {
    let encoder = MotionEncoder::new(&MotionConfig::default()).unwrap();
    for k in 0..5 {
        let (speed, yaw_rate) = encoder.encode(10.0, 0.1).unwrap();
        writer.can(speed, arrival(2 * k)).unwrap();
        writer.can(yaw_rate.unwrap(), arrival(2 * k + 1)).unwrap();
    }
}

fn write_truth(dir: &Path) {
    let mut truth = TruthWriter::create(dir, 2).unwrap();
    for (index, open_edge) in [(0, EdgeTruth::Once), (1, EdgeTruth::Doubled)] {
        let open = 1_000_000 * u64::from(index);
        truth
            .exposure(&ExposureTruth {
                index,
                open_tai: Stamp::from_nanos(open),
                close_tai: Stamp::from_nanos(open + 500),
                open_evk4: Stamp::from_nanos(open),
                close_evk4: Stamp::from_nanos(open + 500),
                image_sequence: Some(index),
                image_dropped: index == 1,
                open_edge,
                close_edge: EdgeTruth::Missed,
            })
            .unwrap();
    }
    let sample = truth.sample(0).unwrap();
    for step in 1..=2 {
        sample.gt(step, 3, 2, &DEPTH_M).unwrap();
        sample
            .sparse(step, 3, 2, &[0.0, 0.0, 2.5, 0.0, 0.0, 0.0])
            .unwrap();
    }
    truth.finish().unwrap();
}

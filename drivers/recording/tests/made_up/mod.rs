//! A small made-up drive with every sensor, and awkward values in it.
#![allow(dead_code, reason = "every test program uses its part")]
#![allow(clippy::unwrap_used, reason = "what is made up is known to be valid")]

use std::path::Path;

use noctule_camera::{Encoding, FrameStamp, StampedAt};
use noctule_can::{Frame, Id, MotionConfig};
use noctule_recording::{
    Calibration, CameraMeta, CanMeta, ClockReading, Counts, EventsMeta, Generator, GridSize,
    LidarMeta, Meta, RecordingWriter, Rectangle, Split, StrobeMeta, StrobePolarity,
};
use noctule_sensor::{Realtime, Stamp};

pub const TRANSFERS: usize = 40;
pub const ANGLES: &[u8] = b"Laser id,Elevation,Azimuth\n1,-52.1,8.7\n";

/// What the sensors of a drive delivered.
#[derive(Debug, Clone, PartialEq)]
pub struct Delivered {
    pub header: Vec<u8>,
    pub transfers: Vec<(Vec<u8>, Stamp<Realtime>)>,
    pub datagrams: Vec<(Vec<u8>, Stamp<Realtime>)>,
    pub images: Vec<(FrameStamp, Vec<u8>)>,
    pub can: Vec<(Frame, Stamp<Realtime>)>,
    pub clocks: Vec<ClockReading>,
}

pub fn at(k: usize) -> Stamp<Realtime> {
    Stamp::from_nanos(1_700_000_000_123_456_789 + 1_000_003 * k as u64)
}

/// Bytes that look like nothing in particular.
fn noise(len: usize, seed: usize) -> Vec<u8> {
    let mut state = u32::try_from(seed).unwrap() | 1;
    let step = |_| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        state.to_be_bytes()[0]
    };
    (0..len).map(step).collect()
}

pub fn delivered() -> Delivered {
    let id = |value| Id::standard(value).unwrap();
    let stamp = |k: u32| FrameStamp {
        sequence: u32::MAX.wrapping_add(k),
        driver: Stamp::from_nanos(123_456_789_012 + u64::from(k)),
        at: [StampedAt::StartOfExposure, StampedAt::EndOfExposure][k as usize % 2],
        arrival: at(k as usize),
        exposure_set_ns: 150_000_000 + u64::from(k),
        gain_db: 0.1 * k as f32,
    };
    Delivered {
        header: b"% evt 3.0\n% format EVT3;height=720;width=1280\n% geometry 1280x720\n% end\n"
            .to_vec(),
        // Of every awkward length: none, odd, and long; the first begins like a header line.
        transfers: (0..TRANSFERS)
            .map(|k| match k {
                0 => (b"% looks like a header line\n".to_vec(), at(0)),
                1 => (Vec::new(), at(1)),
                _ => (noise(k * k * 37 + 1, k), at(k)),
            })
            .collect(),
        datagrams: (0..9).map(|k| (noise(1072 + k, k), at(2 * k))).collect(),
        images: (0..3)
            .map(|k| (stamp(k), noise(6 * 4 * 3, k as usize)))
            .collect(),
        can: vec![
            (Frame::data(id(0x200), &[1, 2, 3]).unwrap(), at(0)),
            (Frame::fd(id(0x201), 5, &[9; 12]).unwrap(), at(1)),
            (Frame::remote(id(0x7FF), 8).unwrap(), at(2)),
            (
                Frame::error(4, &[0; 8]).unwrap(),
                Stamp::from_nanos(u64::MAX),
            ),
        ],
        clocks: [37, -3, 0]
            .into_iter()
            .enumerate()
            .map(|(k, tai_offset_s)| ClockReading {
                realtime: at(k),
                monotonic: Stamp::from_nanos(k as u64 * 1_000_000_007),
                tai_offset_s,
                phc: (k > 0).then(|| Stamp::from_nanos(k as u64)),
            })
            .collect(),
    }
}

pub fn calibration() -> Calibration {
    let mut calibration = Calibration::default_rig();
    calibration.lidar_angles = Some("lidar_angles.csv".to_owned());
    calibration.camera.distortion.k1 = -0.1 / 3.0;
    calibration
}

pub fn meta() -> Meta {
    Meta {
        name: "made up \"drive\"".to_owned(),
        generator: Some(Generator {
            name: "tests".to_owned(),
            version: "1".to_owned(),
            seed: u64::MAX,
        }),
        split: Some(Split::Test),
        steps: 8,
        crop: Rectangle {
            x: 1,
            y: 0,
            width: 4,
            height: 4,
        },
        network: GridSize {
            width: 2,
            height: 2,
        },
        events: Some(EventsMeta {
            serial: "0001".to_owned(),
            width: 1280,
            height: 720,
            strobe: Some(StrobeMeta {
                channel: 0,
                polarity: StrobePolarity::ActiveLow,
                open_delay_ns: -500,
                close_delay_ns: 12_000,
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
            model: "PandarQT64".to_owned(),
            port: 2368,
        }),
        can: Some(CanMeta {
            interface: "can0".to_owned(),
            motion: MotionConfig::default(),
        }),
    }
}

/// Everything but the end.
pub fn begin(dir: &Path, given: &Delivered) -> RecordingWriter {
    let mut writer = RecordingWriter::create(dir, meta(), &calibration()).unwrap();
    writer.lidar_angles(ANGLES).unwrap();
    writer.events_header(&given.header).unwrap();
    for (bytes, arrival) in &given.transfers {
        writer.event_transfer(bytes, *arrival).unwrap();
    }
    for (payload, arrival) in &given.datagrams {
        writer.datagram(payload, *arrival).unwrap();
    }
    for (stamp, rgb8) in &given.images {
        writer.image(*stamp, 6, 4, rgb8).unwrap();
    }
    for (frame, arrival) in &given.can {
        writer.can(*frame, *arrival).unwrap();
    }
    for reading in &given.clocks {
        writer.clock_reading(*reading).unwrap();
    }
    writer
}

pub fn write(dir: &Path, given: &Delivered) -> Counts {
    begin(dir, given).finish().unwrap()
}

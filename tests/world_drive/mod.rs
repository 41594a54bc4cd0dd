//! A synthetic drive as the blocks that ingest threads would hand over, with its exact truth:
//! nothing is rendered, decoded or written.
#![allow(
    dead_code,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::unwrap_used,
    reason = "each test program uses its own part; simulated instants are positive and small"
)]

use noctule::bus::BusError;
use noctule::config::{Config, Grid};
use noctule::frame::{Block, BundleHeader, BundleLayout, BundlePlanesMut};
use noctule::host::{
    Assembler, EdgeMark, EventBlock, ImageBlock, MotionBlock, Outlet, ReturnBlock, Rig, Slot,
};
use noctule::sync::ClockReading;
use noctule_camera::{Encoding, FrameStamp};
use noctule_can::MotionConfig;
use noctule_hesai::{Correction, Model};
use noctule_raster::PackedEvent;
use noctule_recording::{
    CameraMeta, CanMeta, EventsMeta, Generator, GridSize, LidarMeta, Meta, Rectangle, StrobeMeta,
    StrobePolarity,
};
use noctule_sensor::{Evk4, Lidar, Motion, Realtime, Return, Stamp, TriggerEdge};
use noctule_world::{Faults, Rig as WorldRig, Tier, Timeline};

/// Columns and rows of the simulated camera: time is what is tested here.
pub const SIDE: usize = 64;
/// The EVT 3.0 decoder's watermark trails what it has read by this.
const WATERMARK_TRAILS_NS: i64 = 16_000;

/// What a recording of this rig says about itself.
pub fn meta(rig: &WorldRig, seed: u64) -> Meta {
    let (size, grid) = (rig.size as u32, rig.grid as u32);
    let serial = format!("drive-{seed}");
    Meta {
        name: serial.clone(),
        generator: Some(Generator {
            name: "test".to_owned(),
            version: "1".to_owned(),
            seed,
        }),
        split: None,
        steps: 8,
        crop: Rectangle {
            x: 0,
            y: 0,
            width: size,
            height: size,
        },
        network: GridSize {
            width: grid,
            height: grid,
        },
        events: Some(EventsMeta {
            serial: serial.clone(),
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
            serial: serial.clone(),
            width: size,
            height: size,
            encoding: Encoding::Gamma22,
            bit_depth: 8,
        }),
        lidar: Some(LidarMeta {
            serial,
            model: "PandarQT64".to_owned(),
            port: 2368,
        }),
        can: Some(CanMeta {
            interface: "can0".to_owned(),
            motion: MotionConfig::default(),
        }),
    }
}

/// Something that reaches the host.
#[derive(Debug, Clone)]
pub enum Input {
    /// A USB transfer; `end` is the sensor's time at its end.
    Transfer {
        from: Stamp<Evk4>,
        end: Stamp<Evk4>,
        edges: Vec<TriggerEdge>,
    },
    /// A LiDAR packet; `lost_before` as its numbering tells.
    Packet {
        index: u64,
        start: Stamp<Lidar>,
        end: Stamp<Lidar>,
        lost_before: u32,
    },
    /// An image.
    Image { stamp: FrameStamp, lost_before: u32 },
    /// The vehicle moved.
    Motion,
    /// The host's clocks were read.
    Clocks(ClockReading),
}

impl Input {
    /// Which lane it comes through; of equal arrivals the first lane is taken first.
    pub fn lane(&self) -> usize {
        match self {
            Self::Transfer { .. } => 0,
            Self::Packet { .. } => 1,
            Self::Image { .. } => 2,
            Self::Motion | Self::Clocks(_) => 3,
        }
    }
}

/// A drive: truth, and what reaches the host in the order in which the host takes it.
pub struct Drive {
    pub rig: WorldRig,
    pub truth: Timeline,
    pub inputs: Vec<(Stamp<Realtime>, Input)>,
}

impl Drive {
    pub fn new(seed: u64, tier: Tier, faults: &Faults, seconds: f64) -> Self {
        let rig = WorldRig::with_size(seed, tier, SIDE);
        let truth = Timeline::simulate(&rig, faults, seed, seconds);
        let mut inputs = transfers(&truth);
        inputs.extend(packets(&truth));
        inputs.extend(images(&truth));
        inputs.extend(truth.motion.iter().map(|m| (m.arrival, Input::Motion)));
        inputs.extend(truth.readings.iter().map(|r| {
            let reading = ClockReading {
                realtime: r.realtime,
                monotonic: r.monotonic,
                tai_offset_ns: i64::from(r.tai_offset_s) * 1_000_000_000,
            };
            (r.realtime, Input::Clocks(reading))
        }));
        // Stable: a lane's own order is kept.
        inputs.sort_by_key(|(arrival, input)| (*arrival, input.lane()));
        Self { rig, truth, inputs }
    }

    /// The drive's start on the clock of arrivals.
    pub fn start(&self) -> Stamp<Realtime> {
        self.truth.readings[0].realtime
    }

    /// Seconds since the drive's start.
    pub fn second(&self, arrival: Stamp<Realtime>) -> f64 {
        arrival.diff_nanos(self.start()) as f64 * 1e-9
    }

    /// What the host is configured with: the calibration of the rig, a small grid.
    pub fn host_rig(&self, config: &Config) -> Rig {
        let correction = Correction::nominal(Model::Qt64);
        Rig::new(
            config,
            &meta(&self.rig, 0),
            Some(&self.rig.calibration),
            Some(&correction),
        )
        .unwrap()
    }
}

/// Small planes: time is what is tested here.
pub fn config() -> Config {
    let grid = Grid {
        width: 32,
        height: 32,
        ..Grid::default()
    };
    let mut config = Config {
        grid,
        ..Config::default()
    };
    config.lanes.history_events = 1 << 17;
    config
}

fn transfers(truth: &Timeline) -> Vec<(Stamp<Realtime>, Input)> {
    let mut edges = truth.edges.as_slice();
    let mut inputs = Vec::new();
    for transfer in &truth.transfers {
        let (now, later) = edges.split_at(edges.partition_point(|edge| edge.t < transfer.to));
        edges = later;
        if transfer.lost {
            continue;
        }
        let end = transfer.to.offset_nanos(-1000);
        inputs.push((
            transfer.arrival,
            Input::Transfer {
                from: transfer.from,
                end,
                edges: now.to_vec(),
            },
        ));
    }
    inputs
}

/// Duplicates are dropped by the decoder, overtaken packets are not.
fn packets(truth: &Timeline) -> Vec<(Stamp<Realtime>, Input)> {
    let mut next = 0;
    let mut seen = std::collections::HashSet::new();
    let mut inputs = Vec::new();
    for packet in truth.packets.iter().filter(|p| seen.insert(p.index)) {
        let lost_before = packet.index.saturating_sub(next) as u32;
        next = next.max(packet.index + 1);
        let (index, start, end) = (packet.index, packet.start, packet.last_fire);
        inputs.push((
            packet.arrival,
            Input::Packet {
                index,
                start,
                end,
                lost_before,
            },
        ));
    }
    inputs
}

fn images(truth: &Timeline) -> impl Iterator<Item = (Stamp<Realtime>, Input)> {
    let mut next = 0;
    truth.images.iter().map(move |image| {
        let lost_before = image.stamp.sequence.saturating_sub(next);
        next = image.stamp.sequence + 1;
        (
            image.stamp.arrival,
            Input::Image {
                stamp: image.stamp,
                lost_before,
            },
        )
    })
}

/// Deterministic noise of a number.
pub fn mix(n: u64) -> u64 {
    let n = (n ^ (n >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let n = (n ^ (n >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    n ^ (n >> 31)
}

/// How full the blocks are.
#[derive(Debug, Clone, Copy, Default)]
pub struct Load {
    pub events_per_transfer: u64,
    pub returns_per_packet: u64,
}

/// Writes inputs into blocks as ingest does.
#[derive(Debug, Default)]
pub struct Filler {
    pub load: Load,
    lidar_newest: Option<Stamp<Lidar>>,
}

impl Filler {
    pub fn new(load: Load) -> Self {
        Self {
            load,
            lidar_newest: None,
        }
    }

    /// The part `[part / parts, (part + 1) / parts)` of a transfer.
    pub fn events(
        &self,
        (arrival, input): (Stamp<Realtime>, &Input),
        (part, parts): (u64, u64),
        block: &mut EventBlock,
    ) {
        let Input::Transfer { from, end, edges } = input else {
            unreachable!("not a transfer")
        };
        block.clear();
        block.arrival = arrival;
        block.received_ns = arrival.as_nanos();
        let span = end.diff_nanos(*from).max(0) as u64;
        let at = |n: u64| Stamp::<Evk4>::from_nanos(from.as_nanos() + span * n / parts);
        let (begin, until) = (
            at(part),
            if part + 1 == parts {
                end.offset_nanos(1)
            } else {
                at(part + 1)
            },
        );
        for n in 0..self.load.events_per_transfer {
            let t = from.as_nanos() + span * n / self.load.events_per_transfer;
            let t = Stamp::<Evk4>::from_micros(t / 1000);
            if t < begin || t >= until {
                continue;
            }
            let noise = mix(t.as_nanos() ^ n);
            let (x, y) = (608 + (noise % 64) as u16, 328 + (noise >> 8) as u16 % 64);
            block
                .events
                .push(PackedEvent::new(t.as_micros() as u32, x, y, noise >> 63 == 1).unwrap());
        }
        for &edge in edges.iter().filter(|e| (begin..until).contains(&e.t)) {
            let after = |e: &PackedEvent| u64::from(e.t_us) <= edge.t.as_micros() & 0xffff_ffff;
            let events_before = block.events.partition_point(after);
            block.edges.push(EdgeMark {
                events_before,
                edge,
            });
        }
        let reached = if part + 1 == parts {
            *end
        } else {
            begin.max(until.offset_nanos(-1000))
        };
        block.watermark = Some(reached.offset_nanos(-WATERMARK_TRAILS_NS));
        block.newest = Some(reached);
        block.ends_transfer = part + 1 == parts;
    }

    pub fn returns(
        &mut self,
        (arrival, input): (Stamp<Realtime>, &Input),
        block: &mut ReturnBlock,
    ) {
        let Input::Packet {
            index,
            start,
            end,
            lost_before,
        } = *input
        else {
            unreachable!("not a packet")
        };
        block.arrival = arrival;
        block.received_ns = arrival.as_nanos();
        block.start = start;
        block.end = end;
        block.lost_before = lost_before;
        block.azimuth_cdeg = ((index % 300 * 120 + 18_000) % 36_000) as u32;
        block.sweep = (index / 300) as u32;
        // A clock that stepped back starts afresh, as the decoder does.
        let newest = self
            .lidar_newest
            .filter(|n| n.diff_nanos(start) < 100_000_000);
        self.lidar_newest = Some(newest.map_or(start, |n| n.max(start)));
        block.watermark = self.lidar_newest;
        block.clock_jumped = false;
        block.returns.clear();
        for n in 0..self.load.returns_per_packet {
            let noise = mix(index << 20 ^ n);
            let angle = f64::from(block.azimuth_cdeg).to_radians() / 100.0;
            let range = 2.0 + (noise % 4000) as f64 / 100.0;
            block.returns.push(Return {
                t: start.offset_nanos((n * 2000) as i64),
                x_m: (range * angle.sin()) as f32,
                y_m: (range * angle.cos()) as f32,
                z_m: ((noise >> 20) % 400) as f32 / 100.0 - 2.0,
                azimuth_cdeg: block.azimuth_cdeg as u16,
                // Lasers near the horizon: those the camera sees.
                channel: (24 + n % 16) as u8,
                intensity: 9,
                block: 0,
            });
        }
    }

    pub fn image((arrival, input): (Stamp<Realtime>, &Input), block: &mut ImageBlock) {
        let Input::Image { stamp, lost_before } = *input else {
            unreachable!("not an image")
        };
        block.stamp = FrameStamp { arrival, ..stamp };
        block.received_ns = arrival.as_nanos();
        block.lost_before = lost_before;
        for (n, value) in block.rgb.iter_mut().enumerate().step_by(97) {
            *value = mix(u64::from(stamp.sequence) << 32 ^ n as u64) as u8;
        }
    }

    pub fn motion((arrival, input): (Stamp<Realtime>, &Input)) -> MotionBlock {
        match *input {
            Input::Clocks(reading) => MotionBlock::Clocks { reading },
            _ => {
                let motion = Motion {
                    t: arrival,
                    speed_mps: 12.0,
                    yaw_rate_rps: 0.05,
                };
                MotionBlock::Motion { motion }
            }
        }
    }
}

/// Plain memory in place of the bus: keeps headers, and what each payload hashes to.
pub struct Memory {
    layout: BundleLayout,
    pub sent: Vec<(BundleHeader, u64)>,
}

pub struct Plain(Vec<Block>);

impl Slot for Plain {
    fn planes(&mut self, layout: &BundleLayout) -> Option<BundlePlanesMut<'_>> {
        layout.planes_mut(&mut self.0).ok()
    }
}

impl Memory {
    pub fn new(layout: BundleLayout) -> Self {
        Self {
            layout,
            sent: Vec::new(),
        }
    }
}

impl Outlet for Memory {
    type Slot = Plain;

    fn lend(&mut self) -> Option<Plain> {
        Some(Plain(vec![Block::ZERO; self.layout.blocks()]))
    }

    fn send(&mut self, slot: Plain, header: BundleHeader) -> Result<BundleHeader, BusError> {
        let words = slot.0.iter().flat_map(|block| block.lanes);
        let hash = words.fold(7, |hash, lane| mix(hash ^ u64::from(lane.to_bits())));
        self.sent.push((header.without_stages(), hash));
        Ok(header)
    }

    fn now_ns(&self) -> u64 {
        1
    }
}

/// Drives an assembler with the inputs in order; `look` is shown it after each.
pub fn run(
    drive: &Drive,
    load: Load,
    mut look: impl FnMut(&Assembler<Memory>, Stamp<Realtime>, &Input),
) -> Assembler<Memory> {
    let rig = drive.host_rig(&config());
    let mut assembler = Assembler::new(&rig, Memory::new(rig.layout)).unwrap();
    let mut filler = Filler::new(load);
    let (mut events, mut returns) = (EventBlock::new(), ReturnBlock::new());
    let mut images = vec![];
    let mut now = Stamp::ZERO;
    for (arrival, input) in &drive.inputs {
        now = now.max(*arrival);
        let at = (*arrival, input);
        match input.lane() {
            0 => {
                filler.events(at, (0, 1), &mut events);
                assembler.events(&events).unwrap();
            }
            1 => {
                filler.returns(at, &mut returns);
                assembler.returns(&returns).unwrap();
            }
            2 => {
                let mut image = images
                    .pop()
                    .unwrap_or_else(|| Box::new(ImageBlock::new(SIDE * SIDE * 3)));
                Filler::image(at, &mut image);
                assembler.image(image).unwrap();
            }
            _ => assembler.motion(&Filler::motion(at)).unwrap(),
        }
        images.extend(std::iter::from_fn(|| assembler.take_returned()));
        look(&assembler, *arrival, input);
    }
    assembler.finish(now).unwrap();
    assembler
}

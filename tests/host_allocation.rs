//! Nothing on the host's path allocates once it runs: every allocation of its threads is counted
//! while all streams of a rough ride go through it, sensors restarting and rubbish included.
//!
//! Reading and decoding pictures stands in for the camera's own work and runs on a thread of its
//! own, which is counted beside the others and not held to it. The transport keeps one reference
//! count per loan on the heap: that one is counted apart, and held to one.
#![allow(
    clippy::cast_possible_truncation,
    clippy::print_stdout,
    clippy::unwrap_used,
    reason = "simulated instants are positive and small; a test may stop where it stands"
)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::{Barrier, Mutex};
use std::thread;
use std::time::Duration;

use noctule::bus::{BusError, Instance, Ipc, Limits, Loan, Owner, Ports};
use noctule::config::{Config, Grid};
use noctule::frame::BundleHeader;
use noctule::host::{
    Assembler, BundleReport, BusOutlet, EventBlock, ImageBlock, Lanes, MotionBlock, Outlet,
    ReturnBlock, Rig,
};
use noctule::ingest::{self, Flow, Ingested, Pace, Pacer};
use noctule::lane::{WhenFull, lane};
use noctule::latency::monotonic_ns;
use noctule::sync::TimelineCounts;
use noctule_can::{Frame, Id, MotionConfig, MotionEncoder};
use noctule_evk4::{Evt3Encoder, Format, Geometry, RawHeader};
use noctule_hesai::{Correction, Model, Options, Qt64Echoes, Qt64Encoder, ReturnMode};
use noctule_recording::{Recording, RecordingWriter};
use noctule_sensor::{Event, Evk4, Lidar, Stamp, TriggerEdge};
use noctule_world::{DRIVE_START_TAI, Faults, Rig as WorldRig, Tier, Timeline};

mod world_drive;
use world_drive::{meta, mix};

/// Roles of threads, as indices of the counts.
const ROLES: [&str; 7] = [
    "others",
    "merge",
    "events",
    "lidar",
    "motion",
    "camera",
    "transport",
];
const MERGE: usize = 1;
const EVENTS: usize = 2;
const LIDAR: usize = 3;
const MOTION: usize = 4;
const CAMERA: usize = 5;
/// The merging thread while it is inside the transport's own loan and send.
const TRANSPORT: usize = 6;
const HOT: [usize; 4] = [MERGE, EVENTS, LIDAR, MOTION];

thread_local! {
    static ROLE: Cell<usize> = const { Cell::new(0) };
}

/// Whether the host is past its start-up.
static IS_RUNNING: AtomicBool = AtomicBool::new(false);
static STARTING: [AtomicU64; 7] = [const { AtomicU64::new(0) }; 7];
static RUNNING: [AtomicU64; 7] = [const { AtomicU64::new(0) }; 7];
/// Where the first allocations of hot threads came from, for whoever has to find them.
static PLACES: Mutex<Vec<String>> = Mutex::new(Vec::new());

struct Counting;

fn count() {
    // A thread that is ending has no role left, and nothing to count.
    let role = ROLE.try_with(Cell::get).unwrap_or(0);
    if role == 0 {
        return;
    }
    if !IS_RUNNING.load(Relaxed) {
        STARTING[role].fetch_add(1, Relaxed);
        return;
    }
    if RUNNING[role].fetch_add(1, Relaxed) < 2 && HOT.contains(&role) {
        ROLE.set(0);
        let place = std::backtrace::Backtrace::force_capture().to_string();
        PLACES
            .lock()
            .unwrap()
            .push(format!("{}:\n{place}", ROLES[role]));
        ROLE.set(role);
    }
}

// SAFETY: every call is handed on to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's promises are passed on.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        // SAFETY: the caller's promises are passed on.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

const SEED: u64 = 220_001;
/// Length of the drive, and the part of it that is counted: every lane holds less than what is
/// left at either end, so no thread starts or ends meanwhile.
const SECONDS: f64 = 13.0;
const COUNTED_NS: std::ops::Range<i64> = 1_000_000_000..11_000_000_000;
/// When the event camera's counter falls back, and by how much.
const COUNTER_RESTART: (i64, u64) = (6_000_000_000, 3_000_000);
/// When the LiDAR's clock is set ahead, and by how much.
const LIDAR_STEP: (i64, i64) = (8_000_000_000, 400_000_000);

fn world() -> (WorldRig, Timeline) {
    let rig = WorldRig::with_size(SEED, Tier::B, 256);
    let faults = Faults {
        transfer_lost: 0.002,
        ..Faults::rough()
    };
    let timeline = Timeline::simulate(&rig, &faults, SEED, SECONDS);
    (rig, timeline)
}

/// Writes a recording of the drive with made-up contents.
fn record(dir: &Path) {
    let (rig, timeline) = world();
    let mut recording = RecordingWriter::create(dir, meta(&rig, SEED), &rig.calibration).unwrap();
    for &reading in &timeline.readings {
        recording.clock_reading(reading).unwrap();
    }
    record_events(&rig, &timeline, &mut recording);
    record_packets(&rig, &timeline, &mut recording);
    let mut picture = vec![0; rig.size * rig.size * 3];
    for image in &timeline.images {
        picture
            .iter_mut()
            .enumerate()
            .step_by(7)
            .for_each(|(n, v)| *v = mix(n as u64) as u8);
        recording
            .image(image.stamp, rig.size, rig.size, &picture)
            .unwrap();
    }
    let encoder = MotionEncoder::new(&MotionConfig::default()).unwrap();
    let stranger = Frame::data(Id::standard(0x7fe).unwrap(), &[1, 2, 3]).unwrap();
    for timed in &timeline.motion {
        let (first, second) = encoder.encode(12.0, 0.1).unwrap();
        let cut = Frame::data(first.id(), &[]).unwrap();
        for frame in [Some(first), second, Some(stranger), Some(cut)]
            .into_iter()
            .flatten()
        {
            recording.can(frame, timed.arrival).unwrap();
        }
    }
    recording.finish().unwrap();
}

/// Noise with bursts of more than a block, reserved words, and a counter that falls back.
fn record_events(rig: &WorldRig, timeline: &Timeline, recording: &mut RecordingWriter) {
    const RESERVED: [u8; 2] = [0x00, 0xb0];
    let geometry = Geometry {
        width: 1280,
        height: 720,
    };
    recording
        .events_header(&RawHeader::new(Format::Evt3, geometry).to_bytes())
        .unwrap();
    let restart = rig
        .clocks
        .evk4
        .inverse()
        .apply(DRIVE_START_TAI.offset_nanos(COUNTER_RESTART.0));
    let shown = |t: Stamp<Evk4>| {
        Stamp::from_micros(t.as_micros() - if t < restart { 0 } else { COUNTER_RESTART.1 })
    };
    let mut encoder = Evt3Encoder::starting_at(timeline.transfers[0].from);
    let (mut edges, mut bytes) = (timeline.edges.as_slice(), Vec::new());
    let mut is_restarted = false;
    for (index, transfer) in timeline.transfers.iter().enumerate() {
        if !is_restarted && transfer.from >= restart {
            encoder = Evt3Encoder::starting_at(shown(transfer.from));
            is_restarted = true;
        }
        let events = if index % 100 == 50 { 40_000 } else { 300 };
        let span = transfer.to.as_micros() - transfer.from.as_micros();
        for n in 0..events {
            let t = Stamp::from_micros(transfer.from.as_micros() + span * n / events);
            while let Some((&edge, rest)) = edges.split_first()
                && edge.t <= t
            {
                // Of a transfer on the edge of the restart nothing is sent twice.
                let _ = encoder.trigger(
                    TriggerEdge {
                        t: shown(edge.t),
                        ..edge
                    },
                    &mut bytes,
                );
                edges = rest;
            }
            let noise = mix(n << 24 ^ index as u64);
            let (x, y) = (512 + (noise % 256) as u16, 232 + (noise >> 8) as u16 % 256);
            let event = Event {
                t: shown(t),
                x,
                y,
                on: noise >> 63 == 1,
            };
            let _ = encoder.event(event, &mut bytes);
        }
        encoder.flush(&mut bytes);
        if index % 500 == 7 {
            bytes.extend(RESERVED);
        }
        if !transfer.lost {
            recording.event_transfer(&bytes, transfer.arrival).unwrap();
        }
        bytes.clear();
    }
}

/// A wall all around, a clock that is set ahead, and datagrams that are none of the sensor's.
fn record_packets(rig: &WorldRig, timeline: &Timeline, recording: &mut RecordingWriter) {
    let step = rig
        .clocks
        .lidar
        .inverse()
        .apply(DRIVE_START_TAI.offset_nanos(LIDAR_STEP.0));
    let mut encoder = Qt64Encoder::new(ReturnMode::FirstLast, 600, 0).unwrap();
    let last = timeline.packets.iter().map(|p| p.index).max().unwrap();
    let packets: Vec<_> = (0..=last)
        .map(|index| {
            let start: Stamp<Lidar> = timeline
                .lidar_start
                .offset_nanos((index * 1_000_000 / 3_000 * 1000) as i64);
            let start = start.offset_nanos(if start < step { 0 } else { LIDAR_STEP.1 });
            let firing = |n: u64| {
                let mut echoes = Qt64Echoes::NONE;
                (0..64).for_each(|c| {
                    echoes.set(c, 5.0 + (mix(index ^ c as u64) % 100) as f32 / 10.0, 9)
                });
                (((index * 2 + n) % 600 * 60) as u16, [echoes, echoes])
            };
            encoder.dual(start, &[firing(0), firing(1)]).unwrap()
        })
        .collect();
    for (n, packet) in timeline.packets.iter().enumerate() {
        recording
            .datagram(&packets[packet.index as usize], packet.arrival)
            .unwrap();
        if n % 500 == 3 {
            recording.datagram(&[0xee; 10], packet.arrival).unwrap();
            recording.datagram(&[0; 1072], packet.arrival).unwrap();
        }
    }
}

/// The bus, telling when the counted part of the drive begins and ends.
struct Watched {
    outlet: BusOutlet<Ipc>,
    /// Allocates with every bundle: to see that it is seen.
    allocates: bool,
    counted: u64,
    loans: u64,
}

fn in_role<R>(role: usize, work: impl FnOnce() -> R) -> R {
    let before = ROLE.replace(role);
    let result = work();
    ROLE.set(before);
    result
}

impl Outlet for Watched {
    type Slot = Loan<Ipc, BundleHeader>;

    fn lend(&mut self) -> Option<Self::Slot> {
        self.loans += u64::from(IS_RUNNING.load(Relaxed));
        in_role(TRANSPORT, || self.outlet.lend())
    }

    fn send(&mut self, slot: Self::Slot, header: BundleHeader) -> Result<BundleHeader, BusError> {
        let at = Stamp::<noctule_sensor::Tai>::from_nanos(header.close_tai_ns);
        let is_counted = COUNTED_NS.contains(&at.diff_nanos(DRIVE_START_TAI));
        IS_RUNNING.store(is_counted, Relaxed);
        self.counted += u64::from(is_counted);
        if self.allocates {
            drop(std::hint::black_box(Vec::<u8>::with_capacity(1)));
        }
        in_role(TRANSPORT, || self.outlet.send(slot, header))
    }

    fn now_ns(&self) -> u64 {
        self.outlet.now_ns()
    }
}

/// What a run of the host came to.
struct Outcome {
    starting: [u64; 7],
    running: [u64; 7],
    counted: u64,
    loans: u64,
    bundles: BundleReport,
    clocks: TimelineCounts,
    ingested: Vec<Ingested>,
    received: u64,
}

fn config() -> Config {
    let mut config = Config {
        grid: Grid {
            width: 128,
            height: 128,
            ..Grid::default()
        },
        ..Config::default()
    };
    config.lanes.motion = 64;
    config
}

/// Runs the whole host over the recording, a receiver at its other end.
fn host(dir: &Path, allocates: bool) -> Outcome {
    let config = config();
    let recording = Recording::open(dir).unwrap();
    let correction = Correction::nominal(Model::Qt64);
    let calibration = recording.calibration();
    let rig = Rig::new(&config, recording.meta(), calibration, Some(&correction)).unwrap();
    noctule::bus::silence_transport_log();
    let name = format!("test-alloc-{}-{allocates}", std::process::id());
    let (instance, limits) = (Instance::new(name.parse().unwrap()), config.limits());
    let owner = Owner::<Ipc>::create(instance.clone(), limits).unwrap();
    let outlet = BusOutlet::new(owner.ports().bundle_sender().unwrap());
    let mut assembler = Assembler::new(
        &rig,
        Watched {
            outlet,
            allocates,
            counted: 0,
            loans: 0,
        },
    )
    .unwrap();
    for count in STARTING.iter().chain(&RUNNING) {
        count.store(0, Relaxed);
    }
    PLACES.lock().unwrap().clear();
    let (is_over, is_open) = (AtomicBool::new(false), Barrier::new(2));
    let (ingested, received) = thread::scope(|scope| {
        let receiver = scope.spawn(|| receive(&instance, limits, &is_open, &is_over));
        // A receiver that comes later makes the transport allocate when it is connected to.
        is_open.wait();
        let ingested = ingest_and_merge(&recording, &config, &mut assembler);
        is_over.store(true, Relaxed);
        (ingested, receiver.join().unwrap())
    });
    IS_RUNNING.store(false, Relaxed);
    let load = |counts: &[AtomicU64; 7]| counts.each_ref().map(|n| n.load(Relaxed));
    Outcome {
        starting: load(&STARTING),
        running: load(&RUNNING),
        counted: assembler.outlet().counted,
        loans: assembler.outlet().loans,
        bundles: assembler.bundle_report(),
        clocks: assembler.timeline().counts(),
        ingested,
        received,
    }
}

/// The host's threads, each under its role; this one merges.
fn ingest_and_merge(
    recording: &Recording,
    config: &Config,
    assembler: &mut Assembler<Watched>,
) -> Vec<Ingested> {
    let stop = &AtomicBool::new(false);
    let pacer = Pacer::new(Pace::Max, Stamp::ZERO, monotonic_ns());
    let flow = Flow {
        pacer,
        when_full: WhenFull::Wait,
        piece_bytes: None,
        stop,
    };
    let (me, sizes) = (thread::current(), &config.lanes);
    let bytes = 256 * 256 * 3;
    let reading = noctule::sync::ClockReading {
        realtime: Stamp::ZERO,
        monotonic: Stamp::ZERO,
        tai_offset_ns: 0,
    };
    let (to_events, events) = lane(sizes.event_blocks, me.clone(), EventBlock::new);
    let (to_lidar, lidar) = lane(sizes.lidar_packets, me.clone(), ReturnBlock::new);
    let (to_images, images) = lane(sizes.images, me.clone(), || ImageBlock::new(bytes));
    let (to_motion, motion) = lane(sizes.motion, me, || MotionBlock::Clocks { reading });
    let lanes = Lanes {
        events: Some(events),
        lidar: Some(lidar),
        images: Some(images),
        motion: Some(motion),
    };
    let (transfers, datagrams) = (
        recording.event_transfers().unwrap(),
        recording.datagrams().unwrap(),
    );
    thread::scope(|scope| {
        let handles = [
            scope.spawn(move || {
                ROLE.set(EVENTS);
                ingest::run_events(transfers, to_events, flow)
            }),
            scope.spawn(move || {
                ROLE.set(LIDAR);
                ingest::run_lidar(datagrams, Options::new(Model::Qt64), to_lidar, flow)
            }),
            scope.spawn(move || {
                ROLE.set(CAMERA);
                ingest::run_camera(recording, to_images, flow)
            }),
            scope.spawn(move || {
                ROLE.set(MOTION);
                ingest::run_motion(recording, &config.can, to_motion, flow)
            }),
        ];
        ROLE.set(MERGE);
        let merged = noctule::host::run(assembler, lanes, stop);
        ROLE.set(0);
        merged.unwrap();
        handles.map(|handle| handle.join().unwrap().unwrap()).into()
    })
}

fn receive(instance: &Instance, limits: Limits, is_open: &Barrier, is_over: &AtomicBool) -> u64 {
    let ports = Ports::<Ipc>::open(instance.clone(), "receiver", limits).unwrap();
    let receiver = ports.bundle_receiver().unwrap();
    is_open.wait();
    while !is_over.load(Relaxed) {
        receiver.wait(Duration::from_millis(10)).unwrap();
        while receiver.receive().unwrap().is_some() {}
    }
    receiver.received()
}

fn detail(outcome: &Outcome, stream: &str, name: &str) -> u64 {
    let ingested = outcome
        .ingested
        .iter()
        .find(|i| i.row.stream == stream)
        .unwrap();
    ingested
        .details
        .iter()
        .find(|(known, _)| *known == name)
        .map_or(0, |(_, count)| *count)
}

#[test]
fn a_rough_ride_allocates_nothing_and_what_allocates_is_seen() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("drive");
    record(&dir);
    let calm = host(&dir, false);
    println!(
        "bundles counted {} of {:?}, received {}",
        calm.counted, calm.bundles, calm.received
    );
    for (role, name) in ROLES.iter().enumerate().skip(1) {
        println!(
            "{name:<9} starting {:>6}, running {:>6}",
            calm.starting[role], calm.running[role]
        );
    }
    // The ride was as rough as it should be, and all of it was taken in.
    for row in calm.ingested.iter().map(|i| &i.row) {
        println!("{row:?}");
        assert_eq!(row.shed, 0, "{row:?}");
        assert!(row.received > 40, "{row:?}");
    }
    assert!(calm.counted >= 40, "{}", calm.counted);
    assert!(calm.received > 0);
    assert!(
        calm.bundles.images_matched > 30 && calm.bundles.edges_repaired > 0,
        "{:?}",
        calm.bundles
    );
    assert_eq!(
        calm.clocks.evk4.steps + calm.clocks.evk4.backwards,
        1,
        "{:?}",
        calm.clocks
    );
    assert_eq!(
        calm.clocks.lidar.steps + calm.clocks.lidar.backwards,
        1,
        "{:?}",
        calm.clocks
    );
    assert!(
        detail(&calm, "events", "reserved_word") > 20 && detail(&calm, "lidar", "duplicate") > 20
    );
    assert!(detail(&calm, "lidar", "late") > 20 && detail(&calm, "motion", "unknown") > 1000);
    // The counter sees each of these threads: they allocated when they started, and the merging
    // one when it is made to.
    for role in [EVENTS, LIDAR, MOTION] {
        assert!(calm.starting[role] > 0, "{} was not watched", ROLES[role]);
    }
    let places = PLACES.lock().unwrap().join("\n");
    for role in HOT {
        assert_eq!(
            calm.running[role], 0,
            "{} allocates:\n{places}",
            ROLES[role]
        );
    }
    assert!(
        calm.running[TRANSPORT] <= calm.loans,
        "{} for {} loans",
        calm.running[TRANSPORT],
        calm.loans
    );
    let spoilt = host(&dir, true);
    assert!(
        spoilt.running[MERGE] >= spoilt.counted && spoilt.counted >= 40,
        "{:?}",
        spoilt.running
    );
}

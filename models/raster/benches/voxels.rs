//! What rastering costs on one core, beside a copy of the same bytes in the same run.
//!
//! `cargo bench -p noctule-raster`; the fastest of repeated runs, warm memory. The promise: where the
//! close was predicted, finishing the voxels takes no longer than copying the bundle they go into.
#![allow(clippy::print_stdout, reason = "a benchmark prints")]
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "made-up input"
)]

use std::hint::black_box;
use std::time::{Duration, Instant};

use nalgebra::{Isometry3, Rotation3, Translation3, Vector3};

use noctule_raster::{
    Channel, Crop, Distortion, EgoPolicy, EventHistory, Exposure, FinishReport, Grid, ImagePlanes,
    ImageView, PackedEvent, Pinhole, PixelMap, RasterError, Rescale, Samples, SparseConfig,
    SparseRaster, VoxelRaster,
};
use noctule_sensor::{Return, Stamp, Tai};

const STEPS: usize = 8;
const WIDTH_US: u64 = 100_000;
const REPEATS: usize = 40;

/// Splitmix64: the same events on every machine.
fn random(state: &mut u64) -> u64 {
    *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let mut z = *state;
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Events in order of time, spread evenly over the region of interest: the worst case for caches.
fn events(count: usize) -> Vec<PackedEvent> {
    let mut state = 7;
    let mut times: Vec<u32> = (0..count)
        .map(|_| (random(&mut state) % WIDTH_US) as u32)
        .collect();
    times.sort_unstable();
    let pack = |t_us: u32| {
        let word = random(&mut state);
        let (x, y) = (384 + (word & 511) as u16, 104 + (word >> 9 & 511) as u16);
        PackedEvent::new(t_us, x, y, word >> 20 & 1 == 1).expect("inside 11 bits")
    };
    times.into_iter().map(pack).collect()
}

fn fastest_ns(mut run: impl FnMut() -> u128) -> f64 {
    run();
    (0..REPEATS).map(|_| run()).min().unwrap_or(0) as f64
}

fn exposure(width_us: u64) -> Exposure {
    Exposure::from_micros(0, width_us).expect("a sound exposure")
}

struct Rig {
    raster: VoxelRaster,
    history: EventHistory,
    out: Vec<f32>,
    events: Vec<PackedEvent>,
}

impl Rig {
    fn new(map: PixelMap, count: usize) -> Result<Self, RasterError> {
        let raster = VoxelRaster::new(STEPS, map)?;
        let out = vec![0.0; raster.shape().len()];
        Ok(Self {
            raster,
            history: EventHistory::new(count)?,
            out,
            events: events(count),
        })
    }

    /// One exposure; nanoseconds of (begin, push, finish).
    fn expose(&mut self, predicted_us: u64, true_us: u64) -> ([u128; 3], FinishReport) {
        let first = self.history.next();
        let start = Instant::now();
        self.raster.begin(exposure(predicted_us), first);
        let begun = start.elapsed().as_nanos();
        let start = Instant::now();
        for chunk in self.events.chunks(4096) {
            self.history.extend(chunk);
            self.raster
                .advance(&self.history, &mut self.out)
                .expect("begun");
        }
        let pushed = start.elapsed().as_nanos();
        let start = Instant::now();
        let report = self
            .raster
            .finish(exposure(true_us), &self.history, &mut self.out);
        let finished = start.elapsed().as_nanos();
        black_box(&self.out);
        ([begun, pushed, finished], report.expect("begun"))
    }

    fn phase(&mut self, predicted_us: u64, true_us: u64, phase: usize) -> f64 {
        fastest_ns(|| self.expose(predicted_us, true_us).0[phase])
    }
}

fn report(name: &str, map: PixelMap, count: usize, copy_ns: f64) -> Result<(), RasterError> {
    let mut rig = Rig::new(map, count)?;
    let n = count as f64;
    println!("{name}: {count} events in {WIDTH_US} us");
    let push = rig.phase(WIDTH_US, WIDTH_US, 1) / n;
    println!(
        "  begin (at the opening)  {:8.3} ms",
        rig.phase(WIDTH_US, WIDTH_US, 0) / 1e6
    );
    println!(
        "  push                    {push:8.2} ns/event = {:.0} Mev/s",
        1e3 / push
    );
    let exact = rig.phase(WIDTH_US, WIDTH_US, 2);
    println!(
        "  finish, exact           {:8.3} ms = {:.2} copies",
        exact / 1e6,
        exact / copy_ns
    );
    for off in [1, 2, 5, 10] {
        let finish = rig.phase(WIDTH_US - off, WIDTH_US, 2);
        let retimed = rig.expose(WIDTH_US - off, WIDTH_US).1.retimed;
        let (ms, copies) = (finish / 1e6, finish / copy_ns);
        let walk = (finish - exact) / n;
        println!(
            "  finish, {off:3} us off      {ms:8.3} ms = {copies:.2} copies; walk {walk:.2} ns/event, {retimed:?}"
        );
    }
    let full = rig.phase(WIDTH_US - 5000, WIDTH_US, 2);
    println!(
        "  finish, full            {:8.3} ms = {:.2} ns/event",
        full / 1e6,
        full / n
    );
    Ok(())
}

fn images(copy_ns: f64) -> Result<(), RasterError> {
    let sensor = Grid::new(512, 512);
    let planes = ImagePlanes::new(Rescale::new(sensor, sensor.whole(), Grid::new(256, 256))?);
    let data: Vec<u8> = (0..512 * 512 * 3)
        .map(|i| (i * 7 + i / 512) as u8)
        .collect();
    let view = ImageView {
        data: &data,
        size: sensor,
        stride_bytes: 1536,
        samples: Samples::U8,
    };
    let mut out = vec![0.0; planes.planes_len()];
    let ns = fastest_ns(|| {
        let start = Instant::now();
        planes.write(&view, &mut out).expect("the right size");
        black_box(&out);
        start.elapsed().as_nanos()
    });
    println!(
        "image 512x512 -> 256x256: {:.3} ms = {:.2} copies",
        ns / 1e6,
        ns / copy_ns
    );
    Ok(())
}

/// A wall all round, 64 channels, two echoes each: the densest pass there can be.
fn sparse(copy_ns: f64) -> Result<(), RasterError> {
    let axes = Rotation3::from_axis_angle(&Vector3::x_axis(), std::f64::consts::FRAC_PI_2);
    let channel = |c: usize| Channel {
        elevation_deg: c as f64 * 1.6 - 50.4,
        azimuth_offset_deg: 0.0,
    };
    let mut raster = SparseRaster::new(&SparseConfig {
        camera: Pinhole::new(262.0, 262.0, 127.5, 127.5, Distortion::default())?,
        grid: Grid::new(256, 256),
        camera_from_lidar: Isometry3::from_parts(Translation3::new(0.0, -0.25, -0.1), axes.into()),
        lidar_from_vehicle: Isometry3::identity(),
        channels: (0..64).map(channel).collect(),
        rotation: Duration::from_millis(100),
        passes: 4,
        points_max: 20_000,
        range_min_m: 2.0,
        margin_deg: 8.0,
        motion_samples: 400,
        motion_reach: Duration::from_millis(50),
    })?;
    let start = Stamp::<Tai>::from_nanos(1 << 60);
    for k in 0..40 {
        raster.push_motion(start.offset_nanos(k * 10_000_000), 12.0, 0.2)?;
    }
    let mut pushed = 0u32;
    let begun = Instant::now();
    for k in 0..2000i64 {
        let azimuth_cdeg = (k * 60 % 36_000) as u16;
        let (sin, cos) = (f32::from(azimuth_cdeg) * 0.01).to_radians().sin_cos();
        for c in (0..64u8).chain(0..64) {
            let at = start.offset_nanos(k * 166_666 + i64::from(c) * 2100);
            let z_m = 10.0 * (f32::from(c) * 1.6 - 50.4).to_radians().tan();
            let (t, x_m, y_m, channel) = (Stamp::ZERO, 10.0 * sin, 10.0 * cos, c);
            let (intensity, block) = (9, 0);
            raster.push_return(
                at,
                &Return {
                    t,
                    x_m,
                    y_m,
                    z_m,
                    azimuth_cdeg,
                    channel,
                    intensity,
                    block,
                },
            );
            pushed += 1;
        }
    }
    let push_ns = begun.elapsed().as_nanos() as f64 / f64::from(pushed);
    let mut out = vec![0.0; raster.map_len()];
    let centre = start.offset_nanos(333_000_000);
    let mut returns = 0;
    let ns = fastest_ns(|| {
        let begun = Instant::now();
        let report = raster
            .draw(centre, EgoPolicy::Compensate, &mut out)
            .expect("covered");
        black_box(&out);
        returns = report.returns;
        begun.elapsed().as_nanos()
    });
    println!(
        "sparse depth: {push_ns:.1} ns/return pushed; a step of {returns} returns {:.3} ms, eight = {:.2} copies",
        ns / 1e6,
        8.0 * ns / copy_ns
    );
    Ok(())
}

fn main() -> Result<(), RasterError> {
    let grid = Grid::new(256, 256);
    let cells = grid.cells();
    let bundle = (STEPS * 5 + STEPS + 3) * cells;
    let (source, mut target) = (vec![1.0f32; bundle], vec![0.0f32; bundle]);
    let copy_ns = fastest_ns(|| {
        let start = Instant::now();
        target.copy_from_slice(&source);
        black_box(&target);
        start.elapsed().as_nanos()
    });
    println!(
        "copy of a bundle, {:.1} MB, warm: {:.3} ms",
        bundle as f64 * 4e-6,
        copy_ns / 1e6
    );
    let crop = Crop {
        x: 384,
        y: 104,
        width: 512,
        height: 512,
    };
    let rescale = Rescale::new(Grid::new(1280, 720), crop, grid)?;
    let table = (0..720u16).flat_map(|y| (0..1280u16).map(move |x| (x, y)));
    let axes = PixelMap::rescaled(&rescale);
    let cell = |(x, y)| {
        axes.cell(x, y)
            .map_or(noctule_raster::OUTSIDE, |cell| cell as u32)
    };
    let table = PixelMap::remapped(Grid::new(1280, 720), table.map(cell).collect(), grid)?;
    report("crop and rescale", axes.clone(), 1_000_000, copy_ns)?;
    report("crop and rescale", axes, 7_000_000, copy_ns)?;
    report("remap table", table, 7_000_000, copy_ns)?;
    images(copy_ns)?;
    sparse(copy_ns)
}

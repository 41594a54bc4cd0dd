//! Nothing allocates once it is built: counted by the allocator itself.
#![allow(clippy::unwrap_used, reason = "a test may panic")]
#![allow(clippy::cast_possible_truncation, reason = "test arithmetic")]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::time::Duration;

use nalgebra::Isometry3;
use noctule_raster::{
    Channel, Distortion, EgoPolicy, EventHistory, Exposure, Grid, ImagePlanes, ImageView,
    PackedEvent, Pinhole, PixelMap, Rescale, Samples, SparseConfig, SparseRaster, VoxelRaster,
};
use noctule_sensor::{Return, Stamp};

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

struct Counting;

// SAFETY: hands every call on to the system's allocator unchanged; counting does not allocate.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let _ = ALLOCATIONS.try_with(|count| count.set(count.get() + 1));
        // SAFETY: the caller's promises are those of `System`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: `pointer` came from `System`, with this layout.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn allocations(run: impl FnOnce()) -> u64 {
    let before = ALLOCATIONS.get();
    run();
    ALLOCATIONS.get() - before
}

#[test]
fn the_counter_counts() {
    assert_eq!(
        allocations(|| drop(std::hint::black_box(vec![1u8; 100]))),
        1
    );
}

#[test]
fn voxels_do_not_allocate_however_the_exposure_ends() {
    let grid = Grid::new(64, 64);
    let map = PixelMap::rescaled(&Rescale::identity(grid).unwrap());
    let mut raster = VoxelRaster::new(8, map).unwrap();
    let mut history = EventHistory::new(1 << 14).unwrap();
    let mut out = vec![0.0; raster.shape().len()];
    // Times swapped pairwise, so that moved events have to be sorted too.
    let pack = |k: u32| {
        PackedEvent::new(
            (k ^ 1) * 9,
            (k * 7 % 64) as u16,
            (k / 64 % 64) as u16,
            k.is_multiple_of(2),
        )
    };
    let events: Vec<_> = (0..10_000).map(|k| pack(k).unwrap()).collect();
    for off in [0, 1, 5, 900] {
        let count = allocations(|| {
            raster.begin(
                Exposure::from_micros(0, 90_000 - off).unwrap(),
                history.next(),
            );
            for chunk in events.chunks(777) {
                history.extend(chunk);
                raster.advance(&history, &mut out).unwrap();
            }
            let exposure = Exposure::from_micros(0, 90_000).unwrap();
            assert_eq!(
                raster
                    .finish(exposure, &history, &mut out)
                    .unwrap()
                    .forgotten,
                0
            );
        });
        assert_eq!(count, 0, "{off} us off");
    }
}

#[test]
fn sparse_depth_does_not_allocate() {
    let camera = Pinhole::new(64.0, 64.0, 31.5, 31.5, Distortion::default()).unwrap();
    let turn = nalgebra::Vector3::new(std::f64::consts::FRAC_PI_2, 0.0, 0.0);
    let config = SparseConfig {
        camera,
        grid: Grid::new(64, 64),
        camera_from_lidar: Isometry3::new(nalgebra::Vector3::zeros(), turn),
        lidar_from_vehicle: Isometry3::identity(),
        channels: vec![
            Channel {
                elevation_deg: 0.0,
                azimuth_offset_deg: 0.0
            };
            4
        ],
        rotation: Duration::from_millis(100),
        passes: 2,
        points_max: 100,
        range_min_m: 1.0,
        margin_deg: 5.0,
        motion_samples: 20,
        motion_reach: Duration::from_millis(100),
    };
    let mut raster = SparseRaster::new(&config).unwrap();
    let mut out = vec![0.0; raster.map_len()];
    let mut drawn = 0;
    let count = allocations(|| {
        for k in 0..4000u64 {
            let at = Stamp::from_micros(1_000_000 + k * 167);
            if k % 60 == 0 {
                raster.push_motion(at, 10.0, 0.1).unwrap();
            }
            let azimuth_cdeg = (k * 60 % 36_000) as u16;
            let (sin, cos) = (f32::from(azimuth_cdeg) * 0.01).to_radians().sin_cos();
            let (t, x_m, y_m, z_m) = (Stamp::ZERO, 9.0 * sin, 9.0 * cos, 0.0);
            let channel = (k % 4) as u8;
            raster.push_return(
                at,
                &Return {
                    t,
                    x_m,
                    y_m,
                    z_m,
                    azimuth_cdeg,
                    channel,
                    intensity: 0,
                    block: 0,
                },
            );
            if k % 100 == 0 {
                drawn += raster
                    .draw(at, EgoPolicy::Compensate, &mut out)
                    .unwrap()
                    .drawn;
            }
        }
    });
    assert_eq!(count, 0);
    let counts = raster.tracker().counts();
    assert!(
        drawn > 500 && counts.complete >= 5 && counts.overflowed > 0,
        "{drawn} {counts:?}"
    );
}

#[test]
fn images_do_not_allocate() {
    let sensor = Grid::new(64, 48);
    let data = vec![7u8; 64 * 48 * 3];
    let view = ImageView {
        data: &data,
        size: sensor,
        stride_bytes: 192,
        samples: Samples::U8,
    };
    for grid in [Grid::new(32, 24), Grid::new(20, 20)] {
        let planes = ImagePlanes::new(Rescale::new(sensor, sensor.whole(), grid).unwrap());
        let mut out = vec![0.0; planes.planes_len()];
        assert_eq!(allocations(|| planes.write(&view, &mut out).unwrap()), 0);
    }
}

//! Voxel grids against the definition in wide integers, and the incremental way against the whole.
#![allow(clippy::unwrap_used, reason = "a test may panic")]
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "test arithmetic"
)]

use noctule_raster::{
    BINS, Crop, EventHistory, Exposure, Grid, OUTSIDE, PackedEvent, PixelMap, RasterError, Rescale,
    Retimed, Tally, VoxelRaster,
};
use proptest::prelude::*;

/// An 8x6 sensor, of which 6x4 pixels are scaled to 3x4 cells.
fn map() -> PixelMap {
    let crop = Crop {
        x: 1,
        y: 1,
        width: 6,
        height: 4,
    };
    PixelMap::rescaled(&Rescale::new(Grid::new(8, 6), crop, Grid::new(3, 4)).unwrap())
}

fn exposure(open_us: u64, width_us: u64) -> Exposure {
    Exposure::from_micros(open_us, open_us + width_us).unwrap()
}

/// The definition, event by event, by division of wide integers.
fn by_definition(
    steps: usize,
    map: &PixelMap,
    exposure: Exposure,
    events: &[PackedEvent],
) -> (Vec<f32>, Tally) {
    let cells = map.grid().cells();
    let mut sums = vec![0i128; steps * BINS * cells];
    let mut tally = Tally::default();
    let (open, width) = (exposure.open().as_micros(), i128::from(exposure.width_us()));
    for event in events {
        // Times of the tests stay within 2^31 us of the opening.
        let since = i128::from(event.t_us.wrapping_sub(open as u32).cast_signed());
        if !(0..width).contains(&since) {
            tally.outside_exposure += 1;
            continue;
        }
        let Some(cell) = map.cell(event.x() as u16, event.y() as u16) else {
            tally.outside_grid += 1;
            continue;
        };
        tally.rastered += 1;
        let step = since * steps as i128 / width;
        // u = (t - start) / (end - start) * 4, in 256ths, to the nearest.
        let u256 = (2 * (since * steps as i128 - step * width) * 1024 + width) / (2 * width);
        let bin = (u256 / 256).min(3);
        let later = u256 - bin * 256;
        let sign = if event.is_on() { 1 } else { -1 };
        let plane = (step * BINS as i128 + bin) as usize;
        sums[plane * cells + cell] += sign * (256 - later);
        sums[(plane + 1) * cells + cell] += sign * later;
    }
    let value = |sum: i128| (sum as f64 / 256.0).clamp(-10.0, 10.0) / 10.0;
    (
        sums.into_iter().map(|sum| value(sum) as f32).collect(),
        tally,
    )
}

fn bits(grid: &[f32]) -> Vec<u32> {
    grid.iter().map(|value| value.to_bits()).collect()
}

#[test]
fn one_event_worked_by_hand() {
    // 800 us in 8 steps of 100 us, bins 25 us apart. Opens 100 us before packed times wrap.
    let open = (5u64 << 32) - 100;
    let raster = VoxelRaster::new(8, map()).unwrap();
    let mut out = vec![f32::NAN; raster.shape().len()];
    // 110 us after the opening: step 1, u = 0.4; pixel (3, 2) is column 1, row 1.
    let event = PackedEvent::new(10, 3, 2, false).unwrap();
    let tally = raster
        .raster(exposure(open, 800), &[event], &mut out)
        .unwrap();
    assert_eq!(
        tally,
        Tally {
            rastered: 1,
            ..Tally::default()
        }
    );
    let at = |step: usize, bin: usize| (step * BINS + bin) * 12 + 3 + 1;
    for (index, value) in out.iter().enumerate() {
        let expected = match index {
            i if i == at(1, 0) => -154.0 / 2560.0, // 0.6 = 153.6 / 256
            i if i == at(1, 1) => -102.0 / 2560.0,
            _ => 0.0,
        };
        assert_eq!(*value, expected, "element {index}");
    }
}

#[test]
fn sums_are_clamped_when_finished_and_not_before() {
    let raster = VoxelRaster::new(1, map()).unwrap();
    let mut out = vec![0.0; raster.shape().len()];
    let at_start = |on| PackedEvent::new(0, 1, 1, on).unwrap();
    // 14 up, then 5 down: 9, though the sum was beyond 10 on the way.
    let events = [vec![at_start(true); 14], vec![at_start(false); 5]].concat();
    raster.raster(exposure(0, 100), &events, &mut out).unwrap();
    assert_eq!(out[0], 0.9);
    raster
        .raster(exposure(0, 100), &[at_start(false); 11], &mut out)
        .unwrap();
    assert_eq!(out[0], -1.0);
}

/// Events round an exposure of `width` microseconds, some before and after it, on a 8x6 sensor.
fn events(open: u64, width: u64, max: usize) -> impl Strategy<Value = Vec<PackedEvent>> {
    let event = (-60..=width as i64 + 60, 0..8u16, 0..6u16, any::<bool>());
    let pack = move |(since, x, y, on): (i64, u16, u16, bool)| {
        PackedEvent::new(open.wrapping_add_signed(since) as u32, x, y, on).unwrap()
    };
    let sorted = |mut events: Vec<PackedEvent>| {
        events.sort_by_key(|event| event.t_us.wrapping_add(1 << 31)); // near a wrap at 2^32
        events
    };
    let list = prop::collection::vec(event.prop_map(pack), 0..max);
    prop_oneof![3 => list.clone().prop_map(sorted), 1 => list]
}

/// (opening, true width, predicted width).
fn widths() -> impl Strategy<Value = (u64, u64, u64)> {
    let open = prop_oneof![
        Just(1000u64),
        Just((1 << 32) - 50),
        Just((3 << 32) + 12_345)
    ];
    let width = prop_oneof![1..50u64, 500..2000u64, 90_000..110_000u64];
    let off = prop_oneof![Just(0i64), -2..=2i64, -15..=15i64, -3000..=3000i64];
    (open, width, off)
        .prop_map(|(open, width, off)| (open, width, width.saturating_add_signed(off).max(1)))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn a_whole_exposure_is_the_definition_bit_for_bit(
        (open, width, _, events) in widths().prop_flat_map(|(o, w, p)| (Just(o), Just(w), Just(p), events(o, w, 300))),
        steps in 1..=31usize,
    ) {
        let raster = VoxelRaster::new(steps, map()).unwrap();
        let mut out = vec![f32::NAN; raster.shape().len()];
        let tally = raster.raster(exposure(open, width), &events, &mut out).unwrap();
        let (expected, counts) = by_definition(steps, &map(), exposure(open, width), &events);
        prop_assert_eq!(bits(&out), bits(&expected));
        prop_assert_eq!(tally, counts);
        prop_assert_eq!(tally.examined(), events.len() as u64);
    }

    /// Any prediction, any chunks, either order: the two-pass raster of the whole exposure.
    #[test]
    fn incremental_equals_whole_bit_for_bit(
        (open, width, predicted, events) in widths().prop_flat_map(|(o, w, p)| (Just(o), Just(w), Just(p), events(o, w, 300))),
        cuts in prop::collection::vec(1..90usize, 1..9),
        earlier in 0..40usize,
    ) {
        let mut raster = VoxelRaster::new(8, map()).unwrap();
        let mut history = EventHistory::new(512).unwrap();
        let other = PackedEvent::new(open as u32, 2, 2, true).unwrap();
        history.extend(&vec![other; earlier]);
        let mut out = vec![f32::NAN; raster.shape().len()];
        raster.begin(exposure(open, predicted), history.next());
        let (mut rest, mut cuts) = (&events[..], cuts.iter().cycle());
        while !rest.is_empty() {
            let (chunk, later) = rest.split_at(rest.len().min(*cuts.next().unwrap()));
            history.extend(chunk);
            raster.advance(&history, &mut out).unwrap();
            rest = later;
        }
        let report = raster.finish(exposure(open, width), &history, &mut out).unwrap();
        let (expected, counts) = by_definition(8, &map(), exposure(open, width), &events);
        prop_assert_eq!(bits(&out), bits(&expected), "{:?}", report);
        prop_assert_eq!((report.tally, report.forgotten), (counts, 0));
        prop_assert_eq!(report.retimed == Retimed::Exact, width == predicted);
    }

    /// Quantised weights are off by a 512th of a bin at most from the definition in real numbers.
    #[test]
    fn weights_are_the_real_ones_to_a_512th(since in 0..100_000u32, steps in 1..=31usize) {
        let raster = VoxelRaster::new(steps, map()).unwrap();
        let mut out = vec![0.0; raster.shape().len()];
        let event = PackedEvent::new(since, 1, 1, true).unwrap();
        raster.raster(exposure(0, 100_000), &[event], &mut out).unwrap();
        let along = f64::from(since) * steps as f64 / 1e5;
        let (step, u) = (along as usize, along.fract() * 4.0);
        let (bin, later) = (u as usize, u.fract());
        let at = |bin: usize| f64::from(out[(step * BINS + bin) * 12]) * 10.0;
        prop_assert!((at(bin) - (1.0 - later)).abs() < 1.01 / 512.0);
        prop_assert!((at(bin + 1) - later).abs() < 1.01 / 512.0);
    }
}

/// 20,000 events in order over 100 ms, their polarity at random so that few cells saturate.
fn stream() -> Vec<PackedEvent> {
    let pack = |k: u32| {
        let is_on = k.wrapping_mul(0x9e37_79b1) >> 31 == 0;
        PackedEvent::new(k * 5, (k * 7 % 8) as u16, (k * 3 % 6) as u16, is_on)
    };
    (0..20_000).map(|k| pack(k).unwrap()).collect()
}

fn finish_off_by(off: i64, capacity: usize, map: PixelMap) -> (noctule_raster::FinishReport, bool) {
    let events = stream();
    let mut raster = VoxelRaster::new(8, map.clone()).unwrap();
    let mut history = EventHistory::new(capacity).unwrap();
    let mut out = vec![0.0; raster.shape().len()];
    raster.begin(exposure(0, 100_000u64.wrapping_add_signed(-off)), 0);
    for chunk in events.chunks(100) {
        history.extend(chunk);
        raster.advance(&history, &mut out).unwrap();
    }
    let report = raster
        .finish(exposure(0, 100_000), &history, &mut out)
        .unwrap();
    let expected = by_definition(8, &map, exposure(0, 100_000), &events).0;
    (report, bits(&out) == bits(&expected))
}

#[test]
fn a_jitter_moves_some_a_little_more_walks_and_a_lot_starts_anew() {
    let retimed = |off| {
        let (report, is_equal) = finish_off_by(off, 1 << 15, map());
        assert!(is_equal, "{off} us off");
        report.retimed
    };
    assert_eq!(retimed(0), Retimed::Exact);
    for off in [-5, -2, -1, 1, 2, 5] {
        let Retimed::Delta { moved } = retimed(off) else {
            panic!("{off} us off")
        };
        // A boundary at share s of the exposure moves by s * off; 8192 of them in 100 ms.
        let expected = 20_000.0 * 8192.0 / 1e5 * off.abs() as f64 / 2.0;
        assert!(
            (moved as f64 / expected - 1.0).abs() < 0.2,
            "{moved} of {expected}"
        );
    }
    assert_eq!(
        (retimed(500), retimed(-30_000)),
        (Retimed::Full, Retimed::Full)
    );
}

#[test]
fn a_table_rasters_as_the_axes_it_holds() {
    let axes = map();
    let cell = |(x, y)| axes.cell(x, y).map_or(OUTSIDE, |cell| cell as u32);
    let table = (0..6)
        .flat_map(|y| (0..8).map(move |x| (x, y)))
        .map(cell)
        .collect();
    let table = PixelMap::remapped(Grid::new(8, 6), table, Grid::new(3, 4)).unwrap();
    for off in [0, 1, 5, 500] {
        let (report, is_equal) = finish_off_by(off, 1 << 15, table.clone());
        assert!(is_equal, "{off} us off");
        assert_eq!(report.tally, finish_off_by(off, 1 << 15, map()).0.tally);
    }
}

#[test]
fn a_short_memory_is_owned_up_to() {
    // 4096 of 20,000 events held: enough where the prediction was good to the jitter.
    for off in [0, 2] {
        let (report, is_equal) = finish_off_by(off, 4096, map());
        assert!(is_equal && report.forgotten == 0);
    }
    for off in [5, 500] {
        let (report, is_equal) = finish_off_by(off, 4096, map());
        assert!(!is_equal);
        assert_eq!(report.forgotten, 20_000 - 4096);
    }
    // A raster that looks only now and then misses what was overwritten meanwhile.
    let mut raster = VoxelRaster::new(8, map()).unwrap();
    let mut history = EventHistory::new(4096).unwrap();
    let mut out = vec![0.0; raster.shape().len()];
    raster.begin(exposure(0, 100_000), 0);
    history.extend(&stream());
    let report = raster
        .finish(exposure(0, 100_000), &history, &mut out)
        .unwrap();
    assert_eq!(
        (report.forgotten, report.tally.examined()),
        (20_000 - 4096, 4096)
    );
}

#[test]
fn wrong_calls_are_named() {
    let mut raster = VoxelRaster::new(8, map()).unwrap();
    let history = EventHistory::new(16).unwrap();
    let mut out = vec![0.0; raster.shape().len()];
    assert_eq!(
        raster.advance(&history, &mut out),
        Err(RasterError::NotOpen)
    );
    assert_eq!(
        raster.finish(exposure(0, 1), &history, &mut out),
        Err(RasterError::NotOpen)
    );
    raster.begin(exposure(0, 10), 0);
    let error = raster
        .finish(exposure(0, 10), &history, &mut out[1..])
        .unwrap_err();
    assert_eq!(error.to_string(), "voxel grid has 479 elements, needs 480");
    raster.finish(exposure(0, 10), &history, &mut out).unwrap();
    assert_eq!(out, vec![0.0; 480]);
    assert_eq!(
        raster.advance(&history, &mut out),
        Err(RasterError::NotOpen)
    );
    let error = VoxelRaster::new(32, map()).unwrap_err();
    assert_eq!(error.to_string(), "32 steps per exposure, must be 1..=31");
}

#[test]
fn more_events_than_a_sum_holds_are_refused() {
    let raster = VoxelRaster::new(2, map()).unwrap();
    let mut out = vec![0.0; raster.shape().len()];
    let mut events = vec![PackedEvent::new(70, 1, 1, true).unwrap(); 8_388_608];
    let refused = raster
        .raster(exposure(0, 100), &events, &mut out)
        .unwrap_err();
    let (step, count, limit) = (1, 8_388_608, 8_388_607);
    assert_eq!(
        refused,
        RasterError::StepOverflow {
            step,
            events: count,
            limit
        }
    );
    events[0] = PackedEvent::new(20, 1, 1, true).unwrap();
    raster.raster(exposure(0, 100), &events, &mut out).unwrap();
    assert_eq!(out[5 * 12 + 12], 1.0);
}

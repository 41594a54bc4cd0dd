//! What both completions promise, and that `fill` is the better of the two on made-up streets.

mod street;

use noctule_depth::{Completer, Size, confidence, edge_band, masked_mae, metrics};
use proptest::prelude::*;
use street::{SIDE, Street};

fn fill(sparse: &[f32], width: usize, height: usize) -> (Vec<f32>, Vec<f32>) {
    let mut completer = Completer::new(width, height).expect("a size");
    let (mut depth, mut confidence) = (vec![-1.0; sparse.len()], vec![-1.0; sparse.len()]);
    completer
        .fill(sparse, &mut depth, &mut confidence)
        .expect("sizes agree");
    (depth, confidence)
}

/// Every `dx`-th pixel of every `dy`-th row, the rest empty.
fn rings(dense: impl Fn(usize, usize) -> f32, side: usize, dx: usize, dy: usize) -> Vec<f32> {
    let given = |x: usize, y: usize| (x % dx == dx / 2) && (y % dy == dy / 2);
    (0..side * side)
        .map(|i| {
            if given(i % side, i / side) {
                dense(i % side, i / side)
            } else {
                0.0
            }
        })
        .collect()
}

#[test]
fn a_level_wall_is_filled_exactly() {
    let sparse = rings(|_, _| 12.5, 64, 3, 7);
    let (depth, confidence) = fill(&sparse, 64, 64);
    assert!(depth.iter().all(|&depth| (depth - 12.5).abs() < 1e-5));
    assert!(
        confidence
            .iter()
            .all(|&confidence| confidence > 0.57 && confidence <= 1.0)
    );
}

/// A road seen by a pinhole: inverse depth is affine in the row.
#[test]
fn a_road_is_filled_to_a_hundredth_away_from_the_borders() {
    let road = |_: usize, y: usize| 1.0 / (0.02 + 0.002 * y as f32);
    let (depth, _) = fill(&rings(road, 128, 3, 7), 128, 128);
    let mut nearest = vec![0.0; 128 * 128];
    let mut aside = nearest.clone();
    Completer::new(128, 128)
        .expect("a size")
        .nearest(&rings(road, 128, 3, 7), &mut nearest, &mut aside)
        .expect("sizes agree");
    let worst = |map: &[f32]| {
        let inside = (10..118).flat_map(|y| (10..118).map(move |x| (x, y)));
        inside
            .map(|(x, y)| (map[y * 128 + x] / road(x, y) - 1.0).abs())
            .fold(0.0, f32::max)
    };
    assert!(worst(&depth) < 0.01, "{}", worst(&depth));
    assert!(
        worst(&nearest) > 0.05,
        "nearest is no match: {}",
        worst(&nearest)
    );
}

#[test]
fn nothing_in_nothing_out() {
    for empty in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        let (depth, confidence) = fill(&[empty; 12], 4, 3);
        assert_eq!(
            (depth, confidence),
            (vec![0.0; 12], vec![0.0; 12]),
            "{empty}"
        );
    }
    let mut completer = Completer::new(4, 3).expect("a size");
    let (mut depth, mut distance_px) = ([1.0; 12], [1.0; 12]);
    completer
        .nearest(&[0.0; 12], &mut depth, &mut distance_px)
        .expect("sizes agree");
    assert_eq!((depth, distance_px), ([0.0; 12], [f32::INFINITY; 12]));
    assert!(
        completer
            .fill(&[0.0; 11], &mut [0.0; 12], &mut [0.0; 12])
            .is_err()
    );
    assert!(
        completer
            .fill(&[0.0; 12], &mut [0.0; 12], &mut [0.0; 13])
            .is_err()
    );
    assert!(
        completer
            .nearest(&[0.0; 12], &mut [0.0; 11], &mut [0.0; 12])
            .is_err()
    );
}

#[test]
fn confidence_is_the_exponential_of_the_distance() {
    let mut sparse = vec![0.0; 200];
    sparse[0] = 3.0;
    let (depth, found) = fill(&sparse, 200, 1);
    for (x, &found) in found.iter().enumerate() {
        assert_eq!(found, confidence(x as f32));
        assert!((found - (-(x as f32) / 8.0).exp()).abs() < 1e-7);
    }
    assert_eq!(depth[0], 3.0);
}

/// Twenty streets of the kind the rig sees: fewer and smaller errors than nearest, edges included.
#[test]
fn fill_beats_nearest_on_streets() {
    let size = Size::new(SIDE, SIDE).expect("a size");
    let mut completer = Completer::new(SIDE, SIDE).expect("a size");
    let mut sums = [[0.0; 4]; 2];
    let mut mask = vec![false; SIDE * SIDE];
    for seed in 201..221 {
        let mut street = Street::new(seed);
        let (truth, sparse) = (street.truth(), street.sparse());
        let coverage = sparse.iter().filter(|&&depth| depth > 0.0).count() as f64 / 65_536.0;
        assert!((0.02..0.04).contains(&coverage), "coverage {coverage}");
        edge_band(&truth, size, &mut mask).expect("sizes agree");
        let (mut depth, mut aside) = (vec![0.0; SIDE * SIDE], vec![0.0; SIDE * SIDE]);
        for (method, sums) in sums.iter_mut().enumerate() {
            match method {
                0 => completer.nearest(&sparse, &mut depth, &mut aside),
                _ => completer.fill(&sparse, &mut depth, &mut aside),
            }
            .expect("sizes agree");
            let all = metrics(&depth, &truth, 0.1, 80.0).expect("truth");
            let band = masked_mae(&depth, &truth, &mask, 0.1, 80.0).expect("sizes agree");
            let band = band.expect("a street has edges").mae_mm;
            for (sum, part) in sums
                .iter_mut()
                .zip([all.rmse_mm, all.mae_mm, all.rel, band])
            {
                *sum += part / 20.0;
            }
        }
    }
    let [nearest, fill] = sums;
    eprintln!("RMSE, MAE mm, REL, edge band MAE mm: nearest {nearest:.3?}, fill {fill:.3?}");
    let limits = [0.96, 0.87, 0.77, 0.94];
    for part in 0..4 {
        assert!(
            fill[part] < limits[part] * nearest[part],
            "part {part}: {sums:?}"
        );
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(96))]

    /// Any size, any density, any positive depth there is: every pixel gets a sound value.
    #[test]
    fn every_pixel_gets_a_depth(
        width in 1_usize..50,
        height in 1_usize..50,
        returns in prop::collection::vec(
            (any::<prop::sample::Index>(), prop::num::f32::POSITIVE | prop::num::f32::SUBNORMAL | prop::num::f32::NORMAL),
            1..80,
        ),
    ) {
        let mut sparse = vec![0.0; width * height];
        for (index, depth) in returns {
            sparse[index.index(width * height)] = depth;
        }
        let holds_return = sparse.iter().any(|&depth: &f32| depth > 0.0 && depth.is_finite());
        let (depth, confidence) = fill(&sparse, width, height);
        for (&depth, &confidence) in depth.iter().zip(&confidence) {
            prop_assert_eq!(depth > 0.0, holds_return);
            prop_assert!(depth.is_finite() && (0.0..=1.0).contains(&confidence));
        }
    }

    /// Filled depths stay between the nearest and twice the farthest return (the lean's limit).
    #[test]
    fn depths_stay_in_bounds(seed in 0_u64..1000, side in 8_usize..60) {
        let depth_at = |x: usize, y: usize| {
            let hash = (x as u64 * 7919 + y as u64 * 104_729 + seed).wrapping_mul(0x9e37_79b9_7f4a_7c15);
            2.0 + (hash >> 56) as f32 / 4.0
        };
        let sparse = rings(depth_at, side, 5, 6);
        let given = || sparse.iter().copied().filter(|&depth| depth > 0.0);
        let (low, high) = (given().fold(f32::MAX, f32::min), given().fold(0.0, f32::max));
        for depth in fill(&sparse, side, side).0 {
            prop_assert!(depth > 0.999 * low && depth < 2.001 * high, "{} of {}..{}", depth, low, high);
        }
    }
}

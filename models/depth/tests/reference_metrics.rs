//! The five metrics equal those of the PyTorch reference on its own maps (see `fixtures/README.md`).

use noctule_depth::metrics;

fn floats(bytes: &[u8]) -> Vec<f32> {
    bytes
        .chunks_exact(4)
        .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
        .collect()
}

#[test]
fn metrics_equal_the_reference() {
    let pred = floats(include_bytes!("fixtures/tiny_d_dense.f32"));
    let gt = floats(include_bytes!("fixtures/tiny_gt_depth.f32"));
    // The reference clamps at 1 mm, knows no cap and pools the three frames.
    let found = metrics(&pred, &gt, 1e-3, f32::INFINITY).expect("all pixels have truth");
    assert_eq!(found.pixels, 3 * 32 * 32);
    for (name, found, expected) in [
        ("rmse", found.rmse_mm, 16_020.044_624_298_233),
        ("mae", found.mae_mm, 12_192.204_448_084_036),
        ("irmse", found.irmse_per_km, 33.259_099_877_121_415),
        ("rel", found.rel, 0.722_923_847_505_362_9),
        ("delta1", found.delta1_pct, 50.976_562_5),
    ] {
        assert!(
            (found / expected - 1.0).abs() < 1e-12,
            "{name}: {found} is not {expected}"
        );
    }
}

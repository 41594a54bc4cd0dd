//! The network against the PyTorch reference, on the fixtures the reference exported.

use std::path::{Path, PathBuf};

use candle_core::Device;
use noctule_erunet::{Norms, parity, parity_on};

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("tests/fixtures")
        .join(name)
}

/// One exposure of three steps, 32 x 32 pixels.
#[test]
fn tiny_network_agrees_with_the_reference_feature_by_feature() {
    let report = parity(&fixture("tiny")).unwrap();
    println!("{report}");
    // F_static, 5 per step, 4 per level, I_recon, D_dense.
    assert_eq!(report.tensors.len(), 1 + 5 * 3 + 4 * 4 + 2);
    assert!(report.is_within(), "\n{report}");
}

/// Two exposures whose pictures are not square; blocks and widths differ from level to level.
#[test]
fn uneven_network_agrees_with_the_reference_over_a_batch() {
    let report = parity(&fixture("batch")).unwrap();
    println!("{report}");
    assert_eq!(
        report.tensors.len(),
        1 + 5 * report.config.steps + 4 * 4 + 2
    );
    assert!(report.is_within(), "\n{report}");
}

#[test]
fn norms_left_unfolded_agree_as_well() {
    for name in ["tiny", "batch"] {
        let report = parity_on(&fixture(name), &Device::Cpu, Norms::Keep).unwrap();
        assert!(report.is_within(), "{name}\n{report}");
    }
}

//! Where errors are looked at separately: edge bands and masked means. Draws nothing.

use crate::metrics::{MetricsError, check_range, has_truth};
use crate::size::{Size, SizeError, check_len};

/// Width of the band on each side of a depth edge, pixels (Euclidean).
pub const EDGE_BAND_PX: usize = 5;
/// Neighbours form an edge where their depths differ by more than this share of the nearer ...
pub const EDGE_RATIO: f32 = 0.05;
/// ... and by more than this, metres.
pub const EDGE_STEP_M: f32 = 0.5;

/// Whether two neighbouring true depths (metres) form a depth edge.
fn is_edge(a: f32, b: f32) -> bool {
    let (near, far) = (a.min(b), a.max(b));
    near > 0.0 && far.is_finite() && far - near > EDGE_STEP_M && far - near > EDGE_RATIO * near
}

/// Marks the pixels within [`EDGE_BAND_PX`] of a depth jump in the truth.
///
/// A jump lies between two 4-neighbours, both with truth, that differ by more than 5 % of the
/// nearer and more than 0.5 m; both of its pixels are at distance 0. `mask` is overwritten.
pub fn edge_band(gt: &[f32], size: Size, mask: &mut [bool]) -> Result<(), SizeError> {
    size.check("gt", gt.len())?;
    size.check("mask", mask.len())?;
    mask.fill(false);
    let (width, height) = (size.width(), size.height());
    for y in 0..height {
        for x in 0..width {
            let index = y * width + x;
            if x + 1 < width && is_edge(gt[index], gt[index + 1]) {
                stamp_disc(mask, size, x, y);
                stamp_disc(mask, size, x + 1, y);
            }
            if y + 1 < height && is_edge(gt[index], gt[index + width]) {
                stamp_disc(mask, size, x, y);
                stamp_disc(mask, size, x, y + 1);
            }
        }
    }
    Ok(())
}

/// Marks the disc of radius [`EDGE_BAND_PX`] around a pixel, cut at the border.
fn stamp_disc(mask: &mut [bool], size: Size, x: usize, y: usize) {
    let rows = y.saturating_sub(EDGE_BAND_PX)..(y + EDGE_BAND_PX + 1).min(size.height());
    for row in rows {
        let rise = row.abs_diff(y);
        let run = (EDGE_BAND_PX * EDGE_BAND_PX - rise * rise).isqrt();
        let columns = x.saturating_sub(run)..(x + run + 1).min(size.width());
        mask[row * size.width()..][columns].fill(true);
    }
}

/// Mean absolute error over the pixels a mask picks, in millimetres, and how many those are.
///
/// Truth, clamping and errors are as in [`crate::metrics()`], except that a mask which picks no pixel
/// with truth is no error: an image without movers has no mover error, which is `None`.
pub fn masked_mae(
    pred: &[f32],
    gt: &[f32],
    mask: &[bool],
    d_min: f32,
    cap: f32,
) -> Result<Option<MaskedMae>, MetricsError> {
    check_len("pred", pred.len(), gt.len())?;
    check_len("mask", mask.len(), gt.len())?;
    check_range(d_min, cap)?;
    let (mut absolute, mut pixels) = (0.0, 0_u64);
    for (index, ((&p, &g), &picked)) in pred.iter().zip(gt).zip(mask).enumerate() {
        if !picked || !has_truth(g, cap) {
            continue;
        }
        if p.is_nan() {
            return Err(MetricsError::NotANumber { index });
        }
        absolute += (f64::from(p.clamp(d_min, cap)) - f64::from(g)).abs();
        pixels += 1;
    }
    let mae_mm = 1000.0 * absolute / pixels as f64;
    Ok((pixels > 0).then_some(MaskedMae { mae_mm, pixels }))
}

/// What [`masked_mae`] found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MaskedMae {
    /// Mean absolute error, millimetres.
    pub mae_mm: f64,
    /// Pixels that went in.
    pub pixels: u64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_jump_needs_five_percent_and_half_a_metre() {
        assert!(is_edge(1.0, 1.6) && is_edge(1.6, 1.0));
        assert!(!is_edge(1.0, 1.4), "40 %, but 0.4 m");
        assert!(!is_edge(20.0, 20.9), "0.9 m, but 4.5 %");
        assert!(is_edge(20.0, 21.1));
        assert!(!is_edge(0.0, 5.0), "no truth on one side");
        assert!(!is_edge(5.0, f32::INFINITY) && !is_edge(5.0, f32::NAN));
    }

    #[test]
    fn the_band_reaches_five_pixels_to_both_sides_of_a_wall() {
        let size = Size::new(30, 4).expect("a size");
        let gt: Vec<f32> = (0..120)
            .map(|i| if i % 30 < 15 { 2.0 } else { 8.0 })
            .collect();
        let mut mask = vec![true; 120];
        edge_band(&gt, size, &mut mask).expect("sizes agree");
        for (index, &marked) in mask.iter().enumerate() {
            let x = index % 30;
            assert_eq!(marked, (9..=20).contains(&x), "column {x}"); // 14 - 5 ..= 15 + 5
        }
    }

    #[test]
    fn the_band_of_a_corner_is_round() {
        let size = Size::new(21, 21).expect("a size");
        let mut gt = vec![10.0; 441];
        gt[10 * 21 + 10] = 2.0; // one near pixel: it and its four neighbours are edge pixels
        let mut mask = vec![false; 441];
        edge_band(&gt, size, &mut mask).expect("sizes agree");
        let centres = [(10, 10), (9, 10), (11, 10), (10, 9), (10, 11)];
        for (index, &marked) in mask.iter().enumerate() {
            let (x, y) = (index % 21, index / 21);
            let near = centres.iter().any(|&(cx, cy): &(usize, usize)| {
                let (dx, dy) = (cx.abs_diff(x), cy.abs_diff(y));
                dx * dx + dy * dy <= 25
            });
            assert_eq!(marked, near, "({x}, {y})");
        }
    }

    #[test]
    fn the_masked_mean_is_over_the_mask_alone() {
        let (pred, gt) = ([1.0, 5.0, 9.0, 4.0], [2.0, 5.5, 9.0, 0.0]);
        let mae = |mask: &[bool]| masked_mae(&pred, &gt, mask, 0.1, 80.0).expect("sizes agree");
        assert_eq!(
            mae(&[true, true, false, true]),
            Some(MaskedMae {
                mae_mm: 750.0,
                pixels: 2
            })
        );
        assert_eq!(mae(&[false, false, false, true]), None);
        assert!(masked_mae(&pred, &gt, &[true], 0.1, 80.0).is_err());
        let nan = masked_mae(&[f32::NAN], &[1.0], &[true], 0.1, 80.0);
        assert_eq!(nan, Err(MetricsError::NotANumber { index: 0 }));
    }
}

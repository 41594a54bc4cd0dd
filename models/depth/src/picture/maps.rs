//! Per-pixel colours: depth, sparse returns, signed error, events. Allocates nothing.

use super::colour::Ramp;
use super::scale::{INVALID_RGB, Scale};
use crate::size::{Size, SizeError, check_len, is_return};

/// Colour of one depth.
#[inline]
fn depth_rgb(depth_m: f32, scale: Scale) -> [u8; 3] {
    if is_return(depth_m) {
        Ramp::depth().at(scale.position(depth_m))
    } else {
        INVALID_RGB
    }
}

/// Colours a depth map (metres) into `rgb`, three bytes a pixel; without a value, dark grey.
pub fn depth_to_rgb(depth: &[f32], scale: Scale, rgb: &mut [u8]) -> Result<(), SizeError> {
    check_len("rgb", rgb.len(), 3 * depth.len())?;
    for (&depth_m, pixel) in depth.iter().zip(rgb.chunks_exact_mut(3)) {
        pixel.copy_from_slice(&depth_rgb(depth_m, scale));
    }
    Ok(())
}

/// Colours sparse returns as squares of `2 * radius + 1` pixels, the nearest on top, on black.
pub fn sparse_to_rgb(
    sparse: &[f32],
    size: Size,
    radius: usize,
    scale: Scale,
    rgb: &mut [u8],
) -> Result<(), SizeError> {
    size.check("sparse", sparse.len())?;
    check_len("rgb", rgb.len(), 3 * sparse.len())?;
    let (width, height) = (size.width(), size.height());
    for (index, pixel) in rgb.chunks_exact_mut(3).enumerate() {
        let (x, y) = (index % width, index / width);
        let columns = x.saturating_sub(radius)..(x + radius + 1).min(width);
        let rows = y.saturating_sub(radius)..(y + radius + 1).min(height);
        let nearest = rows
            .flat_map(|row| &sparse[row * width..][columns.clone()])
            .copied()
            .filter(|&depth_m| is_return(depth_m))
            .fold(f32::INFINITY, f32::min);
        let colour = if nearest.is_finite() {
            depth_rgb(nearest, scale)
        } else {
            [0; 3]
        };
        pixel.copy_from_slice(&colour);
    }
    Ok(())
}

/// Colours `pred - gt` (metres): too near blue, right near black, too far orange.
///
/// The ramp's ends stand for `full_m` and grow with the square root of the error, so that small
/// ones show. Pixels without truth or prediction are dark grey.
pub fn error_to_rgb(
    pred: &[f32],
    gt: &[f32],
    full_m: f32,
    rgb: &mut [u8],
) -> Result<(), SizeError> {
    check_len("pred", pred.len(), gt.len())?;
    check_len("rgb", rgb.len(), 3 * gt.len())?;
    for ((&p, &g), pixel) in pred.iter().zip(gt).zip(rgb.chunks_exact_mut(3)) {
        let colour = if is_return(g) && is_return(p) {
            Ramp::signed().at(error_position(p - g, full_m))
        } else {
            INVALID_RGB
        };
        pixel.copy_from_slice(&colour);
    }
    Ok(())
}

/// Position of a signed error on the ramp.
pub(crate) fn error_position(error_m: f32, full_m: f32) -> f32 {
    let share = (error_m.abs() / full_m).min(1.0).sqrt();
    0.5 + 0.5 * share.copysign(error_m)
}

/// Colours events: the sum over `bins` voxel planes `[bins, H, W]`, brighter red, darker blue.
///
/// The ramp's ends stand for a sum of `full`; a pixel without events is near black. Errs unless
/// `voxels` holds `bins` planes of the picture's size.
pub fn events_to_rgb(
    voxels: &[f32],
    bins: usize,
    full: f32,
    rgb: &mut [u8],
) -> Result<(), SizeError> {
    let pixels = rgb.len() / 3;
    check_len("rgb", rgb.len(), 3 * pixels)?;
    check_len("voxels", voxels.len(), bins.saturating_mul(pixels))?;
    for (index, pixel) in rgb.chunks_exact_mut(3).enumerate() {
        let sum: f32 = (0..bins).map(|bin| voxels[bin * pixels + index]).sum();
        pixel.copy_from_slice(&Ramp::events().at(error_position(sum, full)));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn near_is_light_far_is_dark_and_nothing_is_grey() {
        let mut rgb = [0; 12];
        depth_to_rgb(&[1.0, 80.0, 0.0, f32::NAN], Scale::DRIVE, &mut rgb).expect("sizes agree");
        assert_eq!(rgb[..3], Ramp::depth().at(0.0));
        assert_eq!(rgb[3..6], Ramp::depth().at(1.0));
        assert_eq!(
            (&rgb[6..9], &rgb[9..]),
            (&INVALID_RGB[..], &INVALID_RGB[..])
        );
        let error = depth_to_rgb(&[1.0], Scale::DRIVE, &mut rgb).expect_err("12 bytes");
        assert_eq!(error.to_string(), "rgb holds 12 values, needs 3");
    }

    #[test]
    fn enlarged_points_show_the_nearest_where_they_overlap() {
        let size = Size::new(6, 1).expect("a size");
        let mut rgb = [9; 18];
        let sparse = [0.0, 40.0, 4.0, 0.0, 0.0, 0.0];
        sparse_to_rgb(&sparse, size, 1, Scale::DRIVE, &mut rgb).expect("sizes agree");
        let colour = |depth| Ramp::depth().at(Scale::DRIVE.position(depth));
        let expected = [
            colour(40.0),
            colour(4.0),
            colour(4.0),
            colour(4.0),
            [0; 3],
            [0; 3],
        ]
        .concat();
        assert_eq!(rgb[..], expected[..]);
    }

    #[test]
    fn errors_keep_their_sign_and_saturate() {
        let mut rgb = [0; 15];
        error_to_rgb(
            &[4.0, 6.0, 5.0, 99.0, 5.0],
            &[5.0, 5.0, 5.0, 5.0, 0.0],
            4.0,
            &mut rgb,
        )
        .expect("sizes agree");
        let ramp = Ramp::signed();
        let expected = [
            ramp.at(0.25),
            ramp.at(0.75),
            ramp.at(0.5),
            ramp.at(1.0),
            INVALID_RGB,
        ]
        .concat();
        assert_eq!(rgb[..], expected[..]);
    }

    #[test]
    fn events_are_summed_over_the_bins() {
        let mut rgb = [0; 9];
        // Two bins of three pixels: +1, 0 and -1 in sum.
        events_to_rgb(&[0.5, 0.5, -0.5, 0.5, -0.5, -0.5], 2, 1.0, &mut rgb).expect("sizes agree");
        let ramp = Ramp::events();
        assert_eq!(
            rgb[..],
            [ramp.at(1.0), ramp.at(0.5), ramp.at(0.0)].concat()[..]
        );
        assert!(events_to_rgb(&[0.0; 5], 2, 1.0, &mut rgb).is_err());
        assert!(events_to_rgb(&[0.0; 6], usize::MAX, 1.0, &mut rgb).is_err());
    }
}

//! Colours from behind a Bayer mosaic, interpolated bilinearly.
//!
//! At the border the mosaic is continued by reflection about the edge pixel, which keeps every
//! neighbour's colour what it would be inside.

/// Converts an even-sided 8-bit mosaic to packed RGB8. `red_at` is the column and row parity of
/// the red pixels. The caller has checked all lengths.
pub(crate) fn to_rgb8(
    frame: &[u8],
    (width, height): (usize, usize),
    stride_bytes: usize,
    red_at: (usize, usize),
    rgb8: &mut [u8],
) {
    for (y, out) in rgb8.chunks_exact_mut(width * 3).enumerate() {
        let row = |y: usize| &frame[y * stride_bytes..][..width];
        let (above, below) = neighbours(y, height);
        let rows = [row(above), row(y), row(below)];
        let red_row = y % 2 == red_at.1;
        for (x, pixel) in out.chunks_exact_mut(3).enumerate() {
            let red_column = x % 2 == red_at.0;
            let (left, right) = neighbours(x, width);
            let here = rows[1][x];
            let beside = mean([rows[1][left], rows[1][right]]);
            let upright = mean([rows[0][x], rows[2][x]]);
            let cross = mean([rows[1][left], rows[1][right], rows[0][x], rows[2][x]]);
            let corners = mean([rows[0][left], rows[0][right], rows[2][left], rows[2][right]]);
            let rgb = match (red_row, red_column) {
                (true, true) => [here, cross, corners],
                (true, false) => [beside, here, upright],
                (false, true) => [upright, here, beside],
                (false, false) => [corners, cross, here],
            };
            pixel.copy_from_slice(&rgb);
        }
    }
}

/// The positions before and after `at`, reflected at both ends of `0..len`.
const fn neighbours(at: usize, len: usize) -> (usize, usize) {
    let before = if at == 0 { 1 } else { at - 1 };
    let after = if at + 1 == len { len - 2 } else { at + 1 };
    (before, after)
}

/// Rounded half up.
fn mean<const N: usize>(values: [u8; N]) -> u8 {
    let sum: usize = values.iter().map(|&v| usize::from(v)).sum();
    u8::try_from((sum + N / 2) / N).unwrap_or(u8::MAX)
}

#[cfg(test)]
mod tests {
    use crate::{ImageLayout, PixelFormat};

    const FORMATS: [(PixelFormat, [usize; 4]); 4] = [
        (PixelFormat::BayerRggb8, [0, 1, 1, 2]),
        (PixelFormat::BayerBggr8, [2, 1, 1, 0]),
        (PixelFormat::BayerGrbg8, [1, 0, 2, 1]),
        (PixelFormat::BayerGbrg8, [1, 2, 0, 1]),
    ];

    /// A uniform colour seen through any mosaic comes back exactly, borders included.
    #[test]
    fn a_uniform_colour_is_restored_by_every_pattern() {
        let colour = [200, 100, 50];
        for (format, pattern) in FORMATS {
            for (width, height) in [(2, 2), (4, 6)] {
                let mosaic: Vec<u8> = (0..width * height)
                    .map(|k| colour[pattern[k / width % 2 * 2 + k % width % 2]])
                    .collect();
                let layout = ImageLayout::packed(format, width, height, 8).unwrap();
                let mut out = vec![0; layout.rgb8_len()];
                layout.to_rgb8(&mosaic, &mut out).unwrap();
                assert!(out.chunks(3).all(|p| p == colour), "{format:?}: {out:?}");
            }
        }
    }

    /// Worked by hand on the four inner pixels of a 4x4 RGGB mosaic.
    #[test]
    fn inner_pixels_are_means_of_their_neighbours() {
        #[rustfmt::skip]
        let mosaic = [
            10, 20, 30, 40,
            50, 60, 70, 80,
            90, 100, 110, 120,
            130, 140, 150, 160,
        ];
        let layout = ImageLayout::packed(PixelFormat::BayerRggb8, 4, 4, 8).unwrap();
        let mut out = vec![0; layout.rgb8_len()];
        layout.to_rgb8(&mosaic, &mut out).unwrap();
        let at = |x: usize, y: usize| &out[(y * 4 + x) * 3..][..3];
        // Blue pixel: red from the corners 10 30 90 110, green from the cross 20 50 70 100.
        assert_eq!(at(1, 1), [60, 60, 60]);
        // Green in a blue row: red above and below (30, 110), blue beside (60, 80).
        assert_eq!(at(2, 1), [70, 70, 70]);
        // Green in a red row: red beside (90, 110), blue above and below (60, 140).
        assert_eq!(at(1, 2), [100, 100, 100]);
        // Red pixel: green from 70 100 120 150, blue from 60 80 140 160.
        assert_eq!(at(2, 2), [110, 110, 110]);
    }
}

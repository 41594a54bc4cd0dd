//! Pixel formats, and their conversion to RGB8 in the caller's memory.

use serde::{Deserialize, Serialize};

use crate::bayer;

/// How a frame's bytes hold its pixels. Samples of more than 8 bits are little-endian 16-bit words
/// with the value in the low bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PixelFormat {
    /// Three bytes per pixel: red, green, blue.
    Rgb8,
    /// One byte per pixel.
    Mono8,
    /// Three words per pixel: red, green, blue.
    Rgb16,
    /// One word per pixel.
    Mono16,
    /// Y0 U Y1 V for two pixels; ITU-R BT.601, luma 16..=235, chroma 16..=240.
    Yuyv,
    /// One byte per pixel behind colour filters; the first row begins red, green.
    BayerRggb8,
    /// As above; the first row begins blue, green.
    BayerBggr8,
    /// As above; the first row begins green, red.
    BayerGrbg8,
    /// As above; the first row begins green, blue.
    BayerGbrg8,
}

impl PixelFormat {
    /// Bytes per pixel in a row (YUYV: on average).
    #[must_use]
    pub const fn bytes_per_pixel(self) -> usize {
        match self {
            Self::Mono8
            | Self::BayerRggb8
            | Self::BayerBggr8
            | Self::BayerGrbg8
            | Self::BayerGbrg8 => 1,
            Self::Mono16 | Self::Yuyv => 2,
            Self::Rgb8 => 3,
            Self::Rgb16 => 6,
        }
    }

    /// Whether samples are 16-bit words.
    #[must_use]
    pub const fn is_wide(self) -> bool {
        matches!(self, Self::Rgb16 | Self::Mono16)
    }

    /// Column and row parity of a red pixel, for the Bayer formats.
    const fn red_at(self) -> Option<(usize, usize)> {
        match self {
            Self::BayerRggb8 => Some((0, 0)),
            Self::BayerBggr8 => Some((1, 1)),
            Self::BayerGrbg8 => Some((1, 0)),
            Self::BayerGbrg8 => Some((0, 1)),
            _ => None,
        }
    }
}

/// The checked geometry of a frame in memory.
///
/// INVARIANT: width and height are in `1..=16_384`, even where the format needs it; a row fits its
/// stride; `bit_depth` is in `8..=16` for wide formats and 8 otherwise.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageLayout {
    format: PixelFormat,
    width: usize,
    height: usize,
    stride_bytes: usize,
    bit_depth: u8,
}

/// Longest side of a frame, pixels; far above any machine-vision sensor.
const SIDE_MAX: usize = 16_384;

impl ImageLayout {
    /// Checks a geometry. `stride_bytes` is the distance between rows; `bit_depth` the significant
    /// bits of a sample.
    ///
    /// # Errors
    /// When a side is out of range or odd where pixels come in pairs, a row is longer than its
    /// stride, or the depth does not belong to the format.
    pub fn new(
        format: PixelFormat,
        width: usize,
        height: usize,
        stride_bytes: usize,
        bit_depth: u8,
    ) -> Result<Self, PixelError> {
        let sides = 1..=SIDE_MAX;
        let (even_width, even_height) = (
            format == PixelFormat::Yuyv || format.red_at().is_some(),
            format.red_at().is_some(),
        );
        if !sides.contains(&width)
            || !sides.contains(&height)
            || even_width && !width.is_multiple_of(2)
            || even_height && !height.is_multiple_of(2)
        {
            return Err(PixelError::Size { width, height });
        }
        let row_bytes = width * format.bytes_per_pixel();
        if stride_bytes < row_bytes {
            return Err(PixelError::Stride {
                stride_bytes,
                row_bytes,
            });
        }
        let depths = if format.is_wide() { 8..=16 } else { 8..=8 };
        if !depths.contains(&bit_depth) {
            return Err(PixelError::BitDepth(bit_depth));
        }
        Ok(Self {
            format,
            width,
            height,
            stride_bytes,
            bit_depth,
        })
    }

    /// Rows that follow one another without padding.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn packed(
        format: PixelFormat,
        width: usize,
        height: usize,
        bit_depth: u8,
    ) -> Result<Self, PixelError> {
        let stride = width.saturating_mul(format.bytes_per_pixel());
        Self::new(format, width, height, stride, bit_depth)
    }

    /// Pixels per row.
    #[must_use]
    pub const fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    #[must_use]
    pub const fn height(&self) -> usize {
        self.height
    }

    /// Bytes a frame must have; padding after the last row may be absent.
    #[must_use]
    pub const fn frame_len(&self) -> usize {
        self.stride_bytes * (self.height - 1) + self.width * self.format.bytes_per_pixel()
    }

    /// Bytes of the frame as RGB8.
    #[must_use]
    pub const fn rgb8_len(&self) -> usize {
        self.width * self.height * 3
    }

    /// Converts `frame` to packed RGB8, rows from the top. Deep samples keep their upper 8 bits
    /// (values beyond `bit_depth` saturate); Bayer colours are interpolated bilinearly.
    ///
    /// # Errors
    /// When `frame` is shorter than [`frame_len`](Self::frame_len) or `rgb8` is not exactly
    /// [`rgb8_len`](Self::rgb8_len) bytes.
    pub fn to_rgb8(&self, frame: &[u8], rgb8: &mut [u8]) -> Result<(), PixelError> {
        if frame.len() < self.frame_len() {
            return Err(PixelError::Short {
                needed: self.frame_len(),
                actual: frame.len(),
            });
        }
        if rgb8.len() != self.rgb8_len() {
            return Err(PixelError::Output {
                needed: self.rgb8_len(),
                actual: rgb8.len(),
            });
        }
        if let Some(red_at) = self.format.red_at() {
            let size = (self.width, self.height);
            bayer::to_rgb8(frame, size, self.stride_bytes, red_at, rgb8);
            return Ok(());
        }
        let row_bytes = self.width * self.format.bytes_per_pixel();
        let rows = frame.chunks(self.stride_bytes);
        for (row, out) in rows.zip(rgb8.chunks_exact_mut(self.width * 3)) {
            self.row_to_rgb8(&row[..row_bytes], out);
        }
        Ok(())
    }

    fn row_to_rgb8(&self, row: &[u8], out: &mut [u8]) {
        let deep = |low: u8, high: u8| {
            let value = u16::from_le_bytes([low, high]) >> (self.bit_depth - 8);
            u8::try_from(value).unwrap_or(u8::MAX)
        };
        match self.format {
            PixelFormat::Mono8 => {
                for (pixel, &value) in out.chunks_exact_mut(3).zip(row) {
                    pixel.fill(value);
                }
            }
            PixelFormat::Mono16 => {
                for (pixel, word) in out.chunks_exact_mut(3).zip(row.chunks_exact(2)) {
                    pixel.fill(deep(word[0], word[1]));
                }
            }
            PixelFormat::Rgb16 => {
                for (byte, word) in out.iter_mut().zip(row.chunks_exact(2)) {
                    *byte = deep(word[0], word[1]);
                }
            }
            PixelFormat::Yuyv => {
                for (pair, quad) in out.chunks_exact_mut(6).zip(row.chunks_exact(4)) {
                    pair[..3].copy_from_slice(&rgb_from_yuv(quad[0], quad[1], quad[3]));
                    pair[3..].copy_from_slice(&rgb_from_yuv(quad[2], quad[1], quad[3]));
                }
            }
            // Bayer frames need their neighbouring rows and never come here.
            _ => out.copy_from_slice(row),
        }
    }
}

/// ITU-R BT.601 (limited range) in 16.16 fixed point, rounded to nearest and clipped.
fn rgb_from_yuv(y: u8, u: u8, v: u8) -> [u8; 3] {
    // 255/219, 1.402 * 255/224, 1.772 * 255/224, and green's shares of both (0.114 and 0.299 over
    // 0.587), each times 65,536.
    const LUMA: i32 = 76_309;
    const RED_V: i32 = 104_597;
    const BLUE_U: i32 = 132_201;
    const GREEN_U: i32 = 25_675;
    const GREEN_V: i32 = 53_279;
    let luma = (i32::from(y) - 16) * LUMA + (1 << 15);
    let (u, v) = (i32::from(u) - 128, i32::from(v) - 128);
    let clip = |value: i32| u8::try_from((value >> 16).clamp(0, 255)).unwrap_or(u8::MAX);
    [
        clip(luma + RED_V * v),
        clip(luma - GREEN_U * u - GREEN_V * v),
        clip(luma + BLUE_U * u),
    ]
}

/// Why pixels could not be converted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PixelError {
    /// A side is zero, too long, or odd where pixels come in pairs.
    #[error("image of {width}x{height}: sides must be 1 to 16384, even where pixels come in pairs")]
    Size {
        /// Pixels per row.
        width: usize,
        /// Rows.
        height: usize,
    },
    /// A row is longer than the distance between rows.
    #[error("stride of {stride_bytes} bytes is shorter than a row of {row_bytes}")]
    Stride {
        /// As given.
        stride_bytes: usize,
        /// Bytes of one row's pixels.
        row_bytes: usize,
    },
    /// Not 8, or not in `8..=16` for word samples.
    #[error("bit depth {0} does not belong to the pixel format")]
    BitDepth(u8),
    /// The frame has fewer bytes than its geometry says.
    #[error("frame is {actual} bytes, needs {needed}")]
    Short {
        /// Bytes by geometry.
        needed: usize,
        /// Bytes there.
        actual: usize,
    },
    /// The output does not have the image's size.
    #[error("output is {actual} bytes, the image has {needed}")]
    Output {
        /// Bytes of the image as RGB8.
        needed: usize,
        /// Bytes there.
        actual: usize,
    },
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn convert(layout: &ImageLayout, frame: &[u8]) -> Vec<u8> {
        let mut out = vec![0; layout.rgb8_len()];
        layout.to_rgb8(frame, &mut out).unwrap();
        out
    }

    #[test]
    fn plain_formats_keep_values_and_skip_padding() {
        let rgb = ImageLayout::new(PixelFormat::Rgb8, 1, 2, 4, 8).unwrap();
        assert_eq!(rgb.frame_len(), 7);
        assert_eq!(convert(&rgb, &[1, 2, 3, 99, 4, 5, 6]), [1, 2, 3, 4, 5, 6]);
        let mono = ImageLayout::packed(PixelFormat::Mono8, 2, 1, 8).unwrap();
        assert_eq!(convert(&mono, &[7, 9]), [7, 7, 7, 9, 9, 9]);
    }

    #[test]
    fn deep_samples_keep_their_upper_bits_and_saturate() {
        let mono = ImageLayout::packed(PixelFormat::Mono16, 3, 1, 12).unwrap();
        let frame = [0xF0, 0x0F, 0x10, 0x00, 0x00, 0xFF];
        assert_eq!(
            convert(&mono, &frame),
            [255, 255, 255, 1, 1, 1, 255, 255, 255]
        );
        let rgb = ImageLayout::packed(PixelFormat::Rgb16, 1, 1, 16).unwrap();
        assert_eq!(convert(&rgb, &[0, 1, 0, 2, 255, 3]), [1, 2, 3]);
    }

    /// Black, white and the three primaries as BT.601 defines them (rounded to whole codes, hence
    /// one step of tolerance).
    #[test]
    fn yuyv_hits_the_corner_colours() {
        let layout = ImageLayout::packed(PixelFormat::Yuyv, 2, 1, 8).unwrap();
        let corners = [
            ([16, 128, 128], [0, 0, 0]),
            ([235, 128, 128], [255, 255, 255]),
            ([81, 90, 240], [255, 0, 0]),
            ([145, 54, 34], [0, 255, 0]),
            ([41, 240, 110], [0, 0, 255]),
        ];
        for ([y, u, v], rgb) in corners {
            let out = convert(&layout, &[y, u, y, v]);
            for (k, &value) in out.iter().enumerate() {
                assert!(value.abs_diff(rgb[k % 3]) <= 1, "{y} {u} {v}: {out:?}");
            }
        }
    }

    #[test]
    fn geometry_that_cannot_be_is_refused() {
        use PixelFormat as F;
        let size = |f, w, h| ImageLayout::packed(f, w, h, 8).is_err();
        assert!(size(F::Rgb8, 0, 1) && size(F::Rgb8, 1, 16_385) && size(F::Yuyv, 3, 1));
        assert!(size(F::BayerRggb8, 2, 3) && size(F::Rgb8, usize::MAX, 1));
        assert_eq!(
            ImageLayout::new(F::Rgb8, 2, 2, 5, 8),
            Err(PixelError::Stride {
                stride_bytes: 5,
                row_bytes: 6
            })
        );
        assert_eq!(
            ImageLayout::packed(F::Mono8, 2, 2, 10),
            Err(PixelError::BitDepth(10))
        );
        let layout = ImageLayout::packed(F::Mono8, 2, 2, 8).unwrap();
        let short = layout.to_rgb8(&[0; 3], &mut [0; 12]).unwrap_err();
        assert_eq!(short.to_string(), "frame is 3 bytes, needs 4");
        let output = layout.to_rgb8(&[0; 4], &mut [0; 11]).unwrap_err();
        assert_eq!(output.to_string(), "output is 11 bytes, the image has 12");
    }

    proptest! {
        #[test]
        fn every_layout_converts_any_bytes(
            format in proptest::sample::select(vec![
                PixelFormat::Rgb8, PixelFormat::Mono8, PixelFormat::Rgb16, PixelFormat::Mono16,
                PixelFormat::Yuyv, PixelFormat::BayerRggb8, PixelFormat::BayerBggr8,
                PixelFormat::BayerGrbg8, PixelFormat::BayerGbrg8,
            ]),
            width in 1usize..12, height in 1usize..12, padding in 0usize..5, depth in 8u8..=16,
            bytes in proptest::collection::vec(any::<u8>(), 1000),
        ) {
            let stride = width * format.bytes_per_pixel() + padding;
            if let Ok(layout) = ImageLayout::new(format, width, height, stride, depth) {
                let mut out = vec![0; layout.rgb8_len()];
                layout.to_rgb8(&bytes[..layout.frame_len()], &mut out).unwrap();
            }
        }
    }
}

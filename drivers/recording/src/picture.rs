//! Pictures as PNG files: RGB8, depth in 16 bits (metres times 256), masks in 8.
//!
//! Encoding writes no stamps and no text, so the same pixels give the same bytes.

use std::fs::File;
use std::io::{BufReader, BufWriter};
use std::path::Path;

use png::{BitDepth, ColorType};

use crate::{RecordingError, WriteError};

/// Metres per unit of a depth picture (as in the KITTI depth benchmark's development kit).
const UNITS_PER_METRE: f32 = 256.0;
/// Longest side of a picture, pixels.
const SIDE_MAX: u32 = 16_384;

/// A grid of pixels, row by row from the top.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Picture<T> {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Values: one per pixel, or three (red, green, blue) in RGB pictures.
    pub data: Vec<T>,
}

/// Writes packed RGB8.
///
/// # Errors
/// When the length is not `width * height * 3`, or the file cannot be written.
pub(crate) fn write_rgb8(
    path: &Path,
    width: usize,
    height: usize,
    rgb8: &[u8],
) -> Result<(), WriteError> {
    let size = Size::new("rgb", width, height, 3, rgb8.len())?;
    encode(path, size, ColorType::Rgb, BitDepth::Eight, rgb8)
}

/// Writes depth in metres; 0 means none. Values are rounded to 1/256 m; what 16 bits cannot hold
/// (255.998 m and more, negative, not a number) becomes none.
///
/// # Errors
/// When the length is not `width * height`, or the file cannot be written.
pub(crate) fn write_depth(
    path: &Path,
    width: usize,
    height: usize,
    depth_m: &[f32],
) -> Result<(), WriteError> {
    let size = Size::new("depth", width, height, 1, depth_m.len())?;
    let bytes: Vec<u8> = depth_m
        .iter()
        .flat_map(|&m| depth_units(m).to_be_bytes())
        .collect();
    encode(path, size, ColorType::Grayscale, BitDepth::Sixteen, &bytes)
}

fn depth_units(depth_m: f32) -> u16 {
    let units = (depth_m * UNITS_PER_METRE).round();
    if depth_m > 0.0 && units <= f32::from(u16::MAX) {
        #[allow(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "in range"
        )]
        return (units as u16).max(1);
    }
    0
}

/// Writes a mask as 0 and 255.
///
/// # Errors
/// When the length is not `width * height`, or the file cannot be written.
pub(crate) fn write_mask(
    path: &Path,
    width: usize,
    height: usize,
    mask: &[bool],
) -> Result<(), WriteError> {
    let size = Size::new("mask", width, height, 1, mask.len())?;
    let bytes: Vec<u8> = mask.iter().map(|&set| u8::from(set) * 255).collect();
    encode(path, size, ColorType::Grayscale, BitDepth::Eight, &bytes)
}

/// Checked sides of a picture.
struct Size {
    width: u32,
    height: u32,
}

impl Size {
    fn new(
        what: &'static str,
        width: usize,
        height: usize,
        channels: usize,
        actual: usize,
    ) -> Result<Self, WriteError> {
        let needed = width.saturating_mul(height).saturating_mul(channels);
        let side = |len: usize| {
            u32::try_from(len)
                .ok()
                .filter(|n| (1..=SIDE_MAX).contains(n))
        };
        match (side(width), side(height)) {
            (Some(width), Some(height)) if needed == actual => Ok(Self { width, height }),
            _ => Err(WriteError::Size {
                what,
                width,
                height,
                needed,
                actual,
            }),
        }
    }
}

fn encode(
    path: &Path,
    size: Size,
    color: ColorType,
    depth: BitDepth,
    bytes: &[u8],
) -> Result<(), WriteError> {
    let file = File::create_new(path).map_err(|e| WriteError::io(path, e))?;
    let mut encoder = png::Encoder::new(BufWriter::new(file), size.width, size.height);
    encoder.set_color(color);
    encoder.set_depth(depth);
    encoder.set_compression(png::Compression::Fast);
    let mut writer = encoder
        .write_header()
        .map_err(|e| WriteError::io(path, e))?;
    writer
        .write_image_data(bytes)
        .and_then(|()| writer.finish())
        .map_err(|e| WriteError::io(path, e))
}

/// Decodes an RGB8 picture into `rgb8`, which is resized to fit and keeps its memory from one
/// picture to the next. Gives columns and rows.
///
/// # Errors
/// When the file cannot be read or is not an RGB picture of 8 bits.
pub(crate) fn read_rgb8(path: &Path, rgb8: &mut Vec<u8>) -> Result<(usize, usize), RecordingError> {
    decode(path, (ColorType::Rgb, BitDepth::Eight), rgb8)
}

/// Reads depth in metres; 0 means none.
///
/// # Errors
/// When the file cannot be read, is not a grey picture of 16 bits, or holds no depth above 1 m
/// though it holds some: then 8-bit values were stored by mistake.
pub(crate) fn read_depth(path: &Path) -> Result<Picture<f32>, RecordingError> {
    let mut bytes = Vec::new();
    let kind = (ColorType::Grayscale, BitDepth::Sixteen);
    let (width, height) = decode(path, kind, &mut bytes)?;
    let units = |pair: &[u8]| u16::from_be_bytes([pair[0], pair[1]]);
    let max = bytes.chunks_exact(2).map(units).max().unwrap_or(0);
    if (1..=255).contains(&max) {
        let problem = format!("largest value is {max}: 8-bit values in a 16-bit depth picture");
        return Err(RecordingError::picture(path, problem));
    }
    let data = bytes
        .chunks_exact(2)
        .map(|pair| f32::from(units(pair)) / UNITS_PER_METRE)
        .collect();
    Ok(Picture {
        width,
        height,
        data,
    })
}

/// Reads a mask; values from 128 on are set.
///
/// # Errors
/// When the file cannot be read or is not a grey picture of 8 bits.
pub(crate) fn read_mask(path: &Path) -> Result<Picture<bool>, RecordingError> {
    let mut bytes = Vec::new();
    let kind = (ColorType::Grayscale, BitDepth::Eight);
    let (width, height) = decode(path, kind, &mut bytes)?;
    Ok(Picture {
        width,
        height,
        data: bytes.iter().map(|&value| value >= 128).collect(),
    })
}

fn decode(
    path: &Path,
    (color, depth): (ColorType, BitDepth),
    bytes: &mut Vec<u8>,
) -> Result<(usize, usize), RecordingError> {
    let file = File::open(path).map_err(|e| RecordingError::io(path, e))?;
    let bad = |error: png::DecodingError| RecordingError::picture(path, error);
    let mut reader = png::Decoder::new(BufReader::new(file))
        .read_info()
        .map_err(bad)?;
    let (width, height) = reader.info().size();
    if width > SIDE_MAX || height > SIDE_MAX {
        let problem = format!("{width}x{height}, sides are at most {SIDE_MAX}");
        return Err(RecordingError::picture(path, problem));
    }
    let found = reader.output_color_type();
    if found != (color, depth) {
        let problem = format!("{found:?}, expected {:?}", (color, depth));
        return Err(RecordingError::picture(path, problem));
    }
    let len = reader.output_buffer_size().unwrap_or(0);
    bytes.resize(len, 0);
    reader.next_frame(bytes).map_err(bad)?;
    Ok((width as usize, height as usize))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn depth_is_rounded_to_its_unit_and_never_to_none() {
        let cases = [
            (0.0, 0),
            (1e-6, 1),
            (1.0, 256),
            (1.002, 257),
            (255.996, 65_535),
            (255.999, 0),
            (-1.0, 0),
            (f32::NAN, 0),
            (f32::INFINITY, 0),
        ];
        for (depth_m, units) in cases {
            assert_eq!(depth_units(depth_m), units, "{depth_m}");
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn damaged_pictures_are_refused_or_read_but_never_panic(
            at in any::<prop::sample::Index>(), bit in 0u8..8, len in any::<prop::sample::Index>(),
        ) {
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().join("a.png");
            write_depth(&path, 7, 5, &[3.5; 35]).unwrap();
            let whole = std::fs::read(&path).unwrap();
            let mut bytes = whole.clone();
            bytes[at.index(whole.len())] ^= 1 << bit;
            std::fs::write(&path, &bytes).unwrap();
            let _ = read_depth(&path);
            std::fs::write(&path, &whole[..len.index(whole.len())]).unwrap();
            let _ = read_depth(&path);
        }
    }
}

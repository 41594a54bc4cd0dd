//! Depth as 16-bit grey PNG, the way the KITTI depth benchmark stores it: metres times 256, 0 empty.

use super::png_file::{PngError, Raster, decode, encode};
use crate::size::{SizeError, check_len};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use thiserror::Error;

/// Codes per metre (KITTI depth development kit).
const CODES_PER_METRE: f32 = 256.0;
/// A file whose largest code is no larger was written with 8 bits by mistake.
const EIGHT_BIT_MAX: u16 = 255;

/// Why depth could not be read from or written to a PNG.
#[derive(Debug, Error)]
pub enum DepthPngError {
    /// The PNG itself.
    #[error(transparent)]
    Png(#[from] PngError),
    /// The slice is not the map it should be.
    #[error(transparent)]
    Size(#[from] SizeError),
    /// All codes fit a byte, so no depth reaches a metre.
    #[error("largest depth code is {max}: a map of 8 bits, not of 16")]
    EightBit {
        /// The largest code.
        max: u16,
    },
    /// A depth the format cannot hold.
    #[error("depth {depth_m} m at pixel {index} does not lie in 0..=255.996")]
    Depth {
        /// Pixel index.
        index: usize,
        /// The value.
        depth_m: f32,
    },
    /// What went wrong with which file.
    #[error("{}: {source}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What went wrong.
        source: Box<DepthPngError>,
    },
}

impl DepthPngError {
    /// Adds the file's name.
    fn at(path: &Path) -> impl FnOnce(Self) -> Self {
        |source| Self::File {
            path: path.to_path_buf(),
            source: Box::new(source),
        }
    }
}

/// A depth map read from a PNG.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthImage {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Metres, row by row; 0 is empty.
    pub depth_m: Vec<f32>,
}

/// Reads a depth map. A map without any value is fine; one whose largest code fits a byte is not.
pub fn read_depth_png16(input: impl Read) -> Result<DepthImage, DepthPngError> {
    let raster = decode(
        input,
        png::ColorType::Grayscale,
        png::BitDepth::Sixteen,
        "grey of 16 bits",
    )?;
    let codes = || {
        raster
            .bytes
            .chunks_exact(2)
            .map(|code| u16::from_be_bytes([code[0], code[1]]))
    };
    reject_eight_bit(codes().max().unwrap_or(0))?;
    let depth_m = codes()
        .map(|code| f32::from(code) / CODES_PER_METRE)
        .collect();
    Ok(DepthImage {
        width: raster.width,
        height: raster.height,
        depth_m,
    })
}

/// Writes a depth map in metres, rounded to the nearest 1/256 m; a value above 0 never becomes 0.
///
/// Errs, before the first byte, on a depth that is negative, not a number or above 255.996 m, and
/// on a map with no depth of a metre or more, which [`read_depth_png16`] would refuse.
pub fn write_depth_png16(
    output: impl Write,
    width: usize,
    height: usize,
    depth: &[f32],
) -> Result<(), DepthPngError> {
    check_len("depth", depth.len(), width.saturating_mul(height))?;
    let mut bytes = Vec::with_capacity(2 * depth.len());
    let mut max = 0;
    for (index, &depth_m) in depth.iter().enumerate() {
        let code = code(depth_m).ok_or(DepthPngError::Depth { index, depth_m })?;
        max = max.max(code);
        bytes.extend(code.to_be_bytes());
    }
    reject_eight_bit(max)?;
    let raster = Raster {
        width,
        height,
        bytes,
    };
    Ok(encode(
        output,
        &raster,
        png::ColorType::Grayscale,
        png::BitDepth::Sixteen,
    )?)
}

/// Reads a file as [`read_depth_png16`] does; errors name it.
pub fn load_depth_png16(path: impl AsRef<Path>) -> Result<DepthImage, DepthPngError> {
    let path = path.as_ref();
    let open = || read_depth_png16(std::fs::File::open(path).map_err(PngError::from)?);
    open().map_err(DepthPngError::at(path))
}

/// Writes a file as [`write_depth_png16`] does; errors name it, and a refused map creates none.
pub fn save_depth_png16(
    path: impl AsRef<Path>,
    width: usize,
    height: usize,
    depth: &[f32],
) -> Result<(), DepthPngError> {
    let path = path.as_ref();
    let save = || {
        let mut file = Vec::new();
        write_depth_png16(&mut file, width, height, depth)?;
        Ok(std::fs::write(path, file).map_err(PngError::from)?)
    };
    save().map_err(DepthPngError::at(path))
}

fn reject_eight_bit(max: u16) -> Result<(), DepthPngError> {
    if (1..=EIGHT_BIT_MAX).contains(&max) {
        Err(DepthPngError::EightBit { max })
    } else {
        Ok(())
    }
}

/// The code of a depth; `None` where the format has none.
fn code(depth_m: f32) -> Option<u16> {
    let code = (depth_m * CODES_PER_METRE).round();
    if !(0.0..=f32::from(u16::MAX)).contains(&code) || depth_m < 0.0 {
        return None;
    }
    Some((code as u16).max(u16::from(depth_m > 0.0)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::picture::Canvas;

    fn written(width: usize, height: usize, depth: &[f32]) -> Vec<u8> {
        let mut file = Vec::new();
        write_depth_png16(&mut file, width, height, depth).expect("a map the format holds");
        file
    }

    #[test]
    fn metres_times_256_there_and_back() {
        let depth = [0.0, 1.0, 2.5, 80.0, 255.996_1, 0.001];
        let image = read_depth_png16(&written(3, 2, &depth)[..]).expect("just written");
        assert_eq!((image.width, image.height), (3, 2));
        // The last would round to 0, which means empty: it becomes the smallest code instead.
        assert_eq!(
            image.depth_m,
            [0.0, 1.0, 2.5, 80.0, 65535.0 / 256.0, 1.0 / 256.0]
        );
    }

    #[test]
    fn maps_of_eight_bits_are_refused_both_ways() {
        let error = write_depth_png16(Vec::new(), 1, 1, &[255.0 / 256.0]).expect_err("code 255");
        assert_eq!(
            error.to_string(),
            "largest depth code is 255: a map of 8 bits, not of 16"
        );
        let mut file = Vec::new();
        let raster = Raster {
            width: 2,
            height: 1,
            bytes: vec![0, 7, 0, 255],
        };
        encode(
            &mut file,
            &raster,
            png::ColorType::Grayscale,
            png::BitDepth::Sixteen,
        )
        .expect("png");
        let error = read_depth_png16(&file[..]).expect_err("code 255");
        assert!(matches!(error, DepthPngError::EightBit { max: 255 }));
        let empty = read_depth_png16(&written(2, 1, &[0.0; 2])[..]).expect("empty is no mistake");
        assert_eq!(empty.depth_m, [0.0; 2]);
    }

    #[test]
    fn depths_the_format_lacks_are_named() {
        for (depth, text) in [
            (-1.0, "-1"),
            (256.0, "256"),
            (f32::NAN, "NaN"),
            (-1e-9, "-0.000000001"),
        ] {
            let error = write_depth_png16(Vec::new(), 2, 1, &[5.0, depth]).expect_err("no code");
            assert_eq!(
                error.to_string(),
                format!("depth {text} m at pixel 1 does not lie in 0..=255.996")
            );
        }
        let error = write_depth_png16(Vec::new(), 2, 2, &[5.0]).expect_err("one pixel of four");
        assert_eq!(error.to_string(), "depth holds 1 values, needs 4");
    }

    #[test]
    fn other_kinds_and_broken_bytes_are_errors() {
        let mut rgb = Vec::new();
        Canvas::new(2, 2, [1; 3])
            .expect("a size")
            .write_png(&mut rgb)
            .expect("in memory");
        let error = read_depth_png16(&rgb[..]).expect_err("a colour picture");
        assert_eq!(
            error.to_string(),
            "png is Rgb of 8 bits, needs grey of 16 bits"
        );
        let file = written(4, 4, &[9.0; 16]);
        assert!(Canvas::read_png(&file[..]).is_err());
        for len in 0..file.len() - 16 {
            assert!(
                read_depth_png16(&file[..len]).is_err(),
                "cut to {len} bytes"
            );
        }
    }

    #[test]
    fn errors_name_the_file() {
        let path = std::env::temp_dir()
            .join("noctule-no-such-folder")
            .join("depth.png");
        for text in [
            load_depth_png16(&path).expect_err("no file").to_string(),
            save_depth_png16(&path, 1, 1, &[5.0])
                .expect_err("no folder")
                .to_string(),
            Canvas::load_png(&path).expect_err("no file").to_string(),
        ] {
            assert!(text.contains("noctule-no-such-folder"), "{text}");
        }
    }
}

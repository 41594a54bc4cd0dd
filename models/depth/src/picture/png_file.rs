//! PNG in and out of any stream, with limits on what a stranger's file may make us allocate.

use super::canvas::{CANVAS_SIDE_MAX, Canvas, PictureError};
use std::io::{self, BufWriter, Cursor, Read, Write};
use std::path::{Path, PathBuf};
use thiserror::Error;

/// Longest PNG file read, bytes.
const FILE_LEN_MAX: u64 = 128 << 20;

/// Why a PNG could not be read or written.
#[derive(Debug, Error)]
pub enum PngError {
    /// Reading or writing the bytes failed.
    #[error("png bytes: {0}")]
    Io(#[from] io::Error),
    /// The bytes are no valid PNG.
    #[error("png decoding: {0}")]
    Decode(#[from] png::DecodingError),
    /// The encoder refused.
    #[error("png encoding: {0}")]
    Encode(#[from] png::EncodingError),
    /// The file is longer than this crate reads.
    #[error("png file is longer than {FILE_LEN_MAX} bytes")]
    Long,
    /// The picture is empty or larger than this crate holds.
    #[error(transparent)]
    Picture(#[from] PictureError),
    /// Another kind of picture than asked for.
    #[error("png is {colour:?} of {bits} bits, needs {needed}")]
    Kind {
        /// Colour type found.
        colour: png::ColorType,
        /// Bits per channel found.
        bits: u8,
        /// What was expected.
        needed: &'static str,
    },
    /// What went wrong with which file.
    #[error("{}: {source}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What went wrong.
        source: Box<PngError>,
    },
}

impl PngError {
    /// Adds the file's name.
    pub(crate) fn at(path: &Path) -> impl FnOnce(Self) -> Self {
        |source| Self::File {
            path: path.to_path_buf(),
            source: Box::new(source),
        }
    }
}

/// Pixels of a PNG as stored: big-endian where a channel has 16 bits.
pub(crate) struct Raster {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) bytes: Vec<u8>,
}

/// Decodes a PNG that must be of the given kind.
pub(crate) fn decode(
    input: impl Read,
    colour: png::ColorType,
    depth: png::BitDepth,
    needed: &'static str,
) -> Result<Raster, PngError> {
    let mut file = Vec::new();
    input.take(FILE_LEN_MAX + 1).read_to_end(&mut file)?;
    if file.len() as u64 > FILE_LEN_MAX {
        return Err(PngError::Long);
    }
    let mut reader = png::Decoder::new(Cursor::new(file)).read_info()?;
    let info = reader.info();
    if (info.color_type, info.bit_depth) != (colour, depth) {
        return Err(PngError::Kind {
            colour: info.color_type,
            bits: info.bit_depth as u8,
            needed,
        });
    }
    let (width, height) = (info.width as usize, info.height as usize);
    check_side(width, height)?;
    let mut bytes = vec![0; width * height * colour.samples() * (depth as usize / 8)];
    reader.next_frame(&mut bytes)?;
    Ok(Raster {
        width,
        height,
        bytes,
    })
}

/// Encodes a PNG.
pub(crate) fn encode(
    output: impl Write,
    raster: &Raster,
    colour: png::ColorType,
    depth: png::BitDepth,
) -> Result<(), PngError> {
    check_side(raster.width, raster.height)?;
    let mut encoder = png::Encoder::new(
        BufWriter::new(output),
        raster.width as u32,
        raster.height as u32,
    );
    encoder.set_color(colour);
    encoder.set_depth(depth);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&raster.bytes)?;
    writer.finish()?;
    Ok(())
}

fn check_side(width: usize, height: usize) -> Result<(), PictureError> {
    let fits = |side| (1..=CANVAS_SIDE_MAX).contains(&side);
    if fits(width) && fits(height) {
        Ok(())
    } else {
        Err(PictureError::Side { width, height })
    }
}

impl Canvas {
    /// Writes the canvas as an RGB PNG of 8 bits.
    pub fn write_png(&self, output: impl Write) -> Result<(), PngError> {
        let raster = Raster {
            width: self.width(),
            height: self.height(),
            bytes: self.rgb().to_vec(),
        };
        encode(output, &raster, png::ColorType::Rgb, png::BitDepth::Eight)
    }

    /// Writes the canvas to a file; errors name it.
    pub fn save_png(&self, path: impl AsRef<Path>) -> Result<(), PngError> {
        let path = path.as_ref();
        let create = || self.write_png(std::fs::File::create(path)?);
        create().map_err(PngError::at(path))
    }

    /// Reads an RGB PNG of 8 bits; any other kind is an error.
    pub fn read_png(input: impl Read) -> Result<Self, PngError> {
        let raster = decode(
            input,
            png::ColorType::Rgb,
            png::BitDepth::Eight,
            "rgb of 8 bits",
        )?;
        Ok(Self::from_rgb(raster.width, raster.height, raster.bytes)?)
    }

    /// Reads a file as [`Canvas::read_png`] does; errors name it.
    pub fn load_png(path: impl AsRef<Path>) -> Result<Self, PngError> {
        let path = path.as_ref();
        let open = || Self::read_png(std::fs::File::open(path)?);
        open().map_err(PngError::at(path))
    }
}

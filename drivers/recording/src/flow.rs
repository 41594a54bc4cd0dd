//! Optical flow as NumPy files: `f32`, shape [2, H, W].

use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::Path;

use npyz::{NpyFile, WriterBuilder};

use crate::{Picture, RecordingError, WriteError};

/// Writes flow: all horizontal components (pixels, to the right), then all vertical (down).
///
/// # Errors
/// When the length is not `2 * width * height`, or the file cannot be written.
pub(crate) fn write_flow(
    path: &Path,
    width: usize,
    height: usize,
    flow_px: &[f32],
) -> Result<(), WriteError> {
    let needed = width.saturating_mul(height).saturating_mul(2);
    if flow_px.len() != needed || needed == 0 {
        return Err(WriteError::Size {
            what: "flow",
            width,
            height,
            needed,
            actual: flow_px.len(),
        });
    }
    let error = |e| WriteError::io(path, e);
    let file = File::create_new(path).map_err(error)?;
    let mut buffered = BufWriter::new(file);
    let mut writer = npyz::WriteOptions::new()
        .default_dtype()
        .shape(&[2, height as u64, width as u64])
        .writer(&mut buffered)
        .begin_nd()
        .map_err(error)?;
    writer.extend(flow_px.iter().copied()).map_err(error)?;
    writer.finish().map_err(error)?;
    buffered.flush().map_err(error)
}

/// Reads flow as [`write_flow`] orders it; two values per pixel.
///
/// # Errors
/// When the file cannot be read or is not `f32` of shape [2, H, W].
pub(crate) fn read_flow(path: &Path) -> Result<Picture<f32>, RecordingError> {
    let bytes = fs::read(path).map_err(|e| RecordingError::io(path, e))?;
    let bad = |problem: String| RecordingError::picture(path, problem);
    let file = NpyFile::new(&bytes[..]).map_err(|e| bad(e.to_string()))?;
    let &[2, height, width] = file.shape() else {
        return Err(bad(format!("shape {:?}, expected [2, H, W]", file.shape())));
    };
    if file.order() != npyz::Order::C {
        return Err(bad("stored column by column".to_owned()));
    }
    let (Ok(width), Ok(height)) = (usize::try_from(width), usize::try_from(height)) else {
        return Err(bad(format!("{width}x{height} does not fit into memory")));
    };
    // A header may promise more than the file holds.
    if width.saturating_mul(height).saturating_mul(8) > bytes.len() {
        return Err(bad(format!(
            "{} bytes hold no {width}x{height}",
            bytes.len()
        )));
    }
    let data = file.into_vec().map_err(|e| bad(e.to_string()))?;
    Ok(Picture {
        width,
        height,
        data,
    })
}

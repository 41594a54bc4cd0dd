//! NYU Depth v2 pre-processed to one HDF5 file a frame: `rgb`, u8 `[3, 480, 640]`, and `depth`, f32
//! `[480, 640]` in metres.

use std::path::Path;

use hdf5_reader::error::Error;
use hdf5_reader::{Hdf5File, OpenOptions};
use noctule_depth::{Canvas, DepthImage};

use super::error::ReadError;
use super::files;

/// Longest file read, bytes; one holds 2,150,400 bytes of pixels.
const FILE_LEN_MAX: u64 = 64 << 20;
/// Longest field read, bytes.
const FIELD_LEN_MAX: usize = 64 << 20;

/// Reads picture and depth of one file; depth that is no number, or not above 0, is none.
///
/// # Errors
/// [`ReadError`], naming the file and the field that is missing, damaged or of another shape.
pub fn read_nyu_still(path: &Path) -> Result<(Canvas, DepthImage), ReadError> {
    let fault = |fault: String| ReadError::content(path, fault);
    let bytes = files::bytes(path, FILE_LEN_MAX)?;
    let options = OpenOptions::default()
        .with_max_chunk_bytes(FIELD_LEN_MAX)
        .with_max_read_bytes(FIELD_LEN_MAX);
    let file = Hdf5File::from_vec_with_options(bytes, options)
        .map_err(|error| fault(error.to_string()))?;
    let field = |name: &str| {
        let field = file.dataset(name);
        field.map_err(|error| fault(format!("{name}: {error}")))
    };
    let (rgb, depth) = (field("rgb")?, field("depth")?);
    let ([3, height, width], [map_height, map_width]) = (rgb.shape(), depth.shape()) else {
        let (rgb, depth) = (rgb.shape(), depth.shape());
        return Err(fault(format!(
            "rgb is {rgb:?} and depth {depth:?}, wanted [3, 480, 640] and [480, 640]"
        )));
    };
    let side = |side: &u64| usize::try_from(*side).unwrap_or(usize::MAX);
    let (width, height) = (side(width), side(height));
    let (map_width, map_height) = (side(map_width), side(map_height));
    let unread = |name: &str| {
        let name = name.to_owned();
        move |error: Error| fault(format!("{name}: {error}"))
    };
    let planes: Vec<u8> = rgb
        .read_array()
        .map_err(unread("rgb"))?
        .into_iter()
        .collect();
    let metres: Vec<f32> = depth
        .read_array()
        .map_err(unread("depth"))?
        .into_iter()
        .collect();
    let area = planes.len() / 3;
    let pixel = |i: usize| [planes[i], planes[area + i], planes[2 * area + i]];
    let picture = Canvas::from_rgb(width, height, (0..area).flat_map(pixel).collect());
    Ok((
        picture.map_err(|error| fault(error.to_string()))?,
        DepthImage {
            width: map_width,
            height: map_height,
            depth_m: metres.into_iter().map(measured).collect(),
        },
    ))
}

/// Depth in metres where it is above 0, otherwise 0: none.
pub(super) fn measured(depth_m: f32) -> f32 {
    if depth_m > 0.0 && depth_m.is_finite() {
        depth_m
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use hdf5_writer::{DatasetBuilder, Hdf5Builder, WriteOptions};

    use super::*;

    fn file(rgb: Vec<u64>, depth: Vec<u64>) -> Vec<u8> {
        let len = |shape: &[u64]| usize::try_from(shape.iter().product::<u64>()).expect("small");
        let codes: Vec<u8> = (0..=255).cycle().take(len(&rgb)).collect();
        let mut metres = vec![2.5_f32; len(&depth)];
        metres[0] = f32::NAN;
        metres[1] = -1.0;
        let plan = Hdf5Builder::new()
            .dataset(DatasetBuilder::typed_data("rgb", rgb, &codes).expect("a field"))
            .dataset(DatasetBuilder::typed_data("depth", depth, &metres).expect("a field"))
            .into_plan();
        let bytes = plan.expect("a file").encode(WriteOptions::default());
        bytes.expect("bytes")
    }

    #[test]
    fn planes_become_pixels_and_faults_are_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("00001.h5");
        let bytes = file(vec![3, 2, 3], vec![2, 3]);
        fs::write(&path, &bytes).expect("written");
        let (picture, depth) = read_nyu_still(&path).expect("a frame");
        assert_eq!((picture.width(), picture.height()), (3, 2));
        assert_eq!(picture.pixel(1, 0), Some([1, 7, 13]));
        assert_eq!(depth.depth_m, [0.0, 0.0, 2.5, 2.5, 2.5, 2.5]);
        assert_eq!((depth.width, depth.height), (3, 2));
        let error = |bytes: &[u8]| {
            fs::write(&path, bytes).expect("written");
            let error = read_nyu_still(&path).expect_err("damaged").to_string();
            assert!(error.contains("00001.h5: "), "{error}");
            error
        };
        let wrong = error(&file(vec![2, 3, 3], vec![2, 3]));
        assert!(
            wrong.contains("rgb is [2, 3, 3] and depth [2, 3]"),
            "{wrong}"
        );
        error(b"no HDF5");
        // Every shortened file is refused, or is whole where it matters; none panics.
        for len in 0..bytes.len() {
            fs::write(&path, &bytes[..len]).expect("written");
            if let Ok((picture, _)) = read_nyu_still(&path) {
                assert_eq!(picture.width(), 3);
            }
        }
    }
}

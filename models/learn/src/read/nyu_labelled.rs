//! NYU Depth v2's labelled set: `nyu_depth_v2_labeled.mat`, MATLAB's HDF5, and `splits.mat`, which
//! says which of its frames are for testing.
//!
//! MATLAB stores columns first. What its users know as `images(row, column, channel, frame)` is
//! `[frame, channel, column, row]` in the file, u8; `depths` is `[frame, column, row]`, f32, metres,
//! with holes painted in by the authors.

use std::path::Path;

use hdf5_reader::error::Error;
use hdf5_reader::{Dataset, Hdf5File, OpenOptions, SliceInfo, SliceInfoElem};
use matfile::{MatFile, NumericData};
use noctule_depth::{Canvas, DepthImage};

use super::error::ReadError;
use super::files;
use super::nyu_still::measured;

/// Longest chunk and longest frame read, bytes; a picture has 921,600.
const FRAME_LEN_MAX: usize = 64 << 20;
/// Longest list of frames read, bytes; it is compressed, and may hold a thousand times as much.
const SPLITS_LEN_MAX: u64 = 64 << 10;

/// The frames that are for testing, counted from 1, in the order of the file.
///
/// # Errors
/// [`ReadError`], naming the file, when it is no MATLAB file of level 5, or its `testNdxs` is
/// missing, empty or holds what is no frame number.
pub fn nyu_test_frames(splits: &Path) -> Result<Vec<u32>, ReadError> {
    let fault = |fault: String| ReadError::content(splits, fault);
    let bytes = files::bytes(splits, SPLITS_LEN_MAX)?;
    let file = MatFile::parse(bytes.as_slice())
        .map_err(|error| fault(format!("is no MATLAB file of level 5: {error}")))?;
    let numbers: Vec<f64> = match file.find_by_name("testNdxs").map(matfile::Array::data) {
        Some(NumericData::Double { real, .. }) => real.clone(),
        Some(NumericData::UInt16 { real, .. }) => real.iter().map(|n| f64::from(*n)).collect(),
        Some(NumericData::UInt8 { real, .. }) => real.iter().map(|n| f64::from(*n)).collect(),
        Some(_) => return Err(fault("testNdxs: wanted whole numbers".into())),
        None => return Err(fault("has no testNdxs".into())),
    };
    if numbers.is_empty() {
        return Err(fault("testNdxs is empty".into()));
    }
    let frame = |number: f64| {
        let is_frame = number.fract() == 0.0 && (1.0..=f64::from(u32::MAX)).contains(&number);
        is_frame
            .then_some(number as u32)
            .ok_or_else(|| fault(format!("testNdxs: {number} is no frame, wanted 1 and more")))
    };
    numbers.into_iter().map(frame).collect()
}

/// Reads picture and depth of one frame, counted from 1; depth that is no number, or not above 0,
/// is none. Only this frame is read, not the file's gigabytes.
///
/// # Errors
/// [`ReadError`], naming the file and the field that is missing, damaged or of another shape.
pub fn read_nyu_labelled(path: &Path, frame: u32) -> Result<(Canvas, DepthImage), ReadError> {
    let fault = |fault: String| ReadError::content(path, fault);
    let set = LabelledSet::open(path)?;
    let (width, height) = (set.width, set.height);
    let index = u64::from(frame).wrapping_sub(1);
    if index >= set.frames {
        return Err(fault(format!("frame {frame} of {} wanted", set.frames)));
    }
    let unread = |field: &'static str| {
        move |error: Error| fault(format!("{field} of frame {frame}: {error}"))
    };
    let codes = set.images.read_slice::<u8>(&one_of(index, 4));
    let codes: Vec<u8> = codes.map_err(unread("images"))?.into_iter().collect();
    let metres = set.depths.read_slice::<f32>(&one_of(index, 3));
    let metres: Vec<f32> = metres.map_err(unread("depths"))?.into_iter().collect();
    let area = width * height;
    // From columns first to rows first.
    let cells = || (0..area).map(|i| (i % width) * height + i / width);
    let pixels = cells().flat_map(|cell| [0, area, 2 * area].map(|plane| codes[plane + cell]));
    let picture = Canvas::from_rgb(width, height, pixels.collect());
    Ok((
        picture.map_err(|error| fault(error.to_string()))?,
        DepthImage {
            width,
            height,
            depth_m: cells().map(|cell| measured(metres[cell])).collect(),
        },
    ))
}

/// The first of `rank` dimensions at `index`, and all of the others.
fn one_of(index: u64, rank: usize) -> SliceInfo {
    let mut slice = SliceInfo::all(rank);
    slice.selections[0] = SliceInfoElem::Slice {
        start: index,
        end: index + 1,
        step: 1,
    };
    slice
}

/// The two fields that are read, of sizes that fit each other.
struct LabelledSet {
    images: Dataset,
    depths: Dataset,
    frames: u64,
    width: usize,
    height: usize,
}

impl LabelledSet {
    fn open(path: &Path) -> Result<Self, ReadError> {
        let fault = |fault: String| ReadError::content(path, fault);
        let options = OpenOptions::default()
            .with_max_chunk_bytes(FRAME_LEN_MAX)
            .with_max_read_bytes(FRAME_LEN_MAX);
        let file =
            Hdf5File::open_with_options(path, options).map_err(|error| fault(error.to_string()))?;
        let field = |name: &str| {
            let field = file.dataset(name);
            field.map_err(|error| fault(format!("{name}: {error}")))
        };
        let (images, depths) = (field("images")?, field("depths")?);
        let (&[frames, 3, width, height], &[maps, columns, rows]) =
            (images.shape(), depths.shape())
        else {
            return Err(fault(shapes(&images, &depths)));
        };
        if (frames, width, height) != (maps, columns, rows) {
            return Err(fault(shapes(&images, &depths)));
        }
        let side = |side: u64| usize::try_from(side).unwrap_or(usize::MAX);
        Ok(Self {
            frames,
            width: side(width),
            height: side(height),
            images,
            depths,
        })
    }
}

fn shapes(images: &Dataset, depths: &Dataset) -> String {
    let (images, depths) = (images.shape(), depths.shape());
    format!("images is {images:?} and depths {depths:?}, wanted [N, 3, 640, 480] and [N, 640, 480]")
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::PathBuf;

    use proptest::prelude::*;

    use super::*;

    /// Five frames of 6 x 4 pixels, written by other libraries (h5py 3.16 with a user block of 512
    /// bytes and compressed chunks, scipy 1.16), whose pixel is 100 channel + 20 frame + 4 row +
    /// column and whose depth is 1 + frame + row / 4 + column / 32 metres, frames counted from 0.
    fn stored(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("tests/nyu_labelled")
            .join(name)
    }

    #[test]
    fn columns_become_rows() {
        let path = stored("nyu_depth_v2_labeled.mat");
        let (picture, depth) = read_nyu_labelled(&path, 3).expect("a frame");
        assert_eq!((picture.width(), picture.height()), (6, 4));
        assert_eq!((depth.width, depth.height), (6, 4));
        for (row, column) in [(0, 0), (1, 5), (3, 2)] {
            let code = (40 + 4 * row + column) as u8;
            assert_eq!(
                picture.pixel(column, row),
                Some([code, code + 100, code + 200])
            );
        }
        assert_eq!(depth.depth_m[6 + 2], 3.0 + 0.25 + 2.0 / 32.0);
        // No depth at all, and no number.
        assert_eq!([depth.depth_m[0], depth.depth_m[3 * 6 + 5]], [0.0, 0.0]);
        for frame in [0, 6] {
            let error = read_nyu_labelled(&path, frame).expect_err("no such frame");
            let text = error.to_string();
            assert!(
                text.contains(&format!("frame {frame} of 5 wanted")),
                "{text}"
            );
        }
    }

    #[test]
    fn the_frames_for_testing_are_listed() {
        assert_eq!(
            nyu_test_frames(&stored("splits.mat")).expect("a list"),
            [3, 5]
        );
        let set = stored("nyu_depth_v2_labeled.mat");
        let error = nyu_test_frames(&set).expect_err("another kind").to_string();
        assert!(error.contains("is no MATLAB file of level 5"), "{error}");
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(128))]
        /// A changed or shortened file is another frame or an error that names it, never a panic.
        #[test]
        fn damage_is_an_error(at in any::<prop::sample::Index>(), flip in 1..=255_u8, cut in any::<bool>()) {
            let folder = tempfile::tempdir().expect("a folder");
            for name in ["nyu_depth_v2_labeled.mat", "splits.mat"] {
                let mut bytes = fs::read(stored(name)).expect("stored");
                let at = at.index(bytes.len());
                match cut {
                    true => bytes.truncate(at),
                    false => bytes[at] ^= flip,
                }
                let path = folder.path().join(name);
                fs::write(&path, bytes).expect("written");
                let error = match name {
                    "splits.mat" => nyu_test_frames(&path).err(),
                    _ => read_nyu_labelled(&path, 3).err(),
                };
                if let Some(error) = error {
                    prop_assert!(error.to_string().contains(name), "{error}");
                }
            }
        }
    }
}

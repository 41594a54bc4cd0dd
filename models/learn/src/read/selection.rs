//! The benchmark's selections of single frames, cropped to 1216 x 352, with intrinsics.
//!
//! ```text
//! val_selection_cropped/{image,velodyne_raw,groundtruth_depth,intrinsics}/
//!     2011_09_26_drive_0002_sync_{image|velodyne_raw|groundtruth_depth}_0000000005_image_02.png
//!     intrinsics: 2011_09_26_drive_0002_sync_image_0000000005_image_02.txt
//! test_depth_completion_anonymous/{image,velodyne_raw,intrinsics}/0000000000.png, .txt
//! ```

use std::path::{Path, PathBuf};

use noctule_depth::{Canvas, DepthImage, Ground, load_depth_png16};

use super::calibration::road;
use super::error::ReadError;
use super::files;

/// A folder of single frames.
#[derive(Debug, Clone)]
pub struct Selection {
    folder: PathBuf,
    stems: Vec<String>,
}

/// One frame of a selection, all of one size.
#[derive(Debug, Clone)]
pub struct SelectedFrame {
    /// The picture.
    pub picture: Canvas,
    /// The projected scan.
    pub sparse: DepthImage,
    /// The truth; `None` in the benchmark's test selection.
    pub truth: Option<DepthImage>,
    /// Focal lengths and principal point in this crop: `[fx, fy, cx, cy]`, pixels.
    pub pinhole: [f64; 4],
}

impl Selection {
    /// Lists the selection at `folder`, or the one named `val_selection_cropped` in it.
    ///
    /// # Errors
    /// [`ReadError`], when a folder of the layout is missing or a picture is called otherwise.
    pub fn open(folder: &Path) -> Result<Self, ReadError> {
        let folder = files::first_folder([folder.join("val_selection_cropped")])
            .unwrap_or_else(|| folder.into());
        for part in ["image", "velodyne_raw", "intrinsics"] {
            if !folder.join(part).is_dir() {
                return Err(ReadError::missing(&folder, format!("folder {part}")));
            }
        }
        let images = folder.join("image");
        let mut stems = Vec::new();
        for name in files::names(&images)? {
            let stem = name.strip_suffix(".png").filter(|stem| is_frame(stem));
            let fault = || format!("{name:?} is not called like a frame of a selection");
            stems.push(
                stem.ok_or_else(|| ReadError::content(&images, fault()))?
                    .to_owned(),
            );
        }
        Ok(Self { folder, stems })
    }

    /// Whether this looks like a selection, or holds `val_selection_cropped`.
    pub fn is_at(folder: &Path) -> bool {
        let is_one = |at: &Path| at.join("image").is_dir() && at.join("velodyne_raw").is_dir();
        is_one(folder) || is_one(&folder.join("val_selection_cropped"))
    }

    /// How many frames it has.
    pub fn len(&self) -> usize {
        self.stems.len()
    }

    /// Whether it has none.
    pub fn is_empty(&self) -> bool {
        self.stems.is_empty()
    }

    /// The name of a frame's picture, without its extension; `None` beyond the last.
    pub fn name(&self, index: usize) -> Option<&str> {
        self.stems.get(index).map(String::as_str)
    }

    /// Reads a frame.
    ///
    /// # Errors
    /// [`ReadError`], when a file of it is missing or damaged, sizes differ, or there is no such
    /// frame.
    pub fn read(&self, index: usize) -> Result<SelectedFrame, ReadError> {
        let stem = self
            .name(index)
            .ok_or_else(|| ReadError::missing(&self.folder, format!("frame number {index}")))?;
        let depth = |kind: &str| {
            let named = stem.replacen("_image_", &format!("_{kind}_"), 1);
            self.folder.join(kind).join(format!("{named}.png"))
        };
        let picture = Canvas::load_png(self.folder.join("image").join(format!("{stem}.png")))?;
        let size = (picture.width(), picture.height());
        let fitting = |path: PathBuf| -> Result<DepthImage, ReadError> {
            let map = load_depth_png16(&path)?;
            match (map.width, map.height) == size {
                true => Ok(map),
                false => Err(ReadError::content(
                    &path,
                    format!(
                        "is {}x{} pixels, its picture {}x{}",
                        map.width, map.height, size.0, size.1
                    ),
                )),
            }
        };
        let has_truth = self.folder.join("groundtruth_depth").is_dir();
        let intrinsics = self.folder.join("intrinsics").join(format!("{stem}.txt"));
        let k: [f64; 9] = files::numbers(&files::text(&intrinsics)?)
            .map_err(|fault| ReadError::content(&intrinsics, fault))?;
        if !(k[0] > 0.0 && k[4] > 0.0) {
            let fault = format!("focal lengths are {} and {}", k[0], k[4]);
            return Err(ReadError::content(&intrinsics, fault));
        }
        Ok(SelectedFrame {
            sparse: fitting(depth("velodyne_raw"))?,
            truth: has_truth
                .then(|| fitting(depth("groundtruth_depth")))
                .transpose()?,
            picture,
            pinhole: [k[0], k[4], k[2], k[5]],
        })
    }
}

impl SelectedFrame {
    /// Level ground in the picture.
    pub fn ground(&self) -> Option<Ground> {
        road(self.pinhole)
    }
}

/// `DRIVE_image_0000000005_image_02`, or ten digits.
fn is_frame(stem: &str) -> bool {
    let named = || {
        let (drive, rest) = stem.split_once("_image_")?;
        let (number, camera) = rest.split_once('_')?;
        let is_camera = matches!(camera, "image_02" | "image_03");
        Some(
            super::drive::is_drive_name(drive)
                && is_camera
                && files::frame_number(number).is_some(),
        )
    };
    files::frame_number(stem).is_some() || named().unwrap_or(false)
}

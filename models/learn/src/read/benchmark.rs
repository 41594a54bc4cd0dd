//! The depth completion benchmark: drives of projected scans and accumulated ground truth.
//!
//! ```text
//! {train|val}/2011_09_26_drive_0001_sync/proj_depth/{velodyne_raw|groundtruth}/image_02/0000000005.png
//! ```
//!
//! The same below `data_depth_velodyne/` and `data_depth_annotated/`, as the benchmark's archives
//! unpack. Pictures lie in the raw drives (`raw/`, `kitti_raw/`) or merged beside `proj_depth`.

use std::path::{Path, PathBuf};

use noctule_depth::{Canvas, DepthImage, load_depth_png16};

use super::calibration::ColourCamera;
use super::drive::{is_drive_name, raw_drive_folders};
use super::error::ReadError;
use super::files;

/// A part of the benchmark; parts share no drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Split {
    /// 138 drives in the original.
    Train,
    /// 13 drives in the original.
    Validation,
}

impl Split {
    const fn folder(self) -> &'static str {
        match self {
            Self::Train => "train",
            Self::Validation => "val",
        }
    }
}

/// One drive of the benchmark, as one colour camera saw it.
#[derive(Debug, Clone)]
pub struct BenchmarkDrive {
    name: String,
    pictures: PathBuf,
    sparse: PathBuf,
    truth: PathBuf,
    frames: Vec<u32>,
}

/// All drives of one part that have ground truth, sorted by name; none where the part is absent.
///
/// # Errors
/// [`ReadError`], when a drive with ground truth lacks projected scans or pictures.
pub fn benchmark_drives(
    root: &Path,
    split: Split,
    camera: ColourCamera,
) -> Result<Vec<BenchmarkDrive>, ReadError> {
    let part = split.folder();
    let below = |place: &str| root.join(place).join(part);
    let Some(annotated) = files::first_folder([below("data_depth_annotated"), root.join(part)])
    else {
        return Ok(Vec::new());
    };
    let sparse = [below("data_depth_velodyne"), root.join(part)];
    let raw = raw_drive_folders(root)?;
    let mut drives = Vec::new();
    for name in files::names(&annotated)? {
        let depth = |place: &Path, kind: &str| {
            place
                .join(&name)
                .join("proj_depth")
                .join(kind)
                .join(camera.folder())
        };
        let truth = depth(&annotated, "groundtruth");
        if !is_drive_name(&name) || !truth.is_dir() {
            continue;
        }
        let sparse =
            files::first_folder(sparse.iter().map(|place| depth(place, "velodyne_raw")))
                .ok_or_else(|| ReadError::missing(root, format!("velodyne_raw of drive {name}")))?;
        let beside = sparse_drive(&annotated, &sparse, &name);
        let pictures = raw.iter().filter(|folder| folder.ends_with(&name)).cloned();
        let pictures = pictures
            .chain(beside)
            .map(|drive| drive.join(camera.folder()).join("data"));
        let pictures = files::first_folder(pictures)
            .ok_or_else(|| ReadError::missing(root, format!("pictures of drive {name}")))?;
        drives.push(BenchmarkDrive::new(name, pictures, sparse, truth)?);
    }
    Ok(drives)
}

/// Folders that pictures may have been merged into: the drive among the truth, and among scans.
fn sparse_drive(annotated: &Path, sparse: &Path, name: &str) -> Vec<PathBuf> {
    let among_scans = sparse.ancestors().nth(3).map(Path::to_path_buf);
    std::iter::once(annotated.join(name))
        .chain(among_scans)
        .collect()
}

impl BenchmarkDrive {
    fn new(
        name: String,
        pictures: PathBuf,
        sparse: PathBuf,
        truth: PathBuf,
    ) -> Result<Self, ReadError> {
        let with_picture = files::frames(&pictures, "png")?;
        let with_sparse = files::frames(&sparse, "png")?;
        let mut frames = files::frames(&truth, "png")?;
        frames.retain(|frame| {
            with_sparse.binary_search(frame).is_ok() && with_picture.binary_search(frame).is_ok()
        });
        Ok(Self {
            name,
            pictures,
            sparse,
            truth,
            frames,
        })
    }

    /// `2011_09_26_drive_0001_sync`.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Numbers of the frames that have picture, scan and truth, ascending. The benchmark has no
    /// truth for the first and the last five frames of a drive.
    pub fn frames(&self) -> &[u32] {
        &self.frames
    }

    /// Whether the frame has a picture, be there truth or not.
    pub fn has_picture(&self, frame: u32) -> bool {
        files::frame_path(&self.pictures, frame, "png").is_file()
    }

    /// Reads one picture.
    ///
    /// # Errors
    /// [`ReadError`], when it is missing or not RGB of 8 bits.
    pub fn picture(&self, frame: u32) -> Result<Canvas, ReadError> {
        Ok(Canvas::load_png(files::frame_path(
            &self.pictures,
            frame,
            "png",
        ))?)
    }

    /// Reads the projected scan of one frame.
    ///
    /// # Errors
    /// [`ReadError`], when it is missing or no depth map.
    pub fn sparse(&self, frame: u32) -> Result<DepthImage, ReadError> {
        Ok(load_depth_png16(files::frame_path(
            &self.sparse,
            frame,
            "png",
        ))?)
    }

    /// Reads the ground truth of one frame.
    ///
    /// # Errors
    /// [`ReadError`], when it is missing or no depth map.
    pub fn truth(&self, frame: u32) -> Result<DepthImage, ReadError> {
        Ok(load_depth_png16(files::frame_path(
            &self.truth,
            frame,
            "png",
        ))?)
    }
}

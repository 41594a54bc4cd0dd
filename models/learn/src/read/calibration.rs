//! KITTI's calibration files, and where a LiDAR point falls in a picture.

use std::path::Path;

use noctule_depth::Ground;

use super::error::ReadError;
use super::files;

/// How high the cameras stand above the road, metres (the recording car's drawing).
const CAMERA_HEIGHT_M: f64 = 1.65;

/// One of the two colour cameras.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ColourCamera {
    /// `image_02`.
    #[default]
    Left,
    /// `image_03`.
    Right,
}

impl ColourCamera {
    /// Its folder's name.
    pub const fn folder(self) -> &'static str {
        match self {
            Self::Left => "image_02",
            Self::Right => "image_03",
        }
    }

    const fn projection_key(self) -> &'static str {
        match self {
            Self::Left => "P_rect_02",
            Self::Right => "P_rect_03",
        }
    }
}

/// From Velodyne points to pixels of one rectified colour camera:
/// `P_rect * R_rect_00 * [R | T]` (KITTI raw development kit, section "Velodyne to image").
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Calibration {
    /// Homogeneous: the third row is depth in metres.
    image_from_velodyne: [[f64; 4]; 3],
    projection: [[f64; 4]; 3],
}

/// Where a point falls.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Projected {
    /// Column, pixels; the centre of the first is 0.
    pub u: f64,
    /// Row, pixels; the centre of the first is 0.
    pub v: f64,
    /// Along the camera's axis, metres, above 0.
    pub depth_m: f64,
}

impl Calibration {
    /// Reads `calib_cam_to_cam.txt` and `calib_velo_to_cam.txt` of a recording day.
    ///
    /// # Errors
    /// [`ReadError`], naming the file and the line's key.
    pub fn read(day: &Path, camera: ColourCamera) -> Result<Self, ReadError> {
        let (cameras, velodyne) = (
            day.join("calib_cam_to_cam.txt"),
            day.join("calib_velo_to_cam.txt"),
        );
        let (camera_text, velodyne_text) = (files::text(&cameras)?, files::text(&velodyne)?);
        let projection: [f64; 12] = line(&cameras, &camera_text, camera.projection_key())?;
        let rectify: [f64; 9] = line(&cameras, &camera_text, "R_rect_00")?;
        let rotation: [f64; 9] = line(&velodyne, &velodyne_text, "R")?;
        let translation: [f64; 3] = line(&velodyne, &velodyne_text, "T")?;
        Ok(Self::new(projection, rectify, rotation, translation))
    }

    /// From the files' numbers, row by row.
    pub fn new(
        projection: [f64; 12],
        rectify: [f64; 9],
        rotation: [f64; 9],
        translation: [f64; 3],
    ) -> Self {
        let projection = std::array::from_fn(|r| std::array::from_fn(|c| projection[4 * r + c]));
        let rectified = widened(rectify, [0.0; 3]);
        let from_velodyne = widened(rotation, translation);
        Self {
            image_from_velodyne: product(&product(&projection, &rectified), &from_velodyne),
            projection,
        }
    }

    /// Where a point (metres, Velodyne frame) falls; `None` behind the camera, or for what is no
    /// place at all.
    pub fn project(&self, point: [f32; 3]) -> Option<Projected> {
        let [x, y, z] = point.map(f64::from);
        let row = |r: usize| {
            let [a, b, c, d] = self.image_from_velodyne[r];
            a * x + b * y + c * z + d
        };
        let depth_m = row(2);
        let found = Projected {
            u: row(0) / depth_m,
            v: row(1) / depth_m,
            depth_m,
        };
        let is_seen = depth_m > 0.0 && found.u.is_finite() && found.v.is_finite();
        (is_seen && depth_m.is_finite()).then_some(found)
    }

    /// Focal lengths and principal point of the rectified camera: `[fx, fy, cx, cy]`, pixels.
    pub fn pinhole(&self) -> [f64; 4] {
        let p = &self.projection;
        [p[0][0], p[1][1], p[0][2], p[1][2]]
    }

    /// Level ground in the rectified pictures, whose cameras all stand 1.65 m above the road.
    pub fn ground(&self) -> Option<Ground> {
        road(self.pinhole())
    }
}

/// The road beneath a rectified camera, `pinhole` as [`Calibration::pinhole`] gives it.
pub(super) fn road([fx, fy, cx, cy]: [f64; 4]) -> Option<Ground> {
    Ground::beneath(CAMERA_HEIGHT_M, [0.0, 1.0, 0.0], [fx, fy], [cx, cy])
}

/// The numbers behind `KEY:`.
fn line<const N: usize>(path: &Path, text: &str, key: &str) -> Result<[f64; N], ReadError> {
    let rest = text
        .lines()
        .find_map(|line| line.strip_prefix(key)?.strip_prefix(':'))
        .ok_or_else(|| ReadError::missing(path, format!("line {key}:")))?;
    files::numbers(rest).map_err(|fault| ReadError::content(path, format!("{key}: {fault}")))
}

/// A rotation and a translation as a 4 x 4 matrix.
fn widened(rotation: [f64; 9], translation: [f64; 3]) -> [[f64; 4]; 4] {
    let mut wide = [[0.0; 4]; 4];
    for r in 0..3 {
        wide[r][..3].copy_from_slice(&rotation[3 * r..][..3]);
        wide[r][3] = translation[r];
    }
    wide[3][3] = 1.0;
    wide
}

fn product(a: &[[f64; 4]; 3], b: &[[f64; 4]; 4]) -> [[f64; 4]; 3] {
    std::array::from_fn(|r| std::array::from_fn(|c| (0..4).map(|i| a[r][i] * b[i][c]).sum()))
}

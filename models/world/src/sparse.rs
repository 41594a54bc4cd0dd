//! The LiDAR's depth at step centres, drawn by the same code the vehicle runs, with the true
//! times of the returns.

use std::time::Duration;

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion};
use noctule_hesai::{Correction, Model};
use noctule_raster::{
    Channel, Distortion, EgoPolicy, Grid, Pinhole, RasterError, SparseConfig, SparseRaster,
};
use noctule_recording::{Calibration, Pose};
use noctule_sensor::{Stamp, Tai};

use crate::optics::Optics;

/// Passes kept: an exposure of 0.7 s spans 7, and the one before it.
const PASSES: usize = 12;

/// A drawer of sparse depth maps on a square grid of the rig's camera.
///
/// # Errors
/// When the calibration lets no beam meet the image.
pub(crate) fn drawer(
    calibration: &Calibration,
    optics: &Optics,
) -> Result<SparseRaster, RasterError> {
    let (focal, centre) = (f64::from(optics.focal_px), f64::from(optics.centre_px));
    let side = optics.size as u32;
    let channels = Correction::nominal(Model::Qt64)
        .lasers()
        .iter()
        .map(|laser| Channel {
            elevation_deg: laser.elevation_deg,
            azimuth_offset_deg: laser.azimuth_deg,
        })
        .collect();
    SparseRaster::new(&SparseConfig {
        camera: Pinhole::new(focal, focal, centre, centre, Distortion::default())?,
        grid: Grid::new(side, side),
        camera_from_lidar: isometry(&calibration.camera_from_lidar),
        lidar_from_vehicle: isometry(&calibration.vehicle_from_lidar).inverse(),
        channels,
        rotation: Duration::from_millis(100),
        passes: PASSES,
        points_max: 20_000,
        range_min_m: 1.0,
        margin_deg: 2.0,
        motion_samples: 512,
        motion_reach: Duration::from_millis(50),
    })
}

/// Draws the maps of all `centres`, `[T, H, W]`; where the vehicle's motion is unknown the
/// returns stay where they were.
pub(crate) fn draw(
    raster: &mut SparseRaster,
    centres: impl Iterator<Item = Stamp<Tai>>,
) -> Result<Vec<f32>, RasterError> {
    let len = raster.map_len();
    let mut maps = Vec::new();
    for centre in centres {
        let start = maps.len();
        maps.resize(start + len, 0.0);
        raster.draw(centre, EgoPolicy::Compensate, &mut maps[start..])?;
    }
    Ok(maps)
}

fn isometry(pose: &Pose) -> Isometry3<f64> {
    let rows = pose.rotation;
    let matrix = Matrix3::from_fn(|i, j| rows[i][j]);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(matrix));
    let [x, y, z] = pose.translation_m;
    Isometry3::from_parts(Translation3::new(x, y, z), rotation)
}

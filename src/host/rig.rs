//! What the host must know of a vehicle before the first byte: geometry, clocks, which streams.

use std::time::Duration;

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use noctule_depth::Ground;
use noctule_hesai::{Correction, Model};
use noctule_raster::{
    Channel, Crop, Distortion, Grid, Pinhole, PixelMap, RasterError, Rescale, SparseConfig,
};
use noctule_recording::{Calibration, EventsMeta, Lens, Meta, Pose, Rectangle, StrobePolarity};

use crate::config::{Active, Config};
use crate::frame::BundleLayout;
use crate::sync::{
    BundleConfig, EnvelopeConfig, SensorClock, Stream, Streams, StrobeConfig, TimelineConfig,
    TrackerConfig,
};

/// TAI minus UTC since 2017, taken only as long as no clock reading has told.
const TAI_OFFSET_ASSUMED_NS: i64 = 37_000_000_000;
/// Complete LiDAR passes kept: ten turns cover a second-long exposure.
const PASSES: usize = 12;
/// Returns in one pass over the camera's field of view, at most.
const PASS_POINTS_MAX: usize = 65_536;
/// Motion kept: ten seconds at 100 Hz.
const MOTION_SAMPLES: usize = 1024;
/// How far motion is extrapolated beyond its samples.
const MOTION_REACH: Duration = Duration::from_millis(200);

/// Why a rig cannot be run.
#[derive(Debug, thiserror::Error)]
pub enum RigError {
    /// A geometry that no raster can be made for.
    #[error("calibration: {0}")]
    Geometry(#[from] RasterError),
    /// Neither events nor LiDAR: nothing tells when an exposure is.
    #[error("neither an event camera nor a LiDAR: there is nothing to run")]
    NoSensor,
}

/// What tells when an exposure is.
#[derive(Debug, Clone, Copy)]
pub enum ExposureSource {
    /// The camera's strobe on the event camera's trigger input.
    Strobe(TrackerConfig),
    /// A period of the event camera's counter.
    Periodic {
        /// From opening to opening.
        period: Duration,
        /// From opening to closing.
        width: Duration,
    },
    /// One exposure per LiDAR sweep.
    Sweeps,
}

/// Everything the assembler is built from.
#[derive(Debug, Clone)]
pub struct Rig {
    /// Layout of the bundles.
    pub layout: BundleLayout,
    /// Largest depth, metres.
    pub depth_m_max: f32,
    /// How clocks get onto TAI.
    pub timeline: TimelineConfig,
    /// What tells when an exposure is.
    pub exposures: ExposureSource,
    /// When bundles close.
    pub bundles: BundleConfig,
    /// From event pixels to grid cells; absent without an event camera.
    pub voxels: Option<PixelMap>,
    /// Geometry of the sparse depth; absent without a LiDAR.
    pub sparse: Option<SparseConfig>,
    /// From image pixels to the grid; absent without a camera.
    pub image: Option<Rescale>,
    /// Level ground in the picture, where the calibration has any beneath the camera.
    pub ground: Option<Ground>,
    /// Header's image encoding.
    pub encoding: u32,
    /// Header's bits per sample.
    pub bit_depth: u32,
    /// Events kept for rastering again.
    pub history_events: usize,
    /// Image leases the assembler may hold at once.
    pub images_held: usize,
}

impl Rig {
    /// The rig of a recording. Without a calibration the default rig's geometry is assumed.
    ///
    /// `correction` is the LiDAR's table, if there is a LiDAR.
    ///
    /// # Errors
    /// When its geometry cannot be rastered or nothing tells when an exposure is.
    pub fn new(
        config: &Config,
        meta: &Meta,
        calibration: Option<&Calibration>,
        correction: Option<&Correction>,
    ) -> Result<Self, RigError> {
        let layout = config.bundle_layout();
        let grid = Grid::new(config.grid.width, config.grid.height);
        let assumed = Calibration::default_rig();
        let known = calibration.unwrap_or(&assumed);
        let image = image_rescale(meta, known, grid)?;
        let camera = pinhole(&known.camera)?.rescaled(&image);
        let voxels = match &meta.events {
            Some(events) if calibration.is_some() => {
                Some(event_map(events, known, &image, &camera, grid)?)
            }
            Some(events) => Some(centred_square(events, grid)?),
            None => None,
        };
        let sparse = correction.map(|table| sparse_config(camera, grid, known, table));
        let exposures = exposure_source(config, meta)?;
        let mut enabled = Streams::NONE;
        if meta.events.is_some() {
            enabled = enabled.with(Stream::Events);
        }
        if meta.lidar.is_some() {
            enabled = enabled.with(Stream::Lidar);
        }
        if meta.camera.is_some() && matches!(exposures, ExposureSource::Strobe(_)) {
            enabled = enabled.with(Stream::Images);
        }
        let deadline_ns = i64::from(config.budget.bundle_ms) * 1_000_000;
        Ok(Self {
            layout,
            depth_m_max: config.grid.depth_m_max,
            timeline: timeline(&exposures, known),
            exposures,
            bundles: BundleConfig {
                enabled,
                deadline_ns,
                pending_max: 4,
                ..BundleConfig::default()
            },
            voxels,
            sparse,
            image: meta.camera.as_ref().map(|_| image),
            ground: ground(known, &camera),
            encoding: meta.camera.as_ref().map_or(0, |c| c.encoding as u32),
            bit_depth: meta.camera.as_ref().map_or(8, |c| c.bit_depth.into()),
            history_events: config.lanes.history_events,
            images_held: config.lanes.images.saturating_sub(2).max(1),
        })
    }

    /// The nominal correction table of a model, by the name configuration and recordings use.
    #[must_use]
    pub fn correction_of(model: &str) -> Option<Correction> {
        Model::from_name(model).map(Correction::nominal)
    }
}

fn timeline(exposures: &ExposureSource, calibration: &Calibration) -> TimelineConfig {
    let delay = |ns: u64| i64::try_from(ns).unwrap_or(0);
    let delays = &calibration.delays_ns;
    let arrivals = |base: EnvelopeConfig, fixed_delay_ns| {
        SensorClock::Arrivals(EnvelopeConfig {
            fixed_delay_ns,
            ..base
        })
    };
    let base = TimelineConfig::free_running();
    TimelineConfig {
        // Without an event camera its counter stands for TAI itself.
        evk4: match exposures {
            ExposureSource::Sweeps => SensorClock::Offset(0),
            _ => arrivals(EnvelopeConfig::usb(), delay(delays.events)),
        },
        lidar: arrivals(EnvelopeConfig::udp(), delay(delays.lidar)),
        tai_offset_ns: Some(TAI_OFFSET_ASSUMED_NS),
        ..base
    }
}

fn exposure_source(config: &Config, meta: &Meta) -> Result<ExposureSource, RigError> {
    let Some(events) = &meta.events else {
        return meta
            .lidar
            .as_ref()
            .map(|_| ExposureSource::Sweeps)
            .ok_or(RigError::NoSensor);
    };
    let strobe = &config.strobe;
    let Some(wired) = &events.strobe else {
        return Ok(ExposureSource::Periodic {
            period: Duration::from_millis(strobe.virtual_period_ms.into()),
            width: Duration::from_millis(strobe.virtual_width_ms.into()),
        });
    };
    // A recording knows how it was wired; the configuration adds what it was told on top.
    let inverted = wired.polarity == StrobePolarity::ActiveLow;
    let strobe = StrobeConfig {
        channel: Some(wired.channel),
        is_inverted: inverted != (strobe.active == Active::Low),
        open_delay_ns: wired.open_delay_ns + i64::from(strobe.open_delay_us) * 1000,
        close_delay_ns: wired.close_delay_ns + i64::from(strobe.close_delay_us) * 1000,
        ..StrobeConfig::default()
    };
    Ok(ExposureSource::Strobe(TrackerConfig {
        strobe,
        ..TrackerConfig::default()
    }))
}

fn image_rescale(
    meta: &Meta,
    calibration: &Calibration,
    grid: Grid,
) -> Result<Rescale, RasterError> {
    let lens = &calibration.camera;
    let sensor = Grid::new(lens.width, lens.height);
    let asked = meta.crop;
    // A recording without a camera carries no usable crop: the default rig's whole image.
    let whole = meta.camera.is_none() || asked.width == 0;
    let crop = if whole { sensor.whole() } else { crop(asked) };
    Rescale::new(sensor, crop, grid)
}

fn crop(r: Rectangle) -> Crop {
    Crop {
        x: r.x,
        y: r.y,
        width: r.width,
        height: r.height,
    }
}

fn pinhole(lens: &Lens) -> Result<Pinhole, RasterError> {
    let d = &lens.distortion;
    let distortion = Distortion {
        k1: d.k1,
        k2: d.k2,
        p1: d.p1,
        p2: d.p2,
        k3: d.k3,
    };
    Pinhole::new(lens.fx, lens.fy, lens.cx, lens.cy, distortion)
}

/// The vehicle stands on the plane z = 0 of its own frame.
fn ground(calibration: &Calibration, camera: &Pinhole) -> Option<Ground> {
    let vehicle_from_camera = isometry(&calibration.vehicle_from_lidar)
        * isometry(&calibration.camera_from_lidar).inverse();
    let height_m = vehicle_from_camera.translation.z;
    let down = vehicle_from_camera
        .rotation
        .inverse_transform_vector(&-Vector3::z());
    let ((fx, fy), (cx, cy)) = (camera.focal(), camera.centre());
    Ground::beneath(height_m, down.into(), [fx, fy], [cx, cy])
}

fn isometry(pose: &Pose) -> Isometry3<f64> {
    let [x, y, z] = pose.translation_m;
    let rotation = Matrix3::from_fn(|row, column| pose.rotation[row][column]);
    // The calibration was checked to be orthonormal.
    let rotation =
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    Isometry3::from_parts(Translation3::new(x, y, z), rotation)
}

/// Event pixels to cells: a plain crop where the two lenses differ by a whole-pixel shift, a table
/// through both lenses otherwise.
fn event_map(
    meta: &EventsMeta,
    calibration: &Calibration,
    image: &Rescale,
    camera: &Pinhole,
    grid: Grid,
) -> Result<PixelMap, RasterError> {
    let sensor = Grid::new(meta.width, meta.height);
    let (events, rgb) = (&calibration.events.lens, &calibration.camera);
    let rotation = isometry(&calibration.camera_from_events).rotation;
    if let Some(crop) = shifted_crop(events, rgb, &rotation, image.crop()) {
        return Ok(PixelMap::rescaled(&Rescale::new(sensor, crop, grid)?));
    }
    PixelMap::rotated(sensor, &pinhole(events)?, camera, &rotation, grid)
}

fn shifted_crop(
    events: &Lens,
    rgb: &Lens,
    rotation: &UnitQuaternion<f64>,
    crop: Crop,
) -> Option<Crop> {
    let near = |a: f64, b: f64| (a - b).abs() < 1e-6;
    let same = near(events.fx, rgb.fx)
        && near(events.fy, rgb.fy)
        && rotation.angle() < 1e-9
        && events.distortion == rgb.distortion;
    let (dx, dy) = (events.cx - rgb.cx, events.cy - rgb.cy);
    if !(same && near(dx, dx.round()) && near(dy, dy.round())) {
        return None;
    }
    let shifted = |at: u32, by: f64| {
        let at = f64::from(at) + by.round();
        // Checked to be a whole number that fits.
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "in range"
        )]
        (0.0..=f64::from(u32::MAX))
            .contains(&at)
            .then_some(at as u32)
    };
    let (x, y) = (shifted(crop.x, dx)?, shifted(crop.y, dy)?);
    let fits = x + crop.width <= events.width && y + crop.height <= events.height;
    fits.then_some(Crop { x, y, ..crop })
}

/// The largest square in the middle of the sensor: the view of an event camera alone.
fn centred_square(meta: &EventsMeta, grid: Grid) -> Result<PixelMap, RasterError> {
    let side = meta.width.min(meta.height);
    let crop = Crop {
        x: (meta.width - side) / 2,
        y: (meta.height - side) / 2,
        width: side,
        height: side,
    };
    Ok(PixelMap::rescaled(&Rescale::new(
        Grid::new(meta.width, meta.height),
        crop,
        grid,
    )?))
}

fn sparse_config(
    camera: Pinhole,
    grid: Grid,
    calibration: &Calibration,
    correction: &Correction,
) -> SparseConfig {
    let channels = correction.lasers().iter().map(|laser| Channel {
        elevation_deg: laser.elevation_deg,
        azimuth_offset_deg: laser.azimuth_deg,
    });
    SparseConfig {
        camera,
        grid,
        camera_from_lidar: isometry(&calibration.camera_from_lidar),
        lidar_from_vehicle: isometry(&calibration.vehicle_from_lidar).inverse(),
        channels: channels.collect(),
        rotation: Duration::from_millis(100),
        passes: PASSES,
        points_max: PASS_POINTS_MAX,
        range_min_m: 0.5,
        margin_deg: 1.0,
        motion_samples: MOTION_SAMPLES,
        motion_reach: MOTION_REACH,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_rig_stands_on_the_ground() {
        let rig = Calibration::default_rig();
        let camera = pinhole(&rig.camera).expect("a camera");
        let ground = ground(&rig, &camera).expect("ground beneath it");
        // 1.5 m up and level: 10 m ahead lies 0.15 focal lengths below the axis.
        let (column, row) = (rig.camera.cx + 40.0, rig.camera.cy + 0.15 * rig.camera.fy);
        #[expect(clippy::cast_possible_truncation, reason = "pixels")]
        let found = ground.inverse_depth(column as f32, row as f32);
        assert!((found - 0.1).abs() < 1e-6, "{found}");
        assert!(ground.per_row > 0.0 && ground.per_column.abs() < 1e-9);
    }

    #[test]
    fn a_camera_that_looks_up_sees_its_horizon_further_down() {
        let mut rig = Calibration::default_rig();
        let camera = pinhole(&rig.camera).expect("a camera");
        let (sin, cos) = 0.1_f64.sin_cos();
        // Turned about its own x axis, y down: up is from z towards -y.
        let nod = [[1.0, 0.0, 0.0], [0.0, cos, sin], [0.0, -sin, cos]];
        let old = rig.camera_from_lidar;
        rig.camera_from_lidar.rotation = std::array::from_fn(|r| {
            std::array::from_fn(|c| (0..3).map(|k| nod[r][k] * old.rotation[k][c]).sum())
        });
        rig.camera_from_lidar.translation_m =
            std::array::from_fn(|r| (0..3).map(|k| nod[r][k] * old.translation_m[k]).sum());
        let ground = ground(&rig, &camera).expect("ground beneath it");
        let horizon = -f64::from(ground.first) / f64::from(ground.per_row);
        let wanted = rig.camera.cy + 0.1_f64.tan() * rig.camera.fy;
        assert!(
            (horizon - wanted).abs() < 0.01,
            "{horizon}, wanted {wanted}"
        );
    }
}

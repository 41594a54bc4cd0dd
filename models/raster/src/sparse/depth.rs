//! The newest pass, moved to a step's centre and projected into the image.

use std::time::Duration;

use nalgebra::{Isometry3, Point3};
use noctule_sensor::{Return, Stamp, Tai};

use super::motion::EgoMotion;
use super::passes::PassTracker;
use super::window::{AzimuthWindow, Channel};
use crate::error::check_len;
use crate::geometry::grid_cell;
use crate::{Grid, Pinhole, RasterError};

/// What a [`SparseRaster`] needs to know of the rig; everything is fixed while it lives.
#[derive(Debug, Clone)]
pub struct SparseConfig {
    /// The image camera, in pixels of `grid` ([`Pinhole::rescaled`]).
    pub camera: Pinhole,
    /// Size of the depth maps.
    pub grid: Grid,
    /// From the LiDAR's frame (x right, y to azimuth zero, z up) to the camera's (x right, y down,
    /// z forward), metres.
    pub camera_from_lidar: Isometry3<f64>,
    /// From the vehicle's frame (x forward, y left, z up) to the LiDAR's, metres.
    pub lidar_from_vehicle: Isometry3<f64>,
    /// The LiDAR's correction table, first channel first.
    pub channels: Vec<Channel>,
    /// Nominal time of one turn.
    pub rotation: Duration,
    /// Complete passes to keep: the turns in the longest exposure, and two more.
    pub passes: usize,
    /// Most returns of one pass.
    pub points_max: usize,
    /// Nearest thing whose parallax the window must hold, metres.
    pub range_min_m: f64,
    /// Widening of the window on both sides, degrees.
    pub margin_deg: f64,
    /// Motion samples to keep.
    pub motion_samples: usize,
    /// How far motion may be extrapolated beyond its samples.
    pub motion_reach: Duration,
}

/// Whether returns are moved by the vehicle's own motion.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum EgoPolicy {
    /// As the motion log says; an error where it does not reach.
    #[default]
    Compensate,
    /// Not at all: for a rig that stands, or one without a motion log.
    Still,
}

/// What a depth map was made of; `returns = drawn + hidden + outside`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SparseReport {
    /// The pass it shows; `None` when none had ended, and the map is empty.
    pub pass: Option<u64>,
    /// How long before the step's centre that pass ended, nanoseconds.
    pub age_ns: u64,
    /// Returns of that pass.
    pub returns: u32,
    /// Pixels that hold a depth.
    pub drawn: u32,
    /// Returns behind a nearer one in the same pixel.
    pub hidden: u32,
    /// Returns behind the camera or outside the image.
    pub outside: u32,
    /// Widest gap of the pass, hundredths of a degree of block azimuth.
    pub gap_cdeg_max: u32,
    /// Farthest the motion log was extrapolated, nanoseconds; 0 when it covered everything.
    pub extrapolated_ns: u64,
}

/// The points of one slot of the tracker, in the odometry's frame.
#[derive(Debug)]
struct Placed {
    /// Pass they belong to; 0 for none.
    pass: u64,
    points: Vec<Point3<f64>>,
    /// Farthest extrapolation among them; only points without any stay as they are.
    extrapolated_ns: u64,
}

/// Turns returns and the vehicle's motion into sparse depth maps.
#[derive(Debug)]
pub struct SparseRaster {
    camera: Pinhole,
    grid: Grid,
    camera_from_lidar: Isometry3<f64>,
    lidar_from_vehicle: Isometry3<f64>,
    tracker: PassTracker,
    motion: EgoMotion,
    placed: Vec<Placed>,
}

impl SparseRaster {
    /// Allocates everything it will ever need.
    ///
    /// # Errors
    /// [`RasterError`], naming the setting that does not work.
    pub fn new(config: &SparseConfig) -> Result<Self, RasterError> {
        config.grid.check("grid")?;
        let window = AzimuthWindow::new(
            &config.camera,
            config.grid,
            &config.camera_from_lidar,
            &config.channels,
            config.range_min_m,
            config.margin_deg,
        )?;
        let tracker = PassTracker::new(window, config.rotation, config.passes, config.points_max)?;
        let points = || Vec::with_capacity(config.points_max);
        let placed = || Placed {
            pass: 0,
            points: points(),
            extrapolated_ns: 0,
        };
        Ok(Self {
            camera: config.camera,
            grid: config.grid,
            camera_from_lidar: config.camera_from_lidar,
            lidar_from_vehicle: config.lidar_from_vehicle,
            tracker,
            motion: EgoMotion::new(config.motion_samples, config.motion_reach)?,
            placed: (0..=config.passes).map(|_| placed()).collect(),
        })
    }

    /// Takes a return, fired at `at`, in order of arrival.
    #[inline]
    pub fn push_return(&mut self, at: Stamp<Tai>, echo: &Return) {
        self.tracker.push(at, echo);
    }

    /// Notes the raw azimuth of a block, returns or not ([`PassTracker::note_block`]).
    pub fn note_block(&mut self, at: Stamp<Tai>, block_cdeg: u32) {
        self.tracker.note_block(at, block_cdeg);
    }

    /// Takes a motion sample.
    ///
    /// # Errors
    /// As [`EgoMotion::push`].
    pub fn push_motion(
        &mut self,
        at: Stamp<Tai>,
        speed_mps: f32,
        yaw_rate_rps: f32,
    ) -> Result<(), RasterError> {
        self.motion.push(at, speed_mps, yaw_rate_rps)
    }

    /// Forgets the vehicle's motion, as after a step of its clock.
    pub fn clear_motion(&mut self) {
        self.motion.clear();
        self.placed.iter_mut().for_each(|placed| placed.pass = 0);
    }

    /// The passes behind it, and their counts.
    #[must_use]
    pub const fn tracker(&self) -> &PassTracker {
        &self.tracker
    }

    /// The motion log behind it.
    #[must_use]
    pub const fn motion(&self) -> &EgoMotion {
        &self.motion
    }

    /// Elements of one map, `[height, width]`.
    #[must_use]
    pub const fn map_len(&self) -> usize {
        self.grid.cells()
    }

    /// Draws the sparse depth of the step whose centre is `centre` into `out`, `f32 [H, W]`, metres
    /// along the camera's axis, 0 where there is no return. Nothing of what `out` held stays.
    ///
    /// # Errors
    /// [`RasterError::Length`] for another size of `out`; [`RasterError::NoMotion`] and
    /// [`RasterError::NotCovered`], when the motion log does not reach (`out` is then all zero).
    pub fn draw(
        &mut self,
        centre: Stamp<Tai>,
        policy: EgoPolicy,
        out: &mut [f32],
    ) -> Result<SparseReport, RasterError> {
        check_len("depth map", self.map_len(), out.len())?;
        out.fill(0.0);
        let Some(slot) = self.tracker.slot_before(centre) else {
            return Ok(SparseReport::default());
        };
        let pass = self.tracker.slot_pass(slot);
        let mut report = SparseReport {
            pass: Some(pass.id()),
            age_ns: centre.diff_nanos(pass.ended()).unsigned_abs(),
            returns: pass.points().len() as u32, // at most 10^6
            gap_cdeg_max: pass.gap_cdeg_max(),
            ..SparseReport::default()
        };
        match policy {
            EgoPolicy::Still => {
                let points = pass
                    .points()
                    .iter()
                    .map(|point| Point3::from(point.xyz_m.map(f64::from)));
                project(
                    &self.camera,
                    self.grid,
                    &self.camera_from_lidar,
                    points,
                    out,
                    &mut report,
                );
            }
            EgoPolicy::Compensate => {
                let odometry_from_vehicle = self.motion.odometry_from_vehicle(centre, &mut 0)?;
                let vehicle_from_odometry = odometry_from_vehicle.inverse().to_isometry();
                let camera_from_odometry =
                    self.camera_from_lidar * self.lidar_from_vehicle * vehicle_from_odometry;
                self.place(slot)?;
                let placed = &self.placed[slot];
                report.extrapolated_ns = placed.extrapolated_ns.max(self.motion.beyond_ns(centre));
                let points = placed.points.iter().copied();
                project(
                    &self.camera,
                    self.grid,
                    &camera_from_odometry,
                    points,
                    out,
                    &mut report,
                );
            }
        }
        Ok(report)
    }

    /// Moves the points of a pass into the odometry's frame, once per pass.
    fn place(&mut self, slot: usize) -> Result<(), RasterError> {
        let pass = self.tracker.slot_pass(slot);
        let placed = &mut self.placed[slot];
        if placed.pass == pass.id() && placed.extrapolated_ns == 0 {
            return Ok(());
        }
        placed.pass = 0;
        placed.points.clear();
        placed.extrapolated_ns = 0;
        let vehicle_from_lidar = self.lidar_from_vehicle.inverse().to_matrix();
        let mut near = 0;
        for point in pass.points() {
            let odometry_from_vehicle = self.motion.odometry_from_vehicle(point.at, &mut near)?;
            let p = vehicle_from_lidar.transform_point(&Point3::from(point.xyz_m.map(f64::from)));
            let (x, y) = odometry_from_vehicle.apply(p.x, p.y);
            placed.points.push(Point3::new(x, y, p.z));
            placed.extrapolated_ns = placed.extrapolated_ns.max(self.motion.beyond_ns(point.at));
        }
        placed.pass = pass.id();
        Ok(())
    }
}

/// Projects points and keeps the nearest one of each pixel.
fn project(
    camera: &Pinhole,
    grid: Grid,
    camera_from_points: &Isometry3<f64>,
    points: impl Iterator<Item = Point3<f64>>,
    out: &mut [f32],
    report: &mut SparseReport,
) {
    let matrix = camera_from_points.to_matrix();
    for point in points {
        let seen = matrix.transform_point(&point);
        let Some(cell) = camera
            .project(&seen)
            .and_then(|pixel| grid_cell(grid, pixel))
        else {
            report.outside += 1;
            continue;
        };
        let (depth_m, pixel) = (seen.z as f32, &mut out[cell as usize]);
        if *pixel == 0.0 {
            report.drawn += 1;
            *pixel = depth_m;
        } else {
            report.hidden += 1;
            *pixel = pixel.min(depth_m);
        }
    }
}

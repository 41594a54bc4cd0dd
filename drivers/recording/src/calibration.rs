//! What was measured about a rig before it drove: lenses, poses, constant delays.
//!
//! Plain numbers, checked once; no linear algebra beyond applying a pose.

use std::fs;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::{FieldError, Pose, RecordingError};

/// The version of `calib.toml` that this crate reads and writes.
pub const CALIBRATION_SCHEMA: u64 = 1;

/// A rectangle of pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rectangle {
    /// Leftmost column.
    pub x: u32,
    /// Topmost row.
    pub y: u32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

impl Rectangle {
    /// Checks that the rectangle is not empty and lies within `width` x `height` pixels.
    pub(crate) fn validate_within(self, width: u32, height: u32) -> Result<(), FieldError> {
        let fits = |at: u32, len: u32, max: u32| {
            len > 0 && at.checked_add(len).is_some_and(|end| end <= max)
        };
        if fits(self.x, self.width, width) && fits(self.y, self.height, height) {
            return Ok(());
        }
        let value = format!("{}x{}+{}+{}", self.width, self.height, self.x, self.y);
        Err(FieldError::new(
            "rectangle",
            value,
            "empty or outside the image",
        ))
    }
}

/// Coefficients of the Brown-Conrady model, on normalised image coordinates (as in OpenCV).
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Distortion {
    /// Radial, r^2.
    pub k1: f64,
    /// Radial, r^4.
    pub k2: f64,
    /// Tangential.
    pub p1: f64,
    /// Tangential.
    pub p2: f64,
    /// Radial, r^6.
    pub k3: f64,
}

/// A lens and the grid of pixels behind it.
///
/// Whole pixel coordinates are pixel centres: (0, 0) is the centre of the top-left pixel, so a grid
/// of `width` columns spans -0.5 to `width` - 0.5. The camera frame is x right, y down, z forward.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lens {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Focal length, pixels, horizontally.
    pub fx: f64,
    /// Focal length, pixels, vertically.
    pub fy: f64,
    /// Column of the optical axis.
    pub cx: f64,
    /// Row of the optical axis.
    pub cy: f64,
    /// Distortion; absent means none.
    #[serde(default)]
    pub distortion: Distortion,
}

impl Lens {
    fn validate(&self) -> Result<(), FieldError> {
        if !(1..=16_384).contains(&self.width) {
            return Err(FieldError::new("width", self.width, "not in 1..=16384"));
        }
        if !(1..=16_384).contains(&self.height) {
            return Err(FieldError::new("height", self.height, "not in 1..=16384"));
        }
        for (field, value) in [("fx", self.fx), ("fy", self.fy)] {
            if !(value.is_finite() && value > 0.0) {
                return Err(FieldError::new(field, value, "not a positive number"));
            }
        }
        let d = self.distortion;
        let finite = [
            ("cx", self.cx),
            ("cy", self.cy),
            ("distortion.k1", d.k1),
            ("distortion.k2", d.k2),
            ("distortion.p1", d.p1),
            ("distortion.p2", d.p2),
            ("distortion.k3", d.k3),
        ];
        for (field, value) in finite {
            if !value.is_finite() {
                return Err(FieldError::new(field, value, "not finite"));
            }
        }
        Ok(())
    }
}

/// The event camera's lens and which of its pixels are read out.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EventLens {
    /// The lens over the whole sensor; events carry whole-sensor coordinates.
    pub lens: Lens,
    /// The sensor's hardware region of interest.
    pub roi: Rectangle,
}

/// Fixed parts of each stream's delay from sensor to arrival stamp, nanoseconds. Arrivals alone
/// cannot show them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Delays {
    /// From the last event of a transfer.
    pub events: u64,
    /// From the last firing of a packet.
    pub lidar: u64,
    /// From the end of the exposure to the frame's arrival.
    pub camera: u64,
    /// From the measured instant to the frame's arrival.
    pub can: u64,
}

/// A calibrated rig.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Calibration {
    /// Version of the file's format, [`CALIBRATION_SCHEMA`].
    pub schema: u64,
    /// Angle correction table of this very LiDAR (Hesai CSV), beside the recording; absent means
    /// the model's nominal table.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lidar_angles: Option<String>,
    /// The RGB camera.
    pub camera: Lens,
    /// The event camera.
    pub events: EventLens,
    /// From the LiDAR's frame (x right, y to raw azimuth zero, z up) to the RGB camera's.
    pub camera_from_lidar: Pose,
    /// From the event camera's frame to the RGB camera's.
    pub camera_from_events: Pose,
    /// From the LiDAR's frame to the vehicle's: x forward, y left, z up, origin on the ground at
    /// the point whose velocity is the bus's forward speed.
    pub vehicle_from_lidar: Pose,
    /// Fixed delays, nanoseconds.
    pub delays_ns: Delays,
}

#[derive(Deserialize)]
struct SchemaOnly {
    schema: u64,
}

impl Calibration {
    /// The synthetic rig, as `config/calibration/default.toml` describes it.
    ///
    /// # Panics
    /// Never: the text is part of the program and tested.
    #[must_use]
    pub fn default_rig() -> Self {
        let text = include_str!("../../../config/calibration/default.toml");
        Self::parse(text, Path::new("default.toml")).expect("the built-in calibration is valid")
    }

    /// Reads and checks a calibration file.
    ///
    /// # Errors
    /// When the file cannot be read, is of another version, or holds a value that cannot be.
    pub fn load(path: &Path) -> Result<Self, RecordingError> {
        let text = fs::read_to_string(path).map_err(|e| RecordingError::io(path, e))?;
        Self::parse(&text, path)
    }

    /// As [`load`](Self::load), from text; `path` is for errors.
    ///
    /// # Errors
    /// When the text is of another version or holds a value that cannot be.
    pub fn parse(text: &str, path: &Path) -> Result<Self, RecordingError> {
        let syntax = |error: toml::de::Error| RecordingError::toml(path, text, &error);
        let found = toml::from_str::<SchemaOnly>(text).map_err(syntax)?.schema;
        if found != CALIBRATION_SCHEMA {
            return Err(RecordingError::Schema {
                path: path.to_owned(),
                found,
                supported: CALIBRATION_SCHEMA,
            });
        }
        let calibration: Self = toml::from_str(text).map_err(syntax)?;
        calibration
            .validate()
            .map_err(|e| RecordingError::field(path, e))?;
        Ok(calibration)
    }

    /// Checks every number.
    ///
    /// # Errors
    /// Names the field, its value and what is wrong.
    pub fn validate(&self) -> Result<(), FieldError> {
        if self.schema != CALIBRATION_SCHEMA {
            return Err(FieldError::new("schema", self.schema, "another version"));
        }
        if let Some(name) = &self.lidar_angles
            && (!name.ends_with(".csv") || name.starts_with('.') || name.contains(['/', '\\']))
        {
            return Err(FieldError::new(
                "lidar_angles",
                name,
                "not the name of a .csv file",
            ));
        }
        self.camera.validate().map_err(|e| e.within("camera"))?;
        let lens = &self.events.lens;
        lens.validate().map_err(|e| e.within("events.lens"))?;
        self.events
            .roi
            .validate_within(lens.width, lens.height)
            .map_err(|e| e.within("events.roi"))?;
        let poses = [
            ("camera_from_lidar", &self.camera_from_lidar),
            ("camera_from_events", &self.camera_from_events),
            ("vehicle_from_lidar", &self.vehicle_from_lidar),
        ];
        for (name, pose) in poses {
            pose.validate().map_err(|e| e.within(name))?;
        }
        let delays = self.delays_ns;
        for (field, value) in [
            ("delays_ns.events", delays.events),
            ("delays_ns.lidar", delays.lidar),
            ("delays_ns.camera", delays.camera),
            ("delays_ns.can", delays.can),
        ] {
            if value >= 10_000_000_000 {
                return Err(FieldError::new(field, value, "ten seconds or more"));
            }
        }
        Ok(())
    }

    /// The file's text; the same numbers give the same bytes, and they read back exactly.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("numbers, names and tables have a toml form")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_rig_is_where_its_comments_say() {
        let rig = Calibration::default_rig();
        let focal = 256.0 / 26f64.to_radians().tan();
        assert!((rig.camera.fx - focal).abs() < 1e-9);
        assert_eq!(rig.camera.fx, rig.events.lens.fy);
        // The region of interest is centred on the optical axis, like the camera's grid.
        let roi = rig.events.roi;
        assert_eq!(rig.events.lens.cx - f64::from(roi.x), rig.camera.cx);
        assert_eq!(rig.events.lens.cy - f64::from(roi.y), rig.camera.cy);
        assert_eq!(rig.camera_from_lidar.translation_m, [0.0, -0.25, -0.10]);
        // Straight ahead of the LiDAR is ahead of the camera, a degree off.
        let [x, y, z] = rig.camera_from_lidar.apply([0.0, 10.0, 0.0]);
        assert!(x.abs() < 0.3 && y.abs() < 0.5 && z > 9.8, "{x} {y} {z}");
        // The camera stands 1.5 m above the vehicle's origin and looks along x.
        let vehicle_from_camera = rig
            .vehicle_from_lidar
            .compose(&rig.camera_from_lidar.inverse());
        let ahead = vehicle_from_camera.apply([1.0, 0.0, 10.0]);
        for (value, expected) in ahead.into_iter().zip([10.0, -1.0, 1.5]) {
            assert!((value - expected).abs() < 1e-9, "{ahead:?}");
        }
    }

    #[test]
    fn a_calibration_is_written_and_read_back_to_the_last_bit() {
        let mut rig = Calibration::default_rig();
        rig.camera.distortion.k3 = 1.0 / 3.0;
        rig.lidar_angles = Some("angles.csv".to_owned());
        let read = Calibration::parse(&rig.to_toml(), Path::new("calib.toml")).unwrap();
        assert_eq!(read, rig);
    }
}

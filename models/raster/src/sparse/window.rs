//! The part of the LiDAR's circle a camera can see.
//!
//! The LiDAR's frame of reference: x right, y to azimuth zero, z up; azimuth grows clockwise seen
//! from above, with time. Azimuths are hundredths of a degree (cdeg), `0..36_000`.

use nalgebra::{Isometry3, Point3};

use crate::{Grid, Pinhole, RasterError};

/// One turn, hundredths of a degree.
pub(super) const TURN_CDEG: u32 = 36_000;
/// How far an azimuth may step back without being taken for a new turn: rounding, and the
/// rotation of the head while one block fires (0.5 degree at 600 rpm).
pub(super) const SLACK_CDEG: u32 = 100;
/// Spacing of the beams tried against the image.
const TRIAL_CDEG: u32 = 50;
/// Farthest range tried, metres; beyond it parallax moves a return by less than a pixel.
const FAR_M: f64 = 200.0;

/// Where one laser points: a row of the LiDAR's correction table.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Channel {
    /// Above the horizon, degrees.
    pub elevation_deg: f64,
    /// Added to the block's azimuth, degrees.
    pub azimuth_offset_deg: f64,
}

/// The arc of corrected azimuths, and the channels, that can land in the image.
#[derive(Debug, Clone)]
pub struct AzimuthWindow {
    start_cdeg: u32,
    width_cdeg: u32,
    /// Azimuth offset of each channel in `0..36_000`, and whether the image can see it.
    channels: Box<[(u32, bool)]>,
    /// Block azimuth at which the first visible channel enters.
    entry_cdeg: u32,
    /// Block azimuth, from there, at which the last visible channel has left.
    exit_cdeg: u32,
}

impl AzimuthWindow {
    /// Tries every channel at every half degree from `range_min_m` to 200 m against the image, and
    /// widens the arc found by `margin_deg` on both sides, for what the vehicle's motion turns in.
    ///
    /// `camera` is in pixels of `grid`.
    ///
    /// # Errors
    /// [`RasterError::NothingVisible`], when no beam meets the image;
    /// [`RasterError::WindowTooWide`], when the arc leaves no room to tell one pass from the next;
    /// [`RasterError::Setting`] for a margin or range out of bounds, or angles that are not finite.
    pub fn new(
        camera: &Pinhole,
        grid: Grid,
        camera_from_lidar: &Isometry3<f64>,
        channels: &[Channel],
        range_min_m: f64,
        margin_deg: f64,
    ) -> Result<Self, RasterError> {
        check("smallest range in m", range_min_m, 0.01, FAR_M)?;
        check("azimuth margin in degrees", margin_deg, 0.0, 180.0)?;
        check("channels", channels.len() as f64, 1.0, 256.0)?;
        for channel in channels {
            check("elevation in degrees", channel.elevation_deg, -90.0, 90.0)?;
            check(
                "azimuth offset in degrees",
                channel.azimuth_offset_deg,
                -90.0,
                90.0,
            )?;
        }
        let trials = TURN_CDEG / TRIAL_CDEG;
        let mut columns = vec![false; trials as usize];
        let mut visible = vec![false; channels.len()];
        for (column, seen) in columns.iter_mut().enumerate() {
            let azimuth_deg = f64::from(TRIAL_CDEG) * 0.01 * column as f64;
            for (channel, visible) in channels.iter().zip(&mut visible) {
                if meets(
                    camera,
                    grid,
                    camera_from_lidar,
                    azimuth_deg,
                    channel.elevation_deg,
                    range_min_m,
                ) {
                    (*seen, *visible) = (true, true);
                }
            }
        }
        let nothing = RasterError::NothingVisible {
            channels: channels.len(),
        };
        let (first, count) = covering_arc(&columns).ok_or(nothing)?;
        // Half a trial step more on both sides, rounded up to a whole one.
        let margin = (margin_deg * 100.0).ceil() as u32 + TRIAL_CDEG; // at most 18,050
        let width_cdeg = (count - 1) * TRIAL_CDEG + 2 * margin;
        let start_cdeg = (first * TRIAL_CDEG + TURN_CDEG - margin) % TURN_CDEG;
        Self::assemble(start_cdeg, width_cdeg, channels, &visible)
    }

    fn assemble(
        start_cdeg: u32,
        width_cdeg: u32,
        channels: &[Channel],
        visible: &[bool],
    ) -> Result<Self, RasterError> {
        let offsets = || {
            channels
                .iter()
                .map(|channel| (channel.azimuth_offset_deg * 100.0).round() as i32)
        };
        let seen = || {
            offsets()
                .zip(visible)
                .filter(|(_, visible)| **visible)
                .map(|(offset, _)| offset)
        };
        let (Some(least), Some(most)) = (seen().min(), seen().max()) else {
            return Err(RasterError::NothingVisible {
                channels: channels.len(),
            });
        };
        let exit_cdeg = width_cdeg + most.abs_diff(least);
        if exit_cdeg + 4 * SLACK_CDEG > TURN_CDEG {
            return Err(RasterError::WindowTooWide {
                width_cdeg: exit_cdeg,
            });
        }
        Ok(Self {
            start_cdeg,
            width_cdeg,
            channels: offsets()
                .map(on_circle)
                .zip(visible.iter().copied())
                .collect(),
            entry_cdeg: on_circle(start_cdeg.cast_signed() - most),
            exit_cdeg,
        })
    }

    /// First corrected azimuth of the arc, hundredths of a degree.
    #[must_use]
    pub const fn start_cdeg(&self) -> u32 {
        self.start_cdeg
    }

    /// Its width, hundredths of a degree, clockwise.
    #[must_use]
    pub const fn width_cdeg(&self) -> u32 {
        self.width_cdeg
    }

    /// Whether the image can see some beam of `channel`.
    #[must_use]
    pub fn sees(&self, channel: u8) -> bool {
        self.channels
            .get(usize::from(channel))
            .is_some_and(|(_, visible)| *visible)
    }

    /// Whether a return can land in the image: its corrected azimuth in the arc, its channel seen.
    #[must_use]
    pub fn holds(&self, channel: u8, azimuth_cdeg: u16) -> bool {
        let along = (u32::from(azimuth_cdeg) + TURN_CDEG - self.start_cdeg) % TURN_CDEG;
        self.sees(channel) && along <= self.width_cdeg
    }

    /// Azimuth of the block that a return with this corrected azimuth came in; `None` for a channel
    /// without a row in the table.
    pub(super) fn block_of(&self, channel: u8, azimuth_cdeg: u16) -> Option<u32> {
        let (offset, _) = self.channels.get(usize::from(channel))?;
        Some((u32::from(azimuth_cdeg) + TURN_CDEG - offset) % TURN_CDEG)
    }

    /// How far a block is beyond the entry, hundredths of a degree, `0..36_000`.
    pub(super) fn along(&self, block_cdeg: u32) -> u32 {
        (block_cdeg % TURN_CDEG + TURN_CDEG - self.entry_cdeg) % TURN_CDEG
    }

    /// The value of [`along`](Self::along) beyond which no visible channel is inside any more.
    pub(super) fn exit(&self) -> u32 {
        self.exit_cdeg
    }
}

fn check(name: &'static str, value: f64, min: f64, max: f64) -> Result<(), RasterError> {
    if (min..=max).contains(&value) {
        Ok(())
    } else {
        Err(RasterError::Setting {
            name,
            value,
            min,
            max,
        })
    }
}

/// Hundredths of a degree onto the circle.
fn on_circle(cdeg: i32) -> u32 {
    cdeg.rem_euclid(TURN_CDEG.cast_signed()).cast_unsigned()
}

/// Whether a beam meets the image at some range.
fn meets(
    camera: &Pinhole,
    grid: Grid,
    camera_from_lidar: &Isometry3<f64>,
    azimuth_deg: f64,
    elevation_deg: f64,
    range_min_m: f64,
) -> bool {
    let (sin_az, cos_az) = azimuth_deg.to_radians().sin_cos();
    let (sin_el, cos_el) = elevation_deg.to_radians().sin_cos();
    let mut range_m = range_min_m;
    loop {
        let beam = Point3::new(
            range_m * cos_el * sin_az,
            range_m * cos_el * cos_az,
            range_m * sin_el,
        );
        let pixel = camera.project(&(camera_from_lidar * beam));
        let inside = |(u, v): (f64, f64)| {
            u >= -1.0 && v >= -1.0 && u <= f64::from(grid.width) && v <= f64::from(grid.height)
        };
        if pixel.is_some_and(inside) {
            return true;
        }
        if range_m >= FAR_M {
            return false;
        }
        range_m = (range_m * 1.5).min(FAR_M);
    }
}

/// First column and length of the shortest arc that covers every set column.
fn covering_arc(columns: &[bool]) -> Option<(u32, u32)> {
    let n = columns.len();
    let set: Vec<usize> = (0..n).filter(|index| columns[*index]).collect();
    let first = *set.first()?;
    let gap_to = |from: usize, to: usize| (to + n - from - 1) % n; // empty columns between two set ones
    let pairs = set
        .iter()
        .copied()
        .zip(set.iter().copied().skip(1).chain([first]));
    let (from, to) = pairs.max_by_key(|(from, to)| {
        if from == to {
            n - 1
        } else {
            gap_to(*from, *to)
        }
    })?;
    let gap = if from == to { n - 1 } else { gap_to(from, to) };
    Some((to as u32, (n - gap) as u32))
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::Distortion;
    use nalgebra::{Rotation3, Translation3, UnitQuaternion, Vector3};

    /// Camera 256x256 with 52 degrees; LiDAR 0.25 m above and 0.1 m behind it, axes turned only.
    pub fn rig() -> (Pinhole, Grid, Isometry3<f64>) {
        let camera = Pinhole::new(262.4, 262.4, 127.5, 127.5, Distortion::default()).unwrap();
        let (right, down, forward) = (Vector3::x(), Vector3::z() * -1.0, Vector3::y());
        let turn = Rotation3::from_matrix_unchecked(nalgebra::Matrix3::from_rows(&[
            right.transpose(),
            down.transpose(),
            forward.transpose(),
        ]));
        let place = Translation3::new(0.0, -0.25, -0.10);
        (
            camera,
            Grid::new(256, 256),
            Isometry3::from_parts(place, UnitQuaternion::from_rotation_matrix(&turn)),
        )
    }

    pub fn channels() -> Vec<Channel> {
        (0..64u8)
            .map(|c| Channel {
                elevation_deg: f64::from(c) * 1.6 - 50.4,
                azimuth_offset_deg: [8.7, -5.3, 5.5, -7.9][usize::from(c) % 4],
            })
            .collect()
    }

    #[test]
    fn a_forward_camera_sees_its_own_angle_across_azimuth_zero() {
        let (camera, grid, camera_from_lidar) = rig();
        let window =
            AzimuthWindow::new(&camera, grid, &camera_from_lidar, &channels(), 2.0, 3.0).unwrap();
        // Half the view is atan(128.5 / 262.4) = 26.1 degrees at the camera, some more from 0.1 m
        // behind it, then the margin: about 30 on both sides of zero.
        let start = 360.0 - f64::from(window.start_cdeg()) / 100.0;
        let end = f64::from(window.start_cdeg() + window.width_cdeg()) / 100.0 - 360.0;
        assert!(
            (29.0..32.0).contains(&start) && (29.0..32.0).contains(&end),
            "{start} {end}"
        );
        assert!(window.holds(32, 0) && window.holds(32, 2800) && window.holds(32, 33_200));
        assert!(!window.holds(32, 3300) && !window.holds(32, 18_000));
        assert!(!window.sees(0) && window.sees(31) && !window.sees(63) && !window.sees(64));
    }

    #[test]
    fn blocks_are_reckoned_from_where_the_first_channel_enters() {
        let (camera, grid, camera_from_lidar) = rig();
        let window =
            AzimuthWindow::new(&camera, grid, &camera_from_lidar, &channels(), 2.0, 3.0).unwrap();
        // Channel 32 leads by 8.7 degrees: it enters first, when its block is at along = 0.
        let start = u16::try_from(window.start_cdeg()).unwrap();
        assert_eq!(window.along(window.block_of(32, start).unwrap()), 0);
        // Channel 35 trails by 7.9: it leaves last.
        let end = u16::try_from((window.start_cdeg() + window.width_cdeg()) % 36_000).unwrap();
        assert_eq!(
            window.along(window.block_of(35, end).unwrap()),
            window.exit()
        );
        assert_eq!(window.block_of(64, 0), None);
    }

    #[test]
    fn arcs_cross_the_seam() {
        let columns = |set: &[usize]| (0..10).map(|i| set.contains(&i)).collect::<Vec<_>>();
        assert_eq!(covering_arc(&columns(&[])), None);
        assert_eq!(covering_arc(&columns(&[4])), Some((4, 1)));
        assert_eq!(covering_arc(&columns(&[3, 5])), Some((3, 3)));
        assert_eq!(covering_arc(&columns(&[0, 1, 9])), Some((9, 3)));
        assert_eq!(covering_arc(&[true; 10]).map(|(_, count)| count), Some(10));
    }

    #[test]
    fn views_that_cannot_work_are_refused() {
        let (camera, grid, camera_from_lidar) = rig();
        let up = vec![
            Channel {
                elevation_deg: 80.0,
                azimuth_offset_deg: 0.0
            };
            4
        ];
        let try_with = |channels: &[Channel], margin| {
            AzimuthWindow::new(&camera, grid, &camera_from_lidar, channels, 2.0, margin).map(|_| ())
        };
        assert_eq!(
            try_with(&up, 1.0),
            Err(RasterError::NothingVisible { channels: 4 })
        );
        assert!(matches!(
            try_with(&channels(), 150.0),
            Err(RasterError::WindowTooWide { .. })
        ));
        assert!(matches!(
            try_with(&channels(), f64::NAN),
            Err(RasterError::Setting { .. })
        ));
        assert!(matches!(
            try_with(&[], 1.0),
            Err(RasterError::Setting { .. })
        ));
    }
}

//! The PandarQT64 of the rig: 64 lasers fired one after another, 600 columns a turn, into the
//! moving world.

use std::sync::LazyLock;

use noctule_hesai::{Correction, FireTimes, Model, Qt64Echoes};
use noctule_recording::Pose as Extrinsics;
use noctule_sensor::{Lidar, Return, Stamp};
use rayon::prelude::*;

use crate::chance::{Dice, Purpose};
use crate::road::Pose;
use crate::scene::Scene;
use crate::snapshot::{GROUND, Horizon, Placed, Placement, Snapshot};

/// Lasers.
pub const CHANNELS: usize = 64;
/// Firings per turn; 10 turns per second.
pub const COLUMNS: u64 = 600;
/// Azimuth from one column to the next, hundredths of a degree.
const COLUMN_CDEG: u64 = 60;
/// Raw azimuth of column 0: behind, so that the seam is not in the camera's view.
const SEAM_CDEG: u64 = 18_000;
/// From the start of a packet to its first block's laser table: block offset and the vendor's
/// constant, nanoseconds.
const PACKET_OFFSET_NS: u64 = 25_710 + 10_000;
/// From one block pair to the next within a packet, nanoseconds.
const FIRING_NS: u64 = 166_666;
/// Firings in one dual-return packet.
pub(crate) const FIRINGS_PER_PACKET: u64 = 2;
/// Distance unit of the packets, metres.
const UNIT_M: f64 = 0.004;
/// Range noise, metres.
const RANGE_NOISE_M: f64 = 0.03;
/// Nothing is reported beyond this, metres.
const RANGE_MAX_M: f64 = 60.0;
/// Range at which a surface reflecting 10 % is seen half of the time, metres.
const HALF_RANGE_M: f64 = 32.0;
/// Steepness of the detection probability around its half point, relative to it.
const HALF_WIDTH: f64 = 0.06;
/// Angle to the side at which the far part of a laser's spot looks, radians.
const SPOT_RAD: f64 = 0.0035;
/// Share of firings whose spot is examined for a second surface.
const SPOT_SHARE: f64 = 0.15;

/// Angles and firing time of one laser.
struct Ring {
    elevation_rad: f64,
    azimuth_rad: f64,
    azimuth_cdeg: i32,
    fire_ns: u64,
}

/// The vendor's nominal tables.
static RINGS: LazyLock<Vec<Ring>> = LazyLock::new(|| {
    let angles = Correction::nominal(Model::Qt64);
    let times = FireTimes::nominal(Model::Qt64);
    let rows = angles.lasers().iter().zip(times.channel_ns());
    rows.map(|(laser, &ns)| Ring {
        elevation_rad: laser.elevation_deg.to_radians(),
        azimuth_rad: laser.azimuth_deg.to_radians(),
        azimuth_cdeg: (laser.azimuth_deg * 100.0).round() as i32,
        fire_ns: u64::from(ns.unsigned_abs()),
    })
    .collect()
});

/// One echo in wire units.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Echo {
    /// Distance in units of 4 mm; 0 is no return.
    pub distance: u16,
    /// Reflectivity, percent.
    pub reflectivity: u8,
}

impl Echo {
    /// Distance, metres.
    #[must_use]
    pub fn distance_m(&self) -> f64 {
        f64::from(self.distance) * UNIT_M
    }
}

/// All lasers fired at one raw azimuth, in dual-return mode first + last (0x3B).
#[derive(Debug, Clone, PartialEq)]
pub struct Column {
    /// Counts the columns since the drive's start.
    pub index: u64,
    /// Raw azimuth, hundredths of a degree, 0 ahead, clockwise.
    pub azimuth_cdeg: u16,
    /// First echo per channel.
    pub first: [Echo; CHANNELS],
    /// Last echo per channel; mostly the first again.
    pub last: [Echo; CHANNELS],
}

/// The start of the packet that carries column `index`, nanoseconds on a clock that began with
/// the first packet; whole microseconds, as packets say it.
#[must_use]
pub fn packet_start_ns(index: u64) -> u64 {
    (index / FIRINGS_PER_PACKET * 1_000_000 / 3_000) * 1000
}

/// When laser `channel` of column `index` fires, on the same clock: packet start, block and
/// channel offsets as the manual has them.
#[must_use]
pub fn fire_ns(index: u64, channel: usize) -> u64 {
    packet_start_ns(index)
        + PACKET_OFFSET_NS
        + (index % FIRINGS_PER_PACKET) * FIRING_NS
        + RINGS[channel].fire_ns
}

/// The first column whose packet starts at or after `ns` on that clock.
#[must_use]
pub fn first_column_from(ns: u64) -> u64 {
    let mut packet = ns * 3 / 1_000_000;
    while packet_start_ns(packet * FIRINGS_PER_PACKET) < ns {
        packet += 1;
    }
    packet * FIRINGS_PER_PACKET
}

/// Raw azimuth of column `index`, hundredths of a degree.
#[must_use]
pub fn azimuth_cdeg(index: u64) -> u16 {
    ((index % COLUMNS * COLUMN_CDEG + SEAM_CDEG) % 36_000) as u16
}

/// Whether a column can hit what the forward camera sees: within 48 degrees of straight ahead.
#[must_use]
pub fn sees_camera_view(index: u64) -> bool {
    let azimuth = azimuth_cdeg(index);
    !(4_800..=31_200).contains(&azimuth)
}

/// The LiDAR on the moving vehicle.
#[derive(Debug, Clone)]
pub struct Scanner {
    seed: u64,
    mounting: Extrinsics,
}

impl Scanner {
    /// A LiDAR mounted at `camera_from_lidar`, with the noise of `seed`.
    #[must_use]
    pub fn new(seed: u64, camera_from_lidar: Extrinsics) -> Self {
        Self {
            seed,
            mounting: camera_from_lidar,
        }
    }

    /// Fires the columns of `indices`, over all threads; `true_s` gives the true time in seconds
    /// since the drive's start for an instant on the LiDAR's packet clock.
    #[must_use]
    pub fn scan(
        &self,
        scene: &Scene,
        indices: &[u64],
        true_s: impl Fn(u64) -> f64 + Sync,
    ) -> Vec<Column> {
        indices
            .par_iter()
            .map(|&index| self.column(scene, index, &true_s))
            .collect()
    }

    fn column(&self, scene: &Scene, index: u64, true_s: &impl Fn(u64) -> f64) -> Column {
        let mut dice = Dice::numbered(self.seed, Purpose::Lidar, index);
        let begin = true_s(fire_ns(index, 0));
        let snapshot = Snapshot::new(scene, begin, Horizon::LIDAR);
        let azimuth_cdeg = azimuth_cdeg(index);
        let near = self.in_view(&snapshot, azimuth_cdeg);
        let mut column = Column {
            index,
            azimuth_cdeg,
            first: [Echo::default(); CHANNELS],
            last: [Echo::default(); CHANNELS],
        };
        for channel in 0..CHANNELS {
            let t = true_s(fire_ns(index, channel));
            let beam = Beam {
                snapshot: &snapshot,
                near: &near,
                pose: scene.ego_pose(t),
            };
            let direction = direction(azimuth_cdeg, channel, 0.0);
            let echo = self.echo(scene, &beam, direction, &mut dice);
            let (mut first, mut last) = (echo, echo);
            if echo.distance != 0 && dice.chance(SPOT_SHARE) {
                let aside = self.echo(
                    scene,
                    &beam,
                    self::direction(azimuth_cdeg, channel, SPOT_RAD),
                    &mut dice,
                );
                // Two surfaces nearer together than a pulse is long give one echo.
                if aside.distance.abs_diff(echo.distance) > 250 && aside.distance != 0 {
                    (first, last) = if aside.distance < echo.distance {
                        (aside, echo)
                    } else {
                        (echo, aside)
                    };
                }
            }
            column.first[channel] = first;
            column.last[channel] = last;
        }
        column
    }

    /// The objects a column's beams can touch.
    fn in_view(&self, snapshot: &Snapshot, azimuth_cdeg: u16) -> Vec<Placed> {
        let azimuth = (f64::from(azimuth_cdeg) * 0.01).to_radians();
        let ahead = rotate(&self.mounting, [azimuth.sin(), azimuth.cos(), 0.0]);
        let (sin, cos) = (ahead[0] as f32, ahead[2] as f32);
        // Channel offsets reach 8.8 degrees; the rest is for the mounting and the motion.
        let spread = 11.0_f32.to_radians();
        let touches = |placed: &&Placed| {
            let (x, z, reach) = match placed.shape {
                Placement::Box { centre, half, .. } => {
                    (centre[0], centre[2], half[0].hypot(half[2]))
                }
                Placement::Capsule { x, z, radius, .. } => (x, z, radius),
            };
            let (reach, distance) = (reach + 0.2, x.hypot(z));
            let angle = (cos * x - sin * z).atan2(sin * x + cos * z).abs();
            distance <= reach || angle <= spread + (reach / distance).asin()
        };
        snapshot.objects.iter().filter(touches).copied().collect()
    }

    fn echo(&self, scene: &Scene, beam: &Beam<'_>, direction: [f64; 3], dice: &mut Dice) -> Echo {
        // One draw each, hit or not, so that a stream stays in step.
        let (noise, chance) = (RANGE_NOISE_M * dice.normal(), dice.unit());
        let Some((distance, id)) = beam.cast(&self.mounting, direction) else {
            return Echo::default();
        };
        let reflectance = if id == GROUND {
            0.10
        } else {
            0.5 * f64::from(scene.albedo(id))
        };
        let half = HALF_RANGE_M * (reflectance / 0.1).sqrt();
        let seen = 1.0 / (1.0 + ((distance - half) / (HALF_WIDTH * half)).exp());
        let measured = distance + noise;
        if distance > RANGE_MAX_M || chance >= seen || measured < 2.0 * UNIT_M {
            return Echo::default();
        }
        Echo {
            distance: (measured / UNIT_M).round() as u16,
            reflectivity: (reflectance * 100.0).round().clamp(1.0, 255.0) as u8,
        }
    }
}

/// A laser firing from the vehicle at `pose` into a snapshot taken a few microseconds earlier.
struct Beam<'a> {
    snapshot: &'a Snapshot,
    near: &'a [Placed],
    pose: Pose,
}

impl Beam<'_> {
    fn cast(&self, mounting: &Extrinsics, direction: [f64; 3]) -> Option<(f64, u16)> {
        let observer = self.snapshot.observer;
        let turn = self.pose.heading_rad - observer.heading_rad;
        let (sin, cos) = turn.sin_cos();
        let d = rotate(mounting, direction);
        let o = mounting.translation_m;
        let (x, z) = self.pose.world(o[0], o[2]);
        let (x, z) = observer.local(x, z);
        let direction = [cos * d[0] + sin * d[2], d[1], cos * d[2] - sin * d[0]].map(|v| v as f32);
        let origin = [x as f32, o[1] as f32, z as f32];
        let hit = self
            .snapshot
            .cast_among(self.near.iter(), origin, direction, 0.05)?;
        Some((f64::from(hit.0), hit.1))
    }
}

/// A direction in the LiDAR's frame, in the camera's.
fn rotate(mounting: &Extrinsics, v: [f64; 3]) -> [f64; 3] {
    let r = &mounting.rotation;
    r.map(|row| row[0] * v[0] + row[1] * v[1] + row[2] * v[2])
}

/// Unit vector of a laser in the LiDAR's frame: nominal angles, as a decoder applies them.
fn direction(azimuth_cdeg: u16, channel: usize, aside_rad: f64) -> [f64; 3] {
    let ring = &RINGS[channel];
    let azimuth = (f64::from(azimuth_cdeg) * 0.01).to_radians() + ring.azimuth_rad + aside_rad;
    let elevation = ring.elevation_rad;
    [
        elevation.cos() * azimuth.sin(),
        elevation.cos() * azimuth.cos(),
        elevation.sin(),
    ]
}

impl Column {
    /// First and last echoes as the packet encoder takes them.
    #[must_use]
    pub fn to_wire(&self) -> [Qt64Echoes; 2] {
        [&self.first, &self.last].map(|echoes| Qt64Echoes {
            distance: echoes.map(|echo| echo.distance),
            intensity: echoes.map(|echo| echo.reflectivity),
        })
    }

    /// Appends the column's returns as a decoder gives them: equal dual returns once, times on
    /// the packet clock shifted by `shift_ns`.
    pub fn append_returns(&self, shift_ns: u64, out: &mut Vec<Return>) {
        let pair = (self.index % FIRINGS_PER_PACKET * 2) as u8;
        for channel in 0..CHANNELS {
            let (first, last) = (self.first[channel], self.last[channel]);
            for (block, echo) in [(pair, first), (pair + 1, last)] {
                if echo.distance != 0 && (block == pair || first != last) {
                    out.push(self.to_return(channel, block, echo, shift_ns));
                }
            }
        }
    }

    fn to_return(&self, channel: usize, block: u8, echo: Echo, shift_ns: u64) -> Return {
        let [x, y, z] = direction(self.azimuth_cdeg, channel, 0.0).map(|u| u * echo.distance_m());
        Return {
            t: Stamp::<Lidar>::from_nanos(fire_ns(self.index, channel) + shift_ns),
            x_m: x as f32,
            y_m: y as f32,
            z_m: z as f32,
            azimuth_cdeg: (i32::from(self.azimuth_cdeg) + RINGS[channel].azimuth_cdeg)
                .rem_euclid(36_000) as u16,
            channel: channel as u8,
            intensity: echo.reflectivity,
            block,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use noctule_recording::Calibration;

    fn scanner(seed: u64) -> Scanner {
        Scanner::new(seed, Calibration::default_rig().camera_from_lidar)
    }

    fn seconds(ns: u64) -> f64 {
        ns as f64 * 1e-9
    }

    #[test]
    fn lasers_fire_by_the_table() {
        assert_eq!(fire_ns(0, 0), 35_710 + 2_310);
        assert_eq!(fire_ns(1, 63), 35_710 + 166_666 + 136_450);
        assert_eq!(
            (packet_start_ns(2), packet_start_ns(6000)),
            (333_000, 1_000_000_000)
        );
        assert_eq!(
            (azimuth_cdeg(0), azimuth_cdeg(300), azimuth_cdeg(899)),
            (18_000, 0, 35_940)
        );
    }

    #[test]
    fn ground_returns_lie_on_the_ground() {
        let scene = Scene::new(4, 1.0, true);
        let indices: Vec<u64> = (3000..3600).collect();
        let columns = scanner(4).scan(&scene, &indices, seconds);
        let mounting = Calibration::default_rig().camera_from_lidar;
        let mut returns = Vec::new();
        columns
            .iter()
            .for_each(|c| c.append_returns(0, &mut returns));
        let heights: Vec<f64> = returns
            .iter()
            .filter(|r| r.channel < 24 && r.intensity == 10)
            .map(|r| mounting.apply([r.x_m, r.y_m, r.z_m].map(f64::from))[1])
            .collect();
        assert!(heights.len() > 1000);
        let mean = heights.iter().sum::<f64>() / heights.len() as f64;
        assert!((mean - 1.5).abs() < 0.01, "{mean}");
    }

    #[test]
    fn culling_loses_no_hit() {
        let scene = Scene::new(8, 1.0, true);
        let scanner = scanner(8);
        for index in (0..600).step_by(37) {
            let snapshot = Snapshot::new(&scene, 0.5, Horizon::LIDAR);
            let azimuth = azimuth_cdeg(index);
            let near = scanner.in_view(&snapshot, azimuth);
            assert!(near.len() < snapshot.objects.len());
            let pose = scene.ego_pose(0.5);
            for channel in 0..CHANNELS {
                let direction = direction(azimuth, channel, 0.0);
                let with = |near: &[Placed]| {
                    Beam {
                        snapshot: &snapshot,
                        near,
                        pose,
                    }
                    .cast(&scanner.mounting, direction)
                };
                assert_eq!(with(&near), with(&snapshot.objects));
            }
        }
    }

    #[test]
    fn dual_returns_are_mostly_equal_and_never_out_of_order() {
        let scene = Scene::new(5, 1.0, true);
        let indices: Vec<u64> = (0..600).collect();
        let columns = scanner(5).scan(&scene, &indices, seconds);
        let pairs: Vec<(Echo, Echo)> = columns
            .iter()
            .flat_map(|c| c.first.into_iter().zip(c.last))
            .filter(|(f, _)| f.distance != 0)
            .collect();
        assert!(pairs.len() > 5000, "{}", pairs.len());
        let differ = pairs.iter().filter(|(f, l)| f != l).count();
        assert!(
            differ > 0 && differ * 20 < pairs.len(),
            "{differ} of {}",
            pairs.len()
        );
        assert!(pairs.iter().all(|(f, l)| f.distance <= l.distance));
    }
}

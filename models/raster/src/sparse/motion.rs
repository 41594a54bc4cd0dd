//! The vehicle's own motion over a short past: a bounded log of speed and yaw rate, integrated.
//!
//! The vehicle's frame of reference: x forward, y left, z up, metres, origin where the model of a
//! bicycle has its rear axle. Between two samples speed and turn rate are their means and constant,
//! so the vehicle runs along an arc; roll, pitch and slip are not modelled.

use std::collections::VecDeque;
use std::time::Duration;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use noctule_sensor::{Stamp, Tai};

use crate::RasterError;

/// Turns below this go by series, radians: exact to 1e-16 and free of the library's sine.
const SMALL_TURN: f64 = 0.05;

/// A place and heading on the ground: rotation about z, then translation in x and y.
///
/// Read as `odometry_from_vehicle` or as `vehicle_from_vehicle`, by name of its variable.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlanarMove {
    /// Metres.
    pub x_m: f64,
    /// Metres.
    pub y_m: f64,
    /// Cosine of the heading, counter-clockwise seen from above.
    pub cos: f64,
    /// Sine of the heading.
    pub sin: f64,
}

impl PlanarMove {
    /// No motion.
    pub const IDENTITY: Self = Self {
        x_m: 0.0,
        y_m: 0.0,
        cos: 1.0,
        sin: 0.0,
    };

    /// `seconds` along an arc at constant speed (m/s) and turn rate (rad/s).
    #[must_use]
    pub fn arc(speed: f64, yaw_rate: f64, seconds: f64) -> Self {
        let (turn, way) = (yaw_rate * seconds, speed * seconds);
        // sin(a)/a and (1 - cos a)/a, which lose every digit near 0 when taken at their word.
        let (along, aside) = if turn.abs() < SMALL_TURN {
            let a = turn * turn;
            (
                1.0 - a / 6.0 * (1.0 - a / 20.0 * (1.0 - a / 42.0 * (1.0 - a / 72.0))),
                turn / 2.0 * (1.0 - a / 12.0 * (1.0 - a / 30.0 * (1.0 - a / 56.0))),
            )
        } else {
            (turn.sin() / turn, (1.0 - turn.cos()) / turn)
        };
        Self {
            x_m: way * along,
            y_m: way * aside,
            cos: 1.0 - turn * aside,
            sin: turn * along,
        }
    }

    /// This move after `first`: `a_from_c = a_from_b.after(b_from_c)`.
    #[must_use]
    pub fn after(&self, first: &Self) -> Self {
        let (x_m, y_m) = self.apply(first.x_m, first.y_m);
        Self {
            x_m,
            y_m,
            cos: self.cos * first.cos - self.sin * first.sin,
            sin: self.sin * first.cos + self.cos * first.sin,
        }
    }

    /// The move back.
    #[must_use]
    pub fn inverse(&self) -> Self {
        Self {
            x_m: -(self.cos * self.x_m + self.sin * self.y_m),
            y_m: self.sin * self.x_m - self.cos * self.y_m,
            cos: self.cos,
            sin: -self.sin,
        }
    }

    /// Moves a point.
    #[inline]
    #[must_use]
    pub fn apply(&self, x: f64, y: f64) -> (f64, f64) {
        (
            self.cos * x - self.sin * y + self.x_m,
            self.sin * x + self.cos * y + self.y_m,
        )
    }

    /// The same as a transform in space.
    #[must_use]
    pub fn to_isometry(self) -> Isometry3<f64> {
        let heading = self.sin.atan2(self.cos);
        Isometry3::from_parts(
            Translation3::new(self.x_m, self.y_m, 0.0),
            UnitQuaternion::from_axis_angle(&Vector3::z_axis(), heading),
        )
    }
}

#[derive(Debug, Clone, Copy)]
struct Node {
    at: Stamp<Tai>,
    speed: f64,
    yaw_rate: f64,
    odometry_from_vehicle: PlanarMove,
}

/// A bounded log of speed and yaw rate, and the poses they add up to.
#[derive(Debug)]
pub struct EgoMotion {
    nodes: VecDeque<Node>,
    capacity: usize,
    reach_ns: u64,
}

impl EgoMotion {
    /// A log of the newest `capacity` samples that may be extrapolated by `reach` either way.
    ///
    /// # Errors
    /// [`RasterError::Setting`], when `capacity` is not 2..=2^20 or `reach` exceeds 10 s.
    pub fn new(capacity: usize, reach: Duration) -> Result<Self, RasterError> {
        if !(2..=1 << 20).contains(&capacity) {
            let value = capacity as f64;
            return Err(RasterError::Setting {
                name: "motion log",
                value,
                min: 2.0,
                max: 1_048_576.0,
            });
        }
        if reach > Duration::from_secs(10) {
            let value = reach.as_secs_f64();
            return Err(RasterError::Setting {
                name: "motion extrapolation in s",
                value,
                min: 0.0,
                max: 10.0,
            });
        }
        let reach_ns = reach.as_nanos() as u64; // at most 10^10
        Ok(Self {
            nodes: VecDeque::with_capacity(capacity),
            capacity,
            reach_ns,
        })
    }

    /// Appends a sample; the oldest one makes room.
    ///
    /// # Errors
    /// [`RasterError::MotionValue`] for a value that is not finite, [`RasterError::MotionOrder`]
    /// for a stamp that is not after the newest; the log stays as it was.
    pub fn push(
        &mut self,
        at: Stamp<Tai>,
        speed_mps: f32,
        yaw_rate_rps: f32,
    ) -> Result<(), RasterError> {
        if !speed_mps.is_finite() || !yaw_rate_rps.is_finite() {
            return Err(RasterError::MotionValue {
                speed_mps,
                yaw_rate_rps,
            });
        }
        let (speed, yaw_rate) = (f64::from(speed_mps), f64::from(yaw_rate_rps));
        let odometry_from_vehicle = match self.nodes.back() {
            None => PlanarMove::IDENTITY,
            Some(last) if at <= last.at => {
                let (at_ns, newest_ns) = (at.as_nanos(), last.at.as_nanos());
                return Err(RasterError::MotionOrder { at_ns, newest_ns });
            }
            Some(last) => {
                let seconds = seconds_between(last.at, at);
                let arc = PlanarMove::arc(
                    mean(last.speed, speed),
                    mean(last.yaw_rate, yaw_rate),
                    seconds,
                );
                normalised(last.odometry_from_vehicle.after(&arc))
            }
        };
        if self.nodes.len() == self.capacity {
            self.nodes.pop_front();
        }
        self.nodes.push_back(Node {
            at,
            speed,
            yaw_rate,
            odometry_from_vehicle,
        });
        Ok(())
    }

    /// Forgets everything, as after a step of the clock.
    pub fn clear(&mut self) {
        self.nodes.clear();
    }

    /// Stamps of the oldest and the newest sample.
    #[must_use]
    pub fn covered(&self) -> Option<(Stamp<Tai>, Stamp<Tai>)> {
        Some((self.nodes.front()?.at, self.nodes.back()?.at))
    }

    /// How far `at` lies outside the log, nanoseconds; 0 inside it.
    #[must_use]
    pub fn beyond_ns(&self, at: Stamp<Tai>) -> u64 {
        self.covered().map_or(u64::MAX, |(oldest, newest)| {
            let before = oldest.as_nanos().saturating_sub(at.as_nanos());
            before.max(at.as_nanos().saturating_sub(newest.as_nanos()))
        })
    }

    /// Takes a point in the vehicle's frame at `from` to the vehicle's frame at `to`.
    ///
    /// # Errors
    /// [`RasterError::NoMotion`] for an empty log, [`RasterError::NotCovered`] when an instant lies
    /// further outside it than it may be extrapolated.
    pub fn vehicle_from_vehicle(
        &self,
        to: Stamp<Tai>,
        from: Stamp<Tai>,
    ) -> Result<PlanarMove, RasterError> {
        let mut near = 0;
        let odometry_from_to = self.odometry_from_vehicle(to, &mut near)?;
        let odometry_from_from = self.odometry_from_vehicle(from, &mut near)?;
        Ok(odometry_from_to.inverse().after(&odometry_from_from))
    }

    /// Takes a point in the LiDAR's frame at `from` to the LiDAR's frame at `to`.
    ///
    /// # Errors
    /// As [`vehicle_from_vehicle`](Self::vehicle_from_vehicle).
    pub fn lidar_from_lidar(
        &self,
        to: Stamp<Tai>,
        from: Stamp<Tai>,
        lidar_from_vehicle: &Isometry3<f64>,
    ) -> Result<Isometry3<f64>, RasterError> {
        let vehicle_from_vehicle = self.vehicle_from_vehicle(to, from)?.to_isometry();
        Ok(lidar_from_vehicle * vehicle_from_vehicle * lidar_from_vehicle.inverse())
    }

    /// Pose at `at` in a frame that stays put while the log lives; `near` is a guess of the sample
    /// before it, and becomes a good one.
    pub(super) fn odometry_from_vehicle(
        &self,
        at: Stamp<Tai>,
        near: &mut usize,
    ) -> Result<PlanarMove, RasterError> {
        let (oldest, newest) = self.covered().ok_or(RasterError::NoMotion)?;
        if self.beyond_ns(at) > self.reach_ns {
            return Err(RasterError::NotCovered {
                at_ns: at.as_nanos(),
                oldest_ns: oldest.as_nanos(),
                newest_ns: newest.as_nanos(),
                reach_ns: self.reach_ns,
            });
        }
        let holds = |index: usize| {
            self.nodes.get(index).is_some_and(|node| node.at <= at)
                && self.nodes.get(index + 1).is_some_and(|next| at < next.at)
        };
        if !holds(*near) {
            *near = self
                .nodes
                .partition_point(|node| node.at <= at)
                .saturating_sub(1);
        }
        let node = &self.nodes[*near];
        let (speed, yaw_rate) = match self.nodes.get(*near + 1) {
            Some(next) if at >= node.at => (
                mean(node.speed, next.speed),
                mean(node.yaw_rate, next.yaw_rate),
            ),
            _ => (node.speed, node.yaw_rate), // before the oldest or after the newest
        };
        let arc = PlanarMove::arc(speed, yaw_rate, seconds_between(node.at, at));
        Ok(node.odometry_from_vehicle.after(&arc))
    }
}

fn mean(a: f64, b: f64) -> f64 {
    0.5 * (a + b)
}

/// Signed seconds.
fn seconds_between(from: Stamp<Tai>, to: Stamp<Tai>) -> f64 {
    to.diff_nanos(from) as f64 * 1e-9
}

/// Keeps the heading's cosine and sine on the unit circle over hours of small turns.
fn normalised(pose: PlanarMove) -> PlanarMove {
    let scale = 1.0 / pose.cos.hypot(pose.sin);
    PlanarMove {
        cos: pose.cos * scale,
        sin: pose.sin * scale,
        ..pose
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;
    use proptest::prelude::*;

    fn ms(ms: u64) -> Stamp<Tai> {
        Stamp::from_micros(ms * 1000)
    }

    /// 100 samples, 10 ms apart, starting at one second.
    fn steady(speed: f32, yaw_rate: f32) -> EgoMotion {
        let mut log = EgoMotion::new(100, Duration::from_millis(50)).unwrap();
        for k in 0..100 {
            log.push(ms(1000 + 10 * k), speed, yaw_rate).unwrap();
        }
        log
    }

    #[test]
    fn a_quarter_circle_in_closed_form() {
        // Radius 10 m, a quarter turn to the left in 0.9 s: the point 10 m ahead-left is the centre.
        let yaw_rate = std::f32::consts::FRAC_PI_2 / 0.9;
        let log = steady(10.0 * yaw_rate, yaw_rate);
        let there = log.vehicle_from_vehicle(ms(1000), ms(1900)).unwrap();
        assert!(
            (there.x_m - 10.0).abs() < 1e-5 && (there.y_m - 10.0).abs() < 1e-5,
            "{there:?}"
        );
        assert!(there.cos.abs() < 1e-6 && (there.sin - 1.0).abs() < 1e-9);
        // A wall 25 m ahead at the start ends up 25 - 10 = 15 m to the right, 10 m behind the
        // centre line that now runs along it: vehicle coordinates (-10, -15).
        let (x, y) = log
            .vehicle_from_vehicle(ms(1900), ms(1000))
            .unwrap()
            .apply(25.0, 0.0);
        assert!(
            (x + 10.0).abs() < 1e-4 && (y + 15.0).abs() < 1e-4,
            "({x}, {y})"
        );
    }

    #[test]
    fn straight_on_is_speed_times_time() {
        let there = steady(14.0, 0.0)
            .vehicle_from_vehicle(ms(1100), ms(1350))
            .unwrap();
        assert!((there.x_m - 3.5).abs() < 1e-9 && there.y_m == 0.0 && there.cos == 1.0);
    }

    #[test]
    fn standing_still_is_the_identity() {
        let log = steady(0.0, 0.0);
        assert_eq!(
            log.vehicle_from_vehicle(ms(1777), ms(1001)).unwrap(),
            PlanarMove::IDENTITY
        );
        let lidar = Isometry3::new(Vector3::new(1.0, 2.0, 3.0), Vector3::new(0.1, 0.2, 0.3));
        let still = log.lidar_from_lidar(ms(1777), ms(1001), &lidar).unwrap();
        assert!((still.to_homogeneous() - nalgebra::Matrix4::identity()).norm() < 1e-14);
    }

    #[test]
    fn changing_speed_is_integrated_by_means() {
        // 0, 10, 20 .. m/s every 10 ms: the way is the triangle's area.
        let mut log = EgoMotion::new(100, Duration::ZERO).unwrap();
        for k in 0..11u16 {
            log.push(ms(u64::from(k) * 10), f32::from(k) * 10.0, 0.0)
                .unwrap();
        }
        let way = log.vehicle_from_vehicle(ms(0), ms(100)).unwrap().x_m;
        assert!((way - 0.5 * 100.0 * 0.1).abs() < 1e-12, "{way}");
    }

    proptest! {
        #[test]
        fn arcs_add_up_and_agree_with_sines(
            speed in -20.0..40.0f64, yaw_rate in -3.0..3.0f64, a in -1.0..1.0f64, b in -1.0..1.0f64,
        ) {
            let close = |p: PlanarMove, q: PlanarMove| {
                [p.x_m - q.x_m, p.y_m - q.y_m, p.cos - q.cos, p.sin - q.sin].iter().all(|d| d.abs() < 1e-12)
            };
            let whole = PlanarMove::arc(speed, yaw_rate, a + b);
            let parts = PlanarMove::arc(speed, yaw_rate, a).after(&PlanarMove::arc(speed, yaw_rate, b));
            prop_assert!(close(whole, parts), "{:?} {:?}", whole, parts);
            let turn = yaw_rate * a;
            prop_assume!(turn.abs() > 1e-3);
            let radius = speed / yaw_rate;
            let (sin, cos) = turn.sin_cos();
            let expected = PlanarMove { x_m: radius * sin, y_m: radius * (1.0 - cos), cos, sin };
            let arc = PlanarMove::arc(speed, yaw_rate, a);
            let far = [arc.x_m - expected.x_m, arc.y_m - expected.y_m].iter().any(|d| d.abs() > 1e-9);
            prop_assert!(!far, "{:?} {:?}", arc, expected);
            prop_assert!(close(arc.after(&arc.inverse()), PlanarMove::IDENTITY));
            let point = Point3::new(3.0, -2.0, 1.0);
            let (x, y) = arc.apply(point.x, point.y);
            prop_assert!((arc.to_isometry() * point - Point3::new(x, y, 1.0)).norm() < 1e-12);
        }
    }

    #[test]
    fn a_log_reaches_so_far_and_no_further() {
        let log = steady(10.0, 0.0);
        assert_eq!(log.covered(), Some((ms(1000), ms(1990))));
        let way = log.vehicle_from_vehicle(ms(990), ms(2040)).unwrap().x_m;
        assert!((way - 10.5).abs() < 1e-9);
        assert_eq!(
            (log.beyond_ns(ms(990)), log.beyond_ns(ms(1500))),
            (10_000_000, 0)
        );
        let error = log.vehicle_from_vehicle(ms(1500), ms(2041)).unwrap_err();
        let text = "motion log covers 1000000000..1990000000 ns (TAI) and 50000000 ns beyond, not 2041000000";
        assert_eq!(error.to_string(), text);
        assert!(log.vehicle_from_vehicle(ms(949), ms(1500)).is_err());
        let empty = EgoMotion::new(2, Duration::ZERO).unwrap();
        assert_eq!(
            empty.vehicle_from_vehicle(ms(1), ms(1)),
            Err(RasterError::NoMotion)
        );
    }

    #[test]
    fn old_samples_make_room_and_bad_ones_are_refused() {
        let mut log = EgoMotion::new(3, Duration::ZERO).unwrap();
        for k in 0..5 {
            log.push(ms(k), 1.0, 0.5).unwrap();
        }
        assert_eq!(log.covered(), Some((ms(2), ms(4))));
        assert!(matches!(
            log.push(ms(4), 1.0, 0.0),
            Err(RasterError::MotionOrder { .. })
        ));
        assert!(matches!(
            log.push(ms(9), f32::NAN, 0.0),
            Err(RasterError::MotionValue { .. })
        ));
        assert_eq!(log.covered(), Some((ms(2), ms(4))));
        assert!(EgoMotion::new(1, Duration::ZERO).is_err());
        assert!(EgoMotion::new(2, Duration::from_secs(11)).is_err());
    }
}

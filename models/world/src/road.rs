//! The road's shape and the ego vehicle's motion along it: pure functions of seed, place and time.
//!
//! The world is seen from above: X to the right, Z ahead at the start; headings grow clockwise
//! (to the right). Heights are not here: everything stands on one plane.

use crate::chance::{Dice, Purpose};

/// Where something stands and which way it faces, seen from above.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// World X, metres (right at the start of the road).
    pub x_m: f64,
    /// World Z, metres (ahead at the start of the road).
    pub z_m: f64,
    /// Heading, radians, clockwise seen from above.
    pub heading_rad: f64,
}

impl Pose {
    /// `(right, ahead)` of the world point `(x, z)` for an observer at this pose, metres.
    #[must_use]
    pub fn local(&self, x: f64, z: f64) -> (f64, f64) {
        let (sin, cos) = self.heading_rad.sin_cos();
        let (dx, dz) = (x - self.x_m, z - self.z_m);
        (cos * dx - sin * dz, sin * dx + cos * dz)
    }

    /// The world point `right` metres to the right of and `ahead` metres before this pose.
    #[must_use]
    pub fn world(&self, right: f64, ahead: f64) -> (f64, f64) {
        let (sin, cos) = self.heading_rad.sin_cos();
        (
            self.x_m + cos * right + sin * ahead,
            self.z_m - sin * right + cos * ahead,
        )
    }
}

/// Root mean square curvature, 1/m: about 0.35 rad/s at the mean speed.
const CURVATURE_RMS: f64 = 0.04;
/// Distance between stored points, metres.
const SPACING_M: f64 = 0.25;
/// The road starts this far behind the drive's start.
const BEHIND_M: f64 = 160.0;

/// A winding road, addressed by arc length from the drive's start.
#[derive(Debug, Clone)]
pub struct Road {
    /// `(amplitude of curvature, wave number, phase)` of each bend.
    bends: [(f64, f64, f64); 3],
    points: Vec<(f64, f64)>,
}

impl Road {
    /// The road of `seed`, long enough for arc lengths up to `end_m`.
    #[must_use]
    pub fn new(seed: u64, end_m: f64) -> Self {
        let mut dice = Dice::new(seed, Purpose::Road);
        let amplitude = CURVATURE_RMS * (2.0_f64 / 3.0).sqrt();
        let bends = core::array::from_fn(|i| {
            let wave = dice.range(0.05, 0.09) * (1.0 + 0.5 * i as f64);
            (amplitude, wave, dice.range(0.0, core::f64::consts::TAU))
        });
        let mut road = Self {
            bends,
            points: Vec::new(),
        };
        let count = ((end_m.max(0.0) + BEHIND_M) / SPACING_M).ceil() as usize + 2;
        let (mut x, mut z) = (0.0, 0.0);
        for i in 0..count {
            road.points.push((x, z));
            // Simpson's rule over one spacing.
            let s = i as f64 * SPACING_M - BEHIND_M;
            for (weight, at) in [(1.0, 0.0), (4.0, 0.5), (1.0, 1.0)] {
                let (sin, cos) = road.heading(s + at * SPACING_M).sin_cos();
                x += weight / 6.0 * SPACING_M * sin;
                z += weight / 6.0 * SPACING_M * cos;
            }
        }
        road
    }

    /// Heading at arc length `s`, radians clockwise.
    #[must_use]
    pub fn heading(&self, s: f64) -> f64 {
        self.bends
            .iter()
            .map(|(a, k, p)| a / k * (k * s + p).sin())
            .sum()
    }

    /// Curvature at arc length `s`, 1/m, positive to the right.
    #[must_use]
    pub fn curvature(&self, s: f64) -> f64 {
        self.bends
            .iter()
            .map(|(a, k, p)| a * (k * s + p).cos())
            .sum()
    }

    /// Pose at arc length `s`; straight on beyond either end.
    #[must_use]
    pub fn pose(&self, s: f64) -> Pose {
        let position = ((s + BEHIND_M) / SPACING_M).clamp(0.0, (self.points.len() - 2) as f64);
        let index = position.floor();
        let u = position - index;
        let start = index * SPACING_M - BEHIND_M;
        let (a, b) = (self.points[index as usize], self.points[index as usize + 1]);
        let (sin_a, cos_a) = self.heading(start).sin_cos();
        let (sin_b, cos_b) = self.heading(start + SPACING_M).sin_cos();
        let beyond = s - (start + u * SPACING_M);
        let heading_rad = self.heading(s - beyond);
        let (sin, cos) = heading_rad.sin_cos();
        Pose {
            x_m: hermite(a.0, SPACING_M * sin_a, b.0, SPACING_M * sin_b, u) + beyond * sin,
            z_m: hermite(a.1, SPACING_M * cos_a, b.1, SPACING_M * cos_b, u) + beyond * cos,
            heading_rad,
        }
    }

    /// Pose at arc length `s`, `right` metres to the right of the road's line.
    #[must_use]
    pub fn beside(&self, s: f64, right: f64) -> Pose {
        let pose = self.pose(s);
        let (x_m, z_m) = pose.world(right, 0.0);
        Pose { x_m, z_m, ..pose }
    }
}

fn hermite(p: f64, dp: f64, q: f64, dq: f64, u: f64) -> f64 {
    let (u2, u3) = (u * u, u * u * u);
    p * (2.0 * u3 - 3.0 * u2 + 1.0)
        + dp * (u3 - 2.0 * u2 + u)
        + q * (3.0 * u2 - 2.0 * u3)
        + dq * (u3 - u2)
}

/// How the ego vehicle moves along its road: speed between 2 and 14 m/s, varying smoothly, or
/// standing still.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Progress {
    mean_mps: f64,
    /// `(speed amplitude, angular frequency, phase)` of each wave.
    waves: [(f64, f64, f64); 2],
}

impl Progress {
    /// The drive of `seed`.
    #[must_use]
    pub fn new(seed: u64) -> Self {
        let mut dice = Dice::numbered(seed, Purpose::Road, 1);
        let mean_mps = dice.range(4.0, 12.0);
        let swing = (mean_mps - 2.0).min(14.0 - mean_mps) * 0.5;
        let waves = core::array::from_fn(|i| {
            let omega = dice.range(0.25, 0.45) * (1.0 + i as f64);
            (swing, omega, dice.range(0.0, core::f64::consts::TAU))
        });
        Self { mean_mps, waves }
    }

    /// A vehicle that stands.
    #[must_use]
    pub const fn standing() -> Self {
        Self {
            mean_mps: 0.0,
            waves: [(0.0, 1.0, 0.0); 2],
        }
    }

    /// Arc length at `t` seconds, metres; zero at the start.
    #[must_use]
    pub fn distance_m(&self, t: f64) -> f64 {
        let swings = self
            .waves
            .iter()
            .map(|(b, w, p)| b / w * ((w * t + p).sin() - p.sin()));
        self.mean_mps * t + swings.sum::<f64>()
    }

    /// Speed at `t` seconds, metres per second.
    #[must_use]
    pub fn speed_mps(&self, t: f64) -> f64 {
        self.mean_mps
            + self
                .waves
                .iter()
                .map(|(b, w, p)| b * (w * t + p).cos())
                .sum::<f64>()
    }

    /// When arc length `s` is reached, seconds; `None` when standing.
    #[must_use]
    pub fn time_at(&self, s: f64) -> Option<f64> {
        if self.mean_mps == 0.0 {
            return None;
        }
        // Speed is at least 2 m/s, so the time lies within these bounds.
        let (mut low, mut high) = (-s.abs() / 2.0 - 1.0, s.abs() / 2.0 + 1.0);
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            if self.distance_m(middle) < s {
                low = middle;
            } else {
                high = middle;
            }
        }
        Some(0.5 * (low + high))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_road_moves_along_its_heading() {
        let road = Road::new(3, 400.0);
        for i in -100..390 {
            let s = f64::from(i) + 0.123;
            let (a, b) = (road.pose(s - 1e-3), road.pose(s + 1e-3));
            let middle = road.pose(s);
            let (right, ahead) = a.local(b.x_m, b.z_m);
            assert!(
                (ahead - 2e-3).abs() < 1e-8 && right.abs() < 3e-7,
                "at {s}: {right} {ahead}"
            );
            let turn = (b.heading_rad - a.heading_rad) / 2e-3;
            assert!((turn - road.curvature(s)).abs() < 1e-6);
            let (x, z) = middle.world(1.5, -2.0);
            let (right, ahead) = middle.local(x, z);
            assert!((right - 1.5).abs() < 1e-9 && (ahead + 2.0).abs() < 1e-9);
        }
    }

    #[test]
    fn a_longer_road_begins_with_the_shorter_one() {
        let (short, long) = (Road::new(9, 50.0), Road::new(9, 900.0));
        assert_eq!(short.pose(37.2), long.pose(37.2));
    }

    #[test]
    fn speed_stays_between_2_and_14_and_is_the_rate_of_distance() {
        for seed in 0..50 {
            let progress = Progress::new(seed);
            for i in 0..200 {
                let t = f64::from(i) * 0.31;
                let speed = progress.speed_mps(t);
                assert!((1.999..14.001).contains(&speed), "{speed}");
                let rate = (progress.distance_m(t + 1e-4) - progress.distance_m(t - 1e-4)) / 2e-4;
                assert!((rate - speed).abs() < 1e-5);
                let back = progress.time_at(progress.distance_m(t)).expect("it moves");
                assert!((back - t).abs() < 1e-6);
            }
        }
    }
}

//! One seeded night: the road, everything beside and on it, and its lights.

use crate::chance::{Dice, Purpose};
use crate::object::{Object, Paint, StreetLamp};
use crate::road::{Pose, Progress, Road};
use crate::street::Site;

/// How far ahead of the last ego position the world is furnished, metres.
const AHEAD_M: f64 = 170.0;

/// A night street; a pure function of its seed, whether the ego vehicle drives, and time.
#[derive(Debug, Clone)]
pub struct Scene {
    pub(crate) road: Road,
    pub(crate) ego: Progress,
    pub(crate) objects: Vec<Object>,
    pub(crate) paint: Vec<Paint>,
    pub(crate) lamps: Vec<StreetLamp>,
    /// Light from everywhere, the same on every surface.
    pub(crate) ambient: f32,
    /// Intensity of one head lamp.
    pub(crate) head_lamp: f32,
}

impl Scene {
    /// The night of `seed`, furnished for times from 0 to `end_s` seconds; `drives` is false for
    /// a standing ego vehicle.
    #[must_use]
    pub fn new(seed: u64, end_s: f64, drives: bool) -> Self {
        let ego = if drives {
            Progress::new(seed)
        } else {
            Progress::standing()
        };
        let end_m = ego.distance_m(end_s.max(0.0)) + AHEAD_M;
        let road = Road::new(seed, end_m + 50.0);
        let site = Site {
            seed,
            road: &road,
            ego: &ego,
            end_m,
            end_s,
        };
        let (mut objects, mut paint, mut lamps) = (Vec::new(), Vec::new(), Vec::new());
        site.facades(&mut objects);
        site.poles(&mut objects, &mut lamps);
        site.cars(&mut objects);
        site.walkers(&mut objects);
        site.paint(&mut paint);
        let mut dice = Dice::new(seed, Purpose::Lights);
        let ambient = 10_f64.powf(dice.range(-2.0, -0.5)) as f32;
        let head_lamp = 10_f64.powf(dice.range(3.3, 4.0)) as f32;
        Self {
            road,
            ego,
            objects,
            paint,
            lamps,
            ambient,
            head_lamp,
        }
    }

    /// The ego camera's pose at `t` seconds.
    #[must_use]
    pub fn ego_pose(&self, t: f64) -> Pose {
        self.road.pose(self.ego.distance_m(t))
    }

    /// Ego speed in m/s and yaw rate in rad/s (positive to the left) at `t` seconds.
    #[must_use]
    pub fn ego_motion(&self, t: f64) -> (f64, f64) {
        let speed = self.ego.speed_mps(t);
        (speed, -speed * self.road.curvature(self.ego.distance_m(t)))
    }
}

//! Fills the roadside from a seed: facades, poles and lamps, parked and moving cars, walkers,
//! lane paint. Everything is placed in order of arc length, so that a longer drive begins with
//! exactly the shorter one.

use crate::chance::{Dice, Purpose};
use crate::object::{CAMERA_HEIGHT_M, Course, Glow, Material, Object, Paint, Shape, StreetLamp};
use crate::road::{Progress, Road};

/// The first thing stands this far behind the start of the drive.
const BEGIN_M: f64 = -90.0;
/// Middle of the oncoming lane.
const ONCOMING_M: f64 = -3.2;

/// What placement needs to know.
pub(crate) struct Site<'a> {
    pub seed: u64,
    pub road: &'a Road,
    pub ego: &'a Progress,
    /// Place things up to here.
    pub end_m: f64,
    /// The drive's end, seconds.
    pub end_s: f64,
}

fn grey(dice: &mut Dice, albedo: (f64, f64), colour: f64, frequency: [f32; 2]) -> Material {
    let tint = [(); 3].map(|()| (1.0 + colour * dice.range(-1.0, 1.0)) as f32);
    Material {
        albedo: dice.range(albedo.0, albedo.1) as f32,
        contrast: dice.range(0.5, 0.9) as f32,
        tint,
        frequency,
        seed: dice.bits() as u32,
        glow: Glow::Dark,
    }
}

impl Site<'_> {
    /// Rows of houses with gaps, both sides.
    pub(crate) fn facades(&self, out: &mut Vec<Object>) {
        for (index, side) in [-1.0, 1.0].into_iter().enumerate() {
            let mut dice = Dice::numbered(self.seed, Purpose::Facades, index as u64);
            let mut s = BEGIN_M;
            while s < self.end_m {
                let length = dice.range(6.0, 18.0);
                let (front, depth) = (dice.range(6.3, 12.0), dice.range(5.0, 9.0));
                let height = dice.range(3.5, 12.0);
                let mut material = grey(&mut dice, (0.12, 0.5), 0.2, [1.1, 4.3]);
                material.glow = Glow::Windows;
                out.push(Object {
                    shape: Shape::block(depth as f32, height as f32, length as f32, 0.0, 0.0),
                    course: Course::Fixed(
                        self.road
                            .beside(s + 0.5 * length, side * (front + 0.5 * depth)),
                    ),
                    material,
                });
                s += length
                    + if dice.chance(0.22) {
                        dice.range(3.0, 9.0)
                    } else {
                        0.0
                    };
            }
        }
    }

    /// Poles on both kerbs; every other one carries a lamp.
    pub(crate) fn poles(&self, out: &mut Vec<Object>, lamps: &mut Vec<StreetLamp>) {
        let mut dice = Dice::new(self.seed, Purpose::Poles);
        let mut s = BEGIN_M + dice.range(0.0, 10.0);
        let mut carries_lamp = true;
        while s < self.end_m {
            let right = if dice.chance(0.5) { 4.5 } else { -5.6 };
            let height = if carries_lamp {
                dice.range(5.0, 6.5)
            } else {
                dice.range(2.4, 4.0)
            };
            let pose = self.road.beside(s, right);
            let material = grey(&mut dice, (0.15, 0.4), 0.05, [2.0, 8.0]);
            let shape = Shape::upright(0.07, height as f32, 0.0);
            out.push(Object {
                shape,
                course: Course::Fixed(pose),
                material,
            });
            let intensity = dice.range(100.0, 600.0) as f32;
            if carries_lamp {
                let shape = Shape::upright(0.14, 0.4, height as f32);
                let material = Material {
                    glow: Glow::Bulb,
                    ..material
                };
                out.push(Object {
                    shape,
                    course: Course::Fixed(pose),
                    material,
                });
                lamps.push(StreetLamp {
                    x_m: pose.x_m,
                    z_m: pose.z_m,
                    y_m: CAMERA_HEIGHT_M - height as f32 - 0.2,
                    intensity,
                });
            }
            carries_lamp = !carries_lamp;
            s += dice.range(9.0, 17.0);
        }
    }

    /// Two boxes per car: body with lamps, cabin on top.
    fn car(dice: &mut Dice, course: Course, out: &mut Vec<Object>) {
        let (length, width) = (dice.range(3.8, 4.8) as f32, dice.range(1.65, 1.85) as f32);
        let paint = grey(dice, (0.05, 0.55), 0.5, [0.7, 4.0]);
        let body = Material {
            contrast: 0.25,
            glow: Glow::CarLamps,
            ..paint
        };
        let cabin = Material {
            albedo: 0.06,
            contrast: 0.4,
            glow: Glow::Dark,
            ..paint
        };
        out.push(Object {
            shape: Shape::block(width, 0.7, length, 0.25, 0.0),
            course,
            material: body,
        });
        let cabin_shape = Shape::block(width - 0.2, 0.55, length * 0.5, 0.95, -0.25);
        out.push(Object {
            shape: cabin_shape,
            course,
            material: cabin,
        });
    }

    /// Cars ahead in our lane, oncoming traffic, and a row of parked ones.
    pub(crate) fn cars(&self, out: &mut Vec<Object>) {
        let mut dice = Dice::new(self.seed, Purpose::Cars);
        if dice.chance(0.75) {
            let mut gap_m = dice.range(11.0, 26.0);
            for _ in 0..2 {
                let course = Course::Ahead {
                    gap_m,
                    wobble_m: dice.range(0.5, 3.0),
                    omega: dice.range(0.4, 0.9),
                    phase: dice.range(0.0, core::f64::consts::TAU),
                    right_m: dice.range(-0.3, 0.3),
                };
                Self::car(&mut dice, course, out);
                gap_m += dice.range(14.0, 30.0);
            }
        }
        let speed = dice.range(4.0, 15.0);
        let mut start_m = dice.range(5.0, 30.0);
        while start_m < self.end_m + speed * self.end_s.max(0.0) {
            let course = Course::Traffic {
                start_m,
                speed_mps: -speed,
                right_m: ONCOMING_M + dice.range(-0.2, 0.2),
                wobble_m: dice.range(0.0, 2.0),
                omega: dice.range(0.3, 0.8),
                phase: dice.range(0.0, core::f64::consts::TAU),
            };
            Self::car(&mut dice, course, out);
            start_m += dice.range(18.0, 60.0);
        }
        let mut dice = Dice::numbered(self.seed, Purpose::Cars, 1);
        let mut s = BEGIN_M;
        while s < self.end_m {
            s += dice.range(8.0, 45.0);
            let pose = self.road.beside(s, dice.range(2.75, 3.0));
            Self::car(&mut dice, Course::Fixed(pose), out);
        }
    }

    /// People beside and crossing the road, timed to be clear of the ego lane when it passes.
    pub(crate) fn walkers(&self, out: &mut Vec<Object>) {
        let mut dice = Dice::new(self.seed, Purpose::Walkers);
        let mut s = BEGIN_M;
        while s < self.end_m {
            s += dice.range(4.0, 20.0);
            let side = if dice.chance(0.5) { 1.0 } else { -1.0 };
            let right_m = side * dice.range(1.7, 5.0);
            let across_mps = (1.3 * dice.normal()).clamp(-2.6, 2.6);
            let along_mps = (0.7 * dice.normal()).clamp(-1.5, 1.5);
            let pass_standing = dice.range(-2.0, 12.0);
            let (radius, height) = (dice.range(0.2, 0.3), dice.range(1.5, 1.9));
            out.push(Object {
                shape: Shape::upright(radius as f32, height as f32, 0.0),
                course: Course::Walk {
                    along_m: s,
                    right_m,
                    across_mps,
                    along_mps,
                    pass_s: self.ego.time_at(s).unwrap_or(pass_standing),
                },
                material: grey(&mut dice, (0.08, 0.5), 0.4, [2.5, 9.0]),
            });
        }
    }

    /// A dashed line between the lanes, a solid one at each edge.
    pub(crate) fn paint(&self, out: &mut Vec<Paint>) {
        let mut s = BEGIN_M;
        while s < self.end_m {
            out.push(Paint {
                pose: self.road.beside(s, -1.6),
                half: [0.06, 1.5],
            });
            for right in [-4.8_f64, 1.75] {
                for i in 0..4 {
                    let at = s + 2.25 * f64::from(i);
                    let stretch = 1.0 + right.abs() * self.road.curvature(at).abs();
                    let half = [0.06, (1.125 * stretch) as f32];
                    out.push(Paint {
                        pose: self.road.beside(at, right),
                        half,
                    });
                }
            }
            s += 9.0;
        }
    }
}

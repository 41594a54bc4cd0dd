//! The world frozen at one instant, as seen from one pose: every object near enough, in that
//! pose's frame (x right, y down, z ahead), and the cast of a single ray into it.

use crate::object::{CAMERA_HEIGHT_M, Shape};
use crate::road::Pose;
use crate::scene::Scene;

/// Identifier of the sky: nothing was hit.
pub const SKY: u16 = 0;
/// Identifier of the ground.
pub const GROUND: u16 = 1;
/// Identifier of the first object; the others follow in the scene's order.
pub(crate) const FIRST_OBJECT: u16 = 2;

/// Nearer than this nothing is seen, metres.
pub(crate) const NEAR_M: f32 = 0.2;
/// The ground ends here, metres.
pub(crate) const GROUND_END_M: f32 = 400.0;

/// One object in the observer's frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Placed {
    /// Identifier: `FIRST_OBJECT` plus the index in the scene.
    pub id: u16,
    pub shape: Placement,
}

/// A shape with its place in the observer's frame.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Placement {
    /// Centre, cosine and sine of the heading relative to the observer, half sizes.
    Box {
        centre: [f32; 3],
        cos: f32,
        sin: f32,
        half: [f32; 3],
    },
    /// Axis position, radius, and the y of the two sphere centres.
    Capsule {
        x: f32,
        z: f32,
        radius: f32,
        top_y: f32,
        bottom_y: f32,
    },
}

/// A painted rectangle in the observer's frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PlacedPaint {
    pub x: f32,
    pub z: f32,
    pub cos: f32,
    pub sin: f32,
    pub half: [f32; 2],
}

/// A lamp in the observer's frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PlacedLamp {
    pub position: [f32; 3],
    pub intensity: f32,
}

/// A scene at one instant in the frame of an observer at ego height.
#[derive(Debug, Clone)]
pub struct Snapshot {
    /// Where the observer is.
    pub(crate) observer: Pose,
    pub(crate) objects: Vec<Placed>,
    pub(crate) paint: Vec<PlacedPaint>,
    pub(crate) lamps: Vec<PlacedLamp>,
}

/// What a camera needs around it: how far it sees objects and paint, and whether behind too.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Horizon {
    /// Objects beyond this distance are left out, metres.
    pub objects_m: f32,
    /// Keep what lies behind the observer.
    pub behind: bool,
    /// Keep paint and lamps, which only an image shows.
    pub lights: bool,
}

impl Horizon {
    /// For a forward camera.
    pub const CAMERA: Self = Self {
        objects_m: 140.0,
        behind: false,
        lights: true,
    };
    /// For a LiDAR whose returns end at 60 m.
    pub const LIDAR: Self = Self {
        objects_m: 64.0,
        behind: true,
        lights: false,
    };
}

/// Paint further than this is under a pixel wide.
const PAINT_END_M: f32 = 60.0;
/// Lamps further than this light nothing that is seen well.
const LAMP_END_M: f32 = 70.0;

impl Snapshot {
    /// The scene at `t` seconds around the ego vehicle.
    #[must_use]
    pub fn new(scene: &Scene, t: f64, horizon: Horizon) -> Self {
        Self::from_pose(scene, t, scene.ego_pose(t), horizon)
    }

    /// The scene at `t` seconds around any observer at camera height.
    #[must_use]
    pub fn from_pose(scene: &Scene, t: f64, observer: Pose, horizon: Horizon) -> Self {
        let mut objects = Vec::with_capacity(96);
        for (index, object) in scene.objects.iter().enumerate() {
            let pose = object.centre(&scene.road, &scene.ego, t);
            let reach = object.shape.reach_m();
            let (dx, dz) = (pose.x_m - observer.x_m, pose.z_m - observer.z_m);
            if dx.hypot(dz) > f64::from(horizon.objects_m + reach) {
                continue;
            }
            let (x, z) = observer.local(pose.x_m, pose.z_m);
            let (x, z) = (x as f32, z as f32);
            if !horizon.behind && z + reach < NEAR_M {
                continue;
            }
            let shape = match object.shape {
                Shape::Box { half, centre_y, .. } => {
                    let (sin, cos) = (pose.heading_rad - observer.heading_rad).sin_cos();
                    Placement::Box {
                        centre: [x, centre_y, z],
                        cos: cos as f32,
                        sin: sin as f32,
                        half,
                    }
                }
                Shape::Capsule {
                    radius,
                    top_y,
                    bottom_y,
                } => Placement::Capsule {
                    x,
                    z,
                    radius,
                    top_y,
                    bottom_y,
                },
            };
            objects.push(Placed {
                id: FIRST_OBJECT + index as u16,
                shape,
            });
        }
        let mut snapshot = Self {
            observer,
            objects,
            paint: Vec::new(),
            lamps: Vec::new(),
        };
        if horizon.lights {
            snapshot.place_lights(scene);
        }
        snapshot
    }

    fn place_lights(&mut self, scene: &Scene) {
        let observer = self.observer;
        for paint in &scene.paint {
            let (x, z) = observer.local(paint.pose.x_m, paint.pose.z_m);
            let (x, z) = (x as f32, z as f32);
            if z > -3.0 && z < PAINT_END_M && x.abs() < PAINT_END_M {
                let (sin, cos) = (paint.pose.heading_rad - observer.heading_rad).sin_cos();
                let (cos, sin) = (cos as f32, sin as f32);
                self.paint.push(PlacedPaint {
                    x,
                    z,
                    cos,
                    sin,
                    half: paint.half,
                });
            }
        }
        for lamp in &scene.lamps {
            let (x, z) = observer.local(lamp.x_m, lamp.z_m);
            let position = [x as f32, lamp.y_m, z as f32];
            if position[0].hypot(position[2]) < LAMP_END_M {
                self.lamps.push(PlacedLamp {
                    position,
                    intensity: lamp.intensity,
                });
            }
        }
    }

    /// First hit of the ray `origin + k * direction`, k > `near`: its k and identifier.
    ///
    /// One ray, every object: the plain reference the tiled renderer is held against, and the
    /// LiDAR's laser.
    #[must_use]
    pub fn cast(&self, origin: [f32; 3], direction: [f32; 3], near: f32) -> Option<(f32, u16)> {
        self.cast_among(self.objects.iter(), origin, direction, near)
    }

    /// As [`cast`](Self::cast), with only some of the objects.
    pub(crate) fn cast_among<'a>(
        &self,
        objects: impl Iterator<Item = &'a Placed>,
        origin: [f32; 3],
        direction: [f32; 3],
        near: f32,
    ) -> Option<(f32, u16)> {
        let mut best = (f32::INFINITY, SKY);
        if direction[1] > 0.0 {
            let k = (CAMERA_HEIGHT_M - origin[1]) / direction[1];
            if k > near && k < GROUND_END_M {
                best = (k, GROUND);
            }
        }
        for object in objects {
            let k = object.shape.hit(origin, direction, near);
            if k < best.0 {
                best = (k, object.id);
            }
        }
        (best.1 != SKY).then_some(best)
    }
}

impl Placement {
    /// The k > `near` at which the ray enters the shape, infinite when it does not.
    pub(crate) fn hit(&self, origin: [f32; 3], direction: [f32; 3], near: f32) -> f32 {
        let [ox, oy, oz] = origin;
        let [dx, dy, dz] = direction;
        match *self {
            Self::Box {
                centre,
                cos,
                sin,
                half,
            } => {
                let (rx, rz) = (ox - centre[0], oz - centre[2]);
                let o = [cos * rx - sin * rz, oy - centre[1], sin * rx + cos * rz];
                let d = [cos * dx - sin * dz, dy, sin * dx + cos * dz];
                let (mut enter, mut leave) = (f32::NEG_INFINITY, f32::INFINITY);
                for axis in 0..3 {
                    let inverse = 1.0 / away_from_zero(d[axis]);
                    let a = (-half[axis] - o[axis]) * inverse;
                    let b = (half[axis] - o[axis]) * inverse;
                    enter = enter.max(a.min(b));
                    leave = leave.min(a.max(b));
                }
                if enter <= leave && enter > near {
                    enter
                } else {
                    f32::INFINITY
                }
            }
            Self::Capsule {
                x,
                z,
                radius,
                top_y,
                bottom_y,
            } => {
                let (cx, cz) = (x - ox, z - oz);
                let a = dx * dx + dz * dz;
                let cross = dx * cz - dz * cx;
                let disc = a * radius * radius - cross * cross;
                if disc < 0.0 {
                    return f32::INFINITY;
                }
                let k = ((dx * cx + dz * cz) - disc.sqrt()) / a;
                let y = oy + k * dy;
                let k = if y < top_y {
                    sphere([cx, top_y - oy, cz], radius, direction)
                } else if y > bottom_y {
                    sphere([cx, bottom_y - oy, cz], radius, direction)
                } else {
                    k
                };
                if k > near { k } else { f32::INFINITY }
            }
        }
    }
}

/// Entry into a sphere at `c` from the ray's origin; stable far away because the discriminant is
/// taken from the cross product.
fn sphere(c: [f32; 3], radius: f32, d: [f32; 3]) -> f32 {
    let a = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
    let cross = [
        d[1] * c[2] - d[2] * c[1],
        d[2] * c[0] - d[0] * c[2],
        d[0] * c[1] - d[1] * c[0],
    ];
    let disc =
        a * radius * radius - (cross[0] * cross[0] + cross[1] * cross[1] + cross[2] * cross[2]);
    if disc < 0.0 {
        return f32::INFINITY;
    }
    ((d[0] * c[0] + d[1] * c[1] + d[2] * c[2]) - disc.sqrt()) / a
}

/// Keeps a slab's reciprocal finite.
#[inline(always)]
pub(crate) fn away_from_zero(d: f32) -> f32 {
    if d < 1e-9 && d > -1e-9 { 1e-9 } else { d }
}

impl Scene {
    /// Whether the object moves on its own.
    #[must_use]
    pub fn is_mover(&self, id: u16) -> bool {
        self.object(id)
            .is_some_and(|object| object.course.is_moving())
    }

    /// Whether the object is narrower than 0.3 m.
    #[must_use]
    pub fn is_thin(&self, id: u16) -> bool {
        self.object(id).is_some_and(crate::object::Object::is_thin)
    }

    /// Mean albedo of what `id` names; 0.2 for the ground.
    #[must_use]
    pub fn albedo(&self, id: u16) -> f32 {
        self.object(id).map_or(0.2, |object| object.material.albedo)
    }

    pub(crate) fn object(&self, id: u16) -> Option<&crate::object::Object> {
        self.objects.get(usize::from(id.checked_sub(FIRST_OBJECT)?))
    }
}

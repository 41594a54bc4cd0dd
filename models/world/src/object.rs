//! What stands and moves in the world: shapes, surfaces, and where each is at a given time.

use crate::road::{Pose, Progress, Road};

/// Camera centre above the ground, metres.
pub const CAMERA_HEIGHT_M: f32 = 1.5;

/// An analytic shape. Vertical positions are camera-like: y points down, 0 at camera height, so
/// the ground is at +1.5 m.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Shape {
    /// Upright box: half sizes (right, down, ahead), centre height, and how far ahead of the
    /// object's pose its centre sits.
    Box {
        half: [f32; 3],
        centre_y: f32,
        ahead_m: f64,
    },
    /// Upright capsule: radius and the y of its two sphere centres (upper first).
    Capsule {
        radius: f32,
        top_y: f32,
        bottom_y: f32,
    },
}

impl Shape {
    /// A box standing on the ground or floating `lift` above it.
    pub(crate) fn block(width: f32, height: f32, length: f32, lift: f32, ahead_m: f64) -> Self {
        Self::Box {
            half: [width * 0.5, height * 0.5, length * 0.5],
            centre_y: CAMERA_HEIGHT_M - lift - height * 0.5,
            ahead_m,
        }
    }

    /// A capsule from `lift` to `lift + height` above the ground.
    pub(crate) fn upright(radius: f32, height: f32, lift: f32) -> Self {
        Self::Capsule {
            radius,
            top_y: CAMERA_HEIGHT_M - lift - height + radius,
            bottom_y: CAMERA_HEIGHT_M - lift - radius,
        }
    }

    /// Smallest horizontal extent, metres.
    pub(crate) fn width_m(&self) -> f32 {
        match *self {
            Self::Box { half, .. } => 2.0 * half[0].min(half[2]),
            Self::Capsule { radius, .. } => 2.0 * radius,
        }
    }

    /// Radius of the circle around the shape's centre that holds it, seen from above.
    pub(crate) fn reach_m(&self) -> f32 {
        match *self {
            Self::Box { half, .. } => half[0].hypot(half[2]),
            Self::Capsule { radius, .. } => radius,
        }
    }
}

/// Light that a surface gives off by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Glow {
    /// None.
    Dark,
    /// A car body: head lamps at its front face, tail lamps at its rear face.
    CarLamps,
    /// A facade: some of its windows are lit.
    Windows,
    /// A street lamp's head: all of it.
    Bulb,
}

/// How a surface looks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Material {
    /// Mean albedo.
    pub albedo: f32,
    /// Amplitude of the two noise octaves relative to the mean.
    pub contrast: f32,
    /// Colour, about 1 per channel.
    pub tint: [f32; 3],
    /// Cells per metre of the coarse and the fine octave.
    pub frequency: [f32; 2],
    /// Seed of the noise.
    pub seed: u32,
    pub glow: Glow,
}

/// Where an object is as time passes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Course {
    /// Stands.
    Fixed(Pose),
    /// Drives along the road at a steady speed with a slow wobble; negative speed: towards us.
    Traffic {
        start_m: f64,
        speed_mps: f64,
        right_m: f64,
        wobble_m: f64,
        omega: f64,
        phase: f64,
    },
    /// Drives ahead of the ego vehicle at a breathing distance.
    Ahead {
        gap_m: f64,
        wobble_m: f64,
        omega: f64,
        phase: f64,
        right_m: f64,
    },
    /// Walks across (and a little along) the road; at `pass_s` it is `right_m` beside it.
    Walk {
        along_m: f64,
        right_m: f64,
        across_mps: f64,
        along_mps: f64,
        pass_s: f64,
    },
}

impl Course {
    /// Pose at `t` seconds.
    pub(crate) fn pose(&self, road: &Road, ego: &Progress, t: f64) -> Pose {
        match *self {
            Self::Fixed(pose) => pose,
            Self::Traffic {
                start_m,
                speed_mps,
                right_m,
                wobble_m,
                omega,
                phase,
            } => {
                let s = start_m + speed_mps * t + wobble_m * (omega * t + phase).sin();
                let mut pose = road.beside(s, right_m);
                if speed_mps < 0.0 {
                    pose.heading_rad += core::f64::consts::PI;
                }
                pose
            }
            Self::Ahead {
                gap_m,
                wobble_m,
                omega,
                phase,
                right_m,
            } => {
                let gap = gap_m + wobble_m * (omega * t + phase).sin();
                road.beside(ego.distance_m(t) + gap, right_m)
            }
            Self::Walk {
                along_m,
                right_m,
                across_mps,
                along_mps,
                pass_s,
            } => {
                let since = t - pass_s;
                road.beside(along_m + along_mps * since, right_m + across_mps * since)
            }
        }
    }

    /// Whether it moves on its own.
    pub(crate) fn is_moving(&self) -> bool {
        match *self {
            Self::Fixed(_) => false,
            Self::Traffic { .. } | Self::Ahead { .. } => true,
            Self::Walk {
                across_mps,
                along_mps,
                ..
            } => across_mps != 0.0 || along_mps != 0.0,
        }
    }
}

/// One object of the world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Object {
    pub shape: Shape,
    pub course: Course,
    pub material: Material,
}

impl Object {
    /// Narrower than 0.3 m.
    pub(crate) fn is_thin(&self) -> bool {
        self.shape.width_m() < 0.3
    }

    /// Where its shape's centre is at `t`, and which way it faces.
    pub(crate) fn centre(&self, road: &Road, ego: &Progress, t: f64) -> Pose {
        let pose = self.course.pose(road, ego, t);
        match self.shape {
            Shape::Box { ahead_m, .. } if ahead_m != 0.0 => {
                let (x_m, z_m) = pose.world(0.0, ahead_m);
                Pose { x_m, z_m, ..pose }
            }
            _ => pose,
        }
    }
}

/// A painted rectangle on the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Paint {
    pub pose: Pose,
    /// Half width across and half length along its heading, metres.
    pub half: [f32; 2],
}

/// A street lamp's light source.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct StreetLamp {
    pub x_m: f64,
    pub z_m: f64,
    /// y of the source, camera-like (negative: above the camera).
    pub y_m: f32,
    /// Intensity in the scene's unit of radiance.
    pub intensity: f32,
}

//! The pinhole all images of the world are taken with.

/// Field of view of camera and event camera, degrees.
pub const FIELD_OF_VIEW_DEG: f64 = 52.0;

/// A square pinhole image; pixel centres at whole coordinates, principal point in the middle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Optics {
    /// Width and height, pixels.
    pub size: usize,
    /// Focal length, pixels.
    pub focal_px: f32,
    /// Principal point in both directions, pixels.
    pub centre_px: f32,
}

impl Optics {
    /// The default field of view on a grid of `size` by `size` pixels.
    #[must_use]
    pub fn new(size: usize) -> Self {
        let half = size as f64 / 2.0;
        let focal = half / (FIELD_OF_VIEW_DEG.to_radians() / 2.0).tan();
        Self {
            size,
            focal_px: focal as f32,
            centre_px: (half - 0.5) as f32,
        }
    }

    /// x (or y) of the ray with unit z through pixel coordinate `p`.
    #[must_use]
    #[inline(always)]
    pub fn slope(&self, p: f32) -> f32 {
        (p - self.centre_px) * (1.0 / self.focal_px)
    }

    /// Pixel coordinate of a ray's slope.
    #[must_use]
    #[inline(always)]
    pub fn pixel(&self, slope: f32) -> f32 {
        slope * self.focal_px + self.centre_px
    }
}

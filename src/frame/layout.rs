//! Where the planes lie within a payload.

use super::{Block, FrameError};

fn check(
    what: &'static str,
    value: u32,
    ok: bool,
    allowed: &'static str,
) -> Result<usize, FrameError> {
    let refused = FrameError::Dimension {
        what,
        value,
        allowed,
    };
    if ok {
        usize::try_from(value).map_err(|_| refused)
    } else {
        Err(refused)
    }
}

/// Where the planes of a bundle lie: voxels `[T, B, H, W]`, sparse depth `[T, H, W]`, image
/// `[3, H, W]`, all `f32`, each starting on a cache line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BundleLayout {
    /// Steps T.
    pub steps: usize,
    /// Voxel bins per step B.
    pub bins: usize,
    /// Rows H.
    pub height: usize,
    /// Columns W.
    pub width: usize,
}

impl BundleLayout {
    /// A layout of these dimensions.
    ///
    /// # Errors
    /// When a dimension is out of range; H and W must be multiples of 16.
    pub fn new(steps: u32, bins: u32, height: u32, width: u32) -> Result<Self, FrameError> {
        let plane = |v: u32| v.is_multiple_of(16) && (16..=4096).contains(&v);
        Ok(Self {
            steps: check("steps", steps, (1..=16).contains(&steps), "1 to 16")?,
            bins: check("bins", bins, (2..=16).contains(&bins), "2 to 16")?,
            height: check(
                "height",
                height,
                plane(height),
                "a multiple of 16 up to 4096",
            )?,
            width: check("width", width, plane(width), "a multiple of 16 up to 4096")?,
        })
    }

    /// Floats in one plane H x W.
    #[must_use]
    pub fn plane(&self) -> usize {
        self.height * self.width
    }

    /// Floats of the voxel grids.
    #[must_use]
    pub fn voxels_len(&self) -> usize {
        self.steps * self.bins * self.plane()
    }

    /// Floats of the sparse depth maps.
    #[must_use]
    pub fn sparse_len(&self) -> usize {
        self.steps * self.plane()
    }

    /// Floats of the image planes.
    #[must_use]
    pub fn image_len(&self) -> usize {
        3 * self.plane()
    }

    /// Blocks of the whole payload.
    #[must_use]
    pub fn blocks(&self) -> usize {
        (self.voxels_len() + self.sparse_len() + self.image_len()) / Block::LANES
    }

    /// Bytes of the whole payload.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.blocks() * size_of::<Block>()
    }

    /// The planes of a payload.
    ///
    /// # Errors
    /// When the payload has another size.
    pub fn planes<'a>(&self, payload: &'a [Block]) -> Result<BundlePlanes<'a>, FrameError> {
        self.expect(payload.len())?;
        let floats: &[f32] = bytemuck::cast_slice(payload);
        let (voxels, rest) = floats.split_at(self.voxels_len());
        let (sparse, image) = rest.split_at(self.sparse_len());
        Ok(BundlePlanes {
            voxels,
            sparse,
            image,
        })
    }

    /// The planes of a payload, to be written.
    ///
    /// # Errors
    /// When the payload has another size.
    pub fn planes_mut<'a>(
        &self,
        payload: &'a mut [Block],
    ) -> Result<BundlePlanesMut<'a>, FrameError> {
        self.expect(payload.len())?;
        let floats: &mut [f32] = bytemuck::cast_slice_mut(payload);
        let (voxels, rest) = floats.split_at_mut(self.voxels_len());
        let (sparse, image) = rest.split_at_mut(self.sparse_len());
        Ok(BundlePlanesMut {
            voxels,
            sparse,
            image,
        })
    }

    fn expect(&self, actual: usize) -> Result<(), FrameError> {
        let needed = self.blocks();
        if actual == needed {
            Ok(())
        } else {
            Err(FrameError::Length { needed, actual })
        }
    }
}

/// A bundle's planes.
#[derive(Debug, Clone, Copy)]
pub struct BundlePlanes<'a> {
    /// `[T, B, H, W]`, in `[-1, 1]`.
    pub voxels: &'a [f32],
    /// `[T, H, W]`, metres, 0 where there is no return.
    pub sparse: &'a [f32],
    /// `[3, H, W]`, encoded, in `[0, 1]`.
    pub image: &'a [f32],
}

/// A bundle's planes, to be written.
#[derive(Debug)]
pub struct BundlePlanesMut<'a> {
    /// `[T, B, H, W]`, in `[-1, 1]`.
    pub voxels: &'a mut [f32],
    /// `[T, H, W]`, metres, 0 where there is no return.
    pub sparse: &'a mut [f32],
    /// `[3, H, W]`, encoded, in `[0, 1]`.
    pub image: &'a mut [f32],
}

/// Where the planes of a depth frame lie: depth `[H, W]` in metres, then confidence `[H, W]`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DepthLayout {
    /// Rows H.
    pub height: usize,
    /// Columns W.
    pub width: usize,
}

impl DepthLayout {
    /// A layout of these dimensions.
    ///
    /// # Errors
    /// When a dimension is not a multiple of 16 or out of range.
    pub fn new(height: u32, width: u32) -> Result<Self, FrameError> {
        let BundleLayout { height, width, .. } = BundleLayout::new(1, 2, height, width)?;
        Ok(Self { height, width })
    }

    /// Floats in one plane H x W.
    #[must_use]
    pub fn plane(&self) -> usize {
        self.height * self.width
    }

    /// Blocks of the whole payload.
    #[must_use]
    pub fn blocks(&self) -> usize {
        2 * self.plane() / Block::LANES
    }

    /// Depth and confidence of a payload.
    ///
    /// # Errors
    /// When the payload has another size.
    pub fn planes<'a>(&self, payload: &'a [Block]) -> Result<(&'a [f32], &'a [f32]), FrameError> {
        self.expect(payload.len())?;
        let floats: &[f32] = bytemuck::cast_slice(payload);
        Ok(floats.split_at(self.plane()))
    }

    /// Depth and confidence of a payload, to be written.
    ///
    /// # Errors
    /// When the payload has another size.
    pub fn planes_mut<'a>(
        &self,
        payload: &'a mut [Block],
    ) -> Result<(&'a mut [f32], &'a mut [f32]), FrameError> {
        self.expect(payload.len())?;
        let floats: &mut [f32] = bytemuck::cast_slice_mut(payload);
        Ok(floats.split_at_mut(self.plane()))
    }

    fn expect(&self, actual: usize) -> Result<(), FrameError> {
        let needed = self.blocks();
        if actual == needed {
            Ok(())
        } else {
            Err(FrameError::Length { needed, actual })
        }
    }
}

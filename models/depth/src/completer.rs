//! The two ways to a dense map that need no network, behind one set of reused buffers.
//!
//! Nothing here allocates after [`Completer::new`]; an integration test counts.

use crate::fill::Filler;
use crate::nearest::NearestField;
use crate::size::{Size, SizeError};

/// Distance over which the confidence of a filled pixel falls to 1/e, pixels.
pub const CONFIDENCE_RANGE_PX: f32 = 8.0;

/// Squared distances below this take their confidence from a table (out to 64 pixels).
const TABLE_LEN: usize = 64 * 64;

/// Confidence of a completed pixel, `exp(-distance_px / 8)`: 1 at a return, 0 infinitely far away.
pub fn confidence(distance_px: f32) -> f32 {
    (-distance_px / CONFIDENCE_RANGE_PX).exp()
}

/// Completes sparse depth maps of one size.
///
/// Maps are slices of `width * height` depths in metres, row by row, top left first. A pixel of
/// the sparse map holds a return where its depth is finite and above zero; everything else is
/// empty.
///
/// ```
/// use noctule_depth::Completer;
///
/// let mut completer = Completer::new(3, 1)?;
/// let (mut depth, mut distance_px) = ([0.0; 3], [0.0; 3]);
/// completer.nearest(&[0.0, 0.0, 7.5], &mut depth, &mut distance_px)?;
/// assert_eq!(depth, [7.5; 3]);
/// assert_eq!(distance_px, [2.0, 1.0, 0.0]);
/// # Ok::<(), noctule_depth::SizeError>(())
/// ```
pub struct Completer {
    size: Size,
    field: NearestField,
    filler: Filler,
    confidence_by_distance_sq: Vec<f32>,
}

impl Completer {
    /// Allocates every buffer for maps of `width` x `height` pixels.
    ///
    /// Errs if a side is zero or above [`crate::SIDE_MAX`].
    pub fn new(width: usize, height: usize) -> Result<Self, SizeError> {
        let size = Size::new(width, height)?;
        Ok(Self {
            size,
            field: NearestField::new(size),
            filler: Filler::new(size),
            confidence_by_distance_sq: (0..TABLE_LEN)
                .map(|distance_sq| confidence((distance_sq as f32).sqrt()))
                .collect(),
        })
    }

    /// The size every map must have.
    pub fn size(&self) -> Size {
        self.size
    }

    /// Gives every pixel the depth of its nearest return by exact Euclidean distance.
    ///
    /// Of several returns at equal distance the first row by row wins. `distance_px` receives the
    /// distance in pixels, 0 at a return. A map without returns yields depth 0 and distance
    /// infinity everywhere. Errs if a slice is not `width * height` long; nothing is written then.
    pub fn nearest(
        &mut self,
        sparse: &[f32],
        depth: &mut [f32],
        distance_px: &mut [f32],
    ) -> Result<(), SizeError> {
        self.size.check("sparse", sparse.len())?;
        self.size.check("depth", depth.len())?;
        self.size.check("distance_px", distance_px.len())?;
        if !self.field.find(sparse) {
            depth.fill(0.0);
            distance_px.fill(f32::INFINITY);
            return Ok(());
        }
        for (depth, &source) in depth.iter_mut().zip(&self.field.source) {
            *depth = sparse[source as usize];
        }
        for (distance_px, &distance_sq) in distance_px.iter_mut().zip(&self.field.distance_sq) {
            *distance_px = (distance_sq as f32).sqrt();
        }
        Ok(())
    }

    /// As [`Completer::nearest`], with the [`confidence`] of every pixel in place of its distance;
    /// says whether there was any return. Without one both maps are 0 everywhere.
    pub fn nearest_with_confidence(
        &mut self,
        sparse: &[f32],
        depth: &mut [f32],
        confidence: &mut [f32],
    ) -> Result<bool, SizeError> {
        self.size.check("sparse", sparse.len())?;
        self.size.check("depth", depth.len())?;
        self.size.check("confidence", confidence.len())?;
        if !self.field.find(sparse) {
            depth.fill(0.0);
            confidence.fill(0.0);
            return Ok(false);
        }
        for (depth, &source) in depth.iter_mut().zip(&self.field.source) {
            *depth = sparse[source as usize];
        }
        let table = &self.confidence_by_distance_sq;
        for (value, &distance_sq) in confidence.iter_mut().zip(&self.field.distance_sq) {
            *value = match table.get(distance_sq as usize) {
                Some(&known) => known,
                None => self::confidence((distance_sq as f32).sqrt()),
            };
        }
        Ok(true)
    }

    /// Gives every pixel what `values` has at its nearest return, as the last search found it: that
    /// of any of the methods above and below. Before any search every pixel gets the first value.
    ///
    /// Errs if a slice is not `width * height` long; nothing is written then.
    pub fn spread(&self, values: &[f32], out: &mut [f32]) -> Result<(), SizeError> {
        self.size.check("values", values.len())?;
        self.size.check("out", out.len())?;
        for (out, &source) in out.iter_mut().zip(&self.field.source) {
            *out = values[source as usize];
        }
        Ok(())
    }

    /// Completes the map with surfaces fitted to the returns; see the crate's first page for how.
    ///
    /// Every pixel receives a depth above zero as soon as one return exists, and its
    /// [`confidence`]. A map without returns yields depth 0 and confidence 0 everywhere. Errs if a
    /// slice is not `width * height` long; nothing is written then.
    pub fn fill(
        &mut self,
        sparse: &[f32],
        depth: &mut [f32],
        confidence: &mut [f32],
    ) -> Result<(), SizeError> {
        self.size.check("sparse", sparse.len())?;
        self.size.check("depth", depth.len())?;
        self.size.check("confidence", confidence.len())?;
        if !self.field.find(sparse) {
            depth.fill(0.0);
            confidence.fill(0.0);
            return Ok(());
        }
        self.filler.fill(&self.field, sparse, depth);
        for (confidence, &distance_sq) in confidence.iter_mut().zip(&self.field.distance_sq) {
            *confidence = match self.confidence_by_distance_sq.get(distance_sq as usize) {
                Some(&tabled) => tabled,
                None => self::confidence((distance_sq as f32).sqrt()),
            };
        }
        Ok(())
    }
}

//! How far apart the returns of a map lie, learnt from the map itself.

use super::surface::Surface;

/// Bins per pixel of the spacing histogram.
const BINS_PER_PX: f32 = 4.0;
/// Longest spacing told apart, pixels.
const RISE_PX_MAX: usize = 128;
/// Largest cell told apart, pixels.
const AREA_PX_MAX: usize = 4096;
/// A pixel of a scattered pattern lies within this times the root of the typical cell.
const REACH_BY_AREA: f32 = 1.1;
/// A pixel between two rings lies within this times the distance of the rings.
const REACH_BY_RISE: f32 = 0.9;
/// Widest blur, pixels between taps.
const BLEND_STEP_MAX: usize = 64;

/// Histograms of cell areas and of the distances between rings.
pub(crate) struct Spacing {
    areas: Vec<u32>,
    rises: Vec<u32>,
    returns: u32,
    risen: u32,
}

impl Spacing {
    pub(crate) fn new() -> Self {
        Self {
            areas: vec![0; AREA_PX_MAX + 1],
            rises: vec![0; RISE_PX_MAX * BINS_PER_PX as usize + 1],
            returns: 0,
            risen: 0,
        }
    }

    pub(crate) fn clear(&mut self) {
        self.areas.fill(0);
        self.rises.fill(0);
        (self.returns, self.risen) = (0, 0);
    }

    pub(crate) fn count(&mut self, surface: &Surface) {
        self.areas[(surface.area_px as usize).min(AREA_PX_MAX)] += 1;
        self.returns += 1;
        if let Some(rise_px) = surface.rise_px() {
            let bin = ((rise_px * BINS_PER_PX).round() as usize).min(self.rises.len() - 1);
            self.rises[bin] += 1;
            self.risen += 1;
        }
    }

    /// Distance from a return up to which a pixel still lies inside the pattern.
    pub(crate) fn reach_px(&self) -> f32 {
        let area_px = median(&self.areas, self.returns) as f32;
        (REACH_BY_AREA * area_px.sqrt()).max(REACH_BY_RISE * self.ring_px())
    }

    /// Largest power of two not above half the distance of the rings.
    pub(crate) fn blend_step(&self) -> usize {
        let half = (self.ring_px() / 2.0) as usize;
        1 << half.clamp(1, BLEND_STEP_MAX).ilog2()
    }

    fn ring_px(&self) -> f32 {
        median(&self.rises, self.risen) as f32 / BINS_PER_PX
    }
}

/// Bin of the lower median of `total` entries; 0 of none.
fn median(bins: &[u32], total: u32) -> usize {
    let mut left = total.div_ceil(2);
    for (bin, &count) in bins.iter().enumerate() {
        if count >= left {
            return bin;
        }
        left -= count;
    }
    0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians_by_hand() {
        assert_eq!(median(&[0, 1, 0, 1, 1], 3), 3);
        assert_eq!(median(&[0, 2, 0, 2], 4), 1);
        assert_eq!(median(&[5], 5), 0);
        assert_eq!(median(&[0, 0], 0), 0);
    }

    #[test]
    fn reach_and_step_follow_the_rings() {
        let mut spacing = Spacing::new();
        let pair = |rise: f32| {
            let (mut a, mut b) = (Surface::new(0.0, 0.0, 0.1), Surface::new(0.0, rise, 0.1));
            Surface::meet(&mut a, &mut b);
            a.area_px = 9;
            a
        };
        for _ in 0..3 {
            spacing.count(&pair(20.0));
        }
        assert_eq!((spacing.reach_px(), spacing.blend_step()), (18.0, 8));
        spacing.clear();
        spacing.count(&pair(1.0));
        assert_eq!((spacing.reach_px(), spacing.blend_step()), (1.1 * 3.0, 1));
        spacing.clear();
        spacing.count(&pair(1000.0));
        assert_eq!(spacing.blend_step(), 64);
        spacing.clear();
        spacing.count(&Surface::new(0.0, 0.0, 0.1));
        assert_eq!(spacing.blend_step(), 1, "a lone return has no rings");
    }
}

//! Least and largest value around every pixel, over a square window, in time that hardly depends
//! on the window: runs of 1, 2, 4, ... pixels are doubled, and two overlapping runs make a window.

use crate::size::{Size, SizeError};

/// Finds the extremes of maps of one size; allocates once.
///
/// ```
/// use noctule_depth::Surround;
///
/// let mut surround = Surround::new(5, 1, 1)?;
/// let (mut least, mut largest) = ([0.0; 5], [0.0; 5]);
/// surround.extremes(&[f32::NAN, 3.0, 7.0, f32::NAN, f32::NAN], &mut least, &mut largest)?;
/// assert_eq!(least, [3.0, 3.0, 3.0, 7.0, f32::INFINITY]);
/// assert_eq!(largest, [3.0, 7.0, 7.0, 7.0, f32::NEG_INFINITY]);
/// # Ok::<(), noctule_depth::SizeError>(())
/// ```
pub struct Surround {
    size: Size,
    reach: usize,
    /// One row with `reach` empty pixels on both sides, twice.
    row: [Vec<f32>; 2],
    /// The whole map with `reach` empty rows above and below, twice.
    rows: [Vec<f32>; 2],
}

impl Surround {
    /// For maps of `width` x `height` pixels and windows of `2 reach + 1` pixels.
    ///
    /// Errs if a side is zero or above [`crate::SIDE_MAX`].
    pub fn new(width: usize, height: usize, reach: usize) -> Result<Self, SizeError> {
        let size = Size::new(width, height)?;
        Ok(Self {
            size,
            reach,
            row: [(); 2].map(|()| vec![0.0; width + 2 * reach]),
            rows: [(); 2].map(|()| vec![0.0; (height + 2 * reach) * width]),
        })
    }

    /// `least` and `largest` of the `values` in the window around each pixel; NaN stands for no
    /// value. Where a window holds none they are infinity and minus infinity.
    ///
    /// Errs if a slice is not `width * height` long; nothing is written then.
    pub fn extremes(
        &mut self,
        values: &[f32],
        least: &mut [f32],
        largest: &mut [f32],
    ) -> Result<(), SizeError> {
        self.size.check("values", values.len())?;
        self.size.check("least", least.len())?;
        self.size.check("largest", largest.len())?;
        let less = |a: f32, b: f32| if a < b { a } else { b };
        let more = |a: f32, b: f32| if a > b { a } else { b };
        self.pool(values, f32::INFINITY, less, least);
        self.pool(values, f32::NEG_INFINITY, more, largest);
        Ok(())
    }

    /// `pick` keeps its second argument where the first is no number.
    fn pool(
        &mut self,
        values: &[f32],
        none: f32,
        pick: impl Fn(f32, f32) -> f32 + Copy,
        out: &mut [f32],
    ) {
        let (width, reach) = (self.size.width(), self.reach);
        self.rows[0].fill(none);
        let middle = &mut self.rows[0][reach * width..][..out.len()];
        for (from, to) in values
            .chunks_exact(width)
            .zip(middle.chunks_exact_mut(width))
        {
            let row = &mut self.row[0];
            row.fill(none);
            for (to, &from) in row[reach..].iter_mut().zip(from) {
                *to = pick(from, none);
            }
            to.copy_from_slice(&widened(&mut self.row, 1, 2 * reach + 1, pick)[..width]);
        }
        let widest = widened(&mut self.rows, width, 2 * reach + 1, pick);
        out.copy_from_slice(&widest[..out.len()]);
    }
}

/// Of the first vector: of each entry the pick of `count` entries from it on, `stride` apart. What
/// begins less than `count` entries before the end is left unfinished.
fn widened(
    entries: &mut [Vec<f32>; 2],
    stride: usize,
    count: usize,
    pick: impl Fn(f32, f32) -> f32,
) -> &[f32] {
    let [a, b] = entries;
    let (mut from, mut to) = (a, b);
    let mut have = 1;
    while have < count {
        let more = have.min(count - have);
        let len = from.len().saturating_sub(more * stride);
        let pairs = from[..len].iter().zip(&from[from.len() - len..]);
        for (to, (&near, &far)) in to[..len].iter_mut().zip(pairs) {
            *to = pick(near, far);
        }
        to[len..].copy_from_slice(&from[len..]);
        std::mem::swap(&mut from, &mut to);
        have += more;
    }
    from
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn windows_are_as_looking_at_every_pixel_finds(
            width in 1usize..20,
            height in 1usize..20,
            reach in 0usize..14,
            dense in 1usize..12,
            seed in any::<u32>(),
        ) {
            let mut state = seed;
            let mut next = || {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 16) as usize
            };
            let values: Vec<f32> = (0..width * height)
                .map(|_| if next() % dense == 0 { next() as f32 - 30_000.0 } else { f32::NAN })
                .collect();
            let (mut least, mut largest) = (vec![0.0; values.len()], vec![0.0; values.len()]);
            let mut surround = Surround::new(width, height, reach).expect("a size");
            // Twice: nothing is left over from the map before.
            for _ in 0..2 {
                surround.extremes(&values, &mut least, &mut largest).expect("lengths");
            }
            for y in 0..height {
                for x in 0..width {
                    let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
                    for v in y.saturating_sub(reach)..height.min(y + reach + 1) {
                        for u in x.saturating_sub(reach)..width.min(x + reach + 1) {
                            low = low.min(values[v * width + u]);
                            high = high.max(values[v * width + u]);
                        }
                    }
                    prop_assert_eq!(least[y * width + x], low);
                    prop_assert_eq!(largest[y * width + x], high);
                }
            }
        }
    }

    #[test]
    fn wrong_lengths_are_refused() {
        let mut surround = Surround::new(2, 2, 1).expect("a size");
        assert!(
            surround
                .extremes(&[0.0; 3], &mut [0.0; 4], &mut [0.0; 4])
                .is_err()
        );
        assert!(
            surround
                .extremes(&[0.0; 4], &mut [0.0; 4], &mut [0.0; 5])
                .is_err()
        );
    }
}

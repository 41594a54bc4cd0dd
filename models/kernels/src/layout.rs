//! Where the values of a feature lie: blocks of sixteen channels, each a padded picture.
//!
//! A feature of C channels is `[C / 16 rounded up][H + 2 halo][W + 2 halo][16]`. The halo is as
//! wide as the widest window that reads the feature and holds zeros, so that no kernel has
//! borders. Lanes beyond the last channel hold finite values that meet zero weights.

use std::ops::Range;

use crate::element::Element;
use crate::simd::LANES;

/// Height and width of a feature, in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Size {
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
}

impl Size {
    /// Pixels.
    pub fn area(self) -> usize {
        self.height * self.width
    }
}

/// Slices of the caller a program may be given at once, and may fill at once.
pub(crate) const SLOTS: usize = 8;

/// What an operation works on during one pass: where the arena is, and the caller's slices.
#[derive(Clone, Copy)]
pub(crate) struct Frame {
    pub(crate) arena: *mut u8,
    /// This thread's own working memory, a part of the arena.
    pub(crate) scratch: *mut u8,
    pub(crate) inputs: [*const f32; SLOTS],
    pub(crate) outputs: [*mut f32; SLOTS],
    /// Which of several biases a convolution takes.
    pub(crate) variant: usize,
}

/// A feature placed in the arena. Offsets and strides count stored numbers, not bytes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Place {
    /// Of the first lane of pixel (0, 0), first block, from the arena's start.
    pub(crate) origin: usize,
    /// Between rows.
    pub(crate) row: usize,
    /// Between blocks.
    pub(crate) block: usize,
    pub(crate) channels: usize,
    pub(crate) size: Size,
    pub(crate) halo: usize,
}

impl Place {
    /// A feature laid out from `start`, in numbers from the arena's start.
    pub(crate) fn new(start: usize, channels: usize, size: Size, halo: usize) -> Self {
        let row = (size.width + 2 * halo) * LANES;
        Self {
            origin: start + halo * row + halo * LANES,
            row,
            block: (size.height + 2 * halo) * row,
            channels,
            size,
            halo,
        }
    }

    /// Numbers the feature takes, halo included.
    pub(crate) fn len(&self) -> usize {
        self.block * self.block_count()
    }

    pub(crate) fn block_count(&self) -> usize {
        self.channels.div_ceil(LANES)
    }

    /// From the arena's start to the first lane of a pixel.
    #[inline(always)]
    pub(crate) fn at(&self, block: usize, y: usize, x: usize) -> usize {
        self.origin + block * self.block + y * self.row + x * LANES
    }

    /// Writes the halo of `blocks` beside `rows`, and above or below where they meet the border.
    ///
    /// # Safety
    /// `arena` is that of the program this place was made for, and no other thread writes these
    /// rows of these blocks.
    pub(crate) unsafe fn clear_halo<E: Element>(
        &self,
        arena: *mut u8,
        blocks: Range<usize>,
        rows: Range<usize>,
    ) {
        let (from, to) = (rows.start, rows.end);
        if self.halo == 0 || from == to {
            return;
        }
        let side = self.halo * LANES;
        for block in blocks {
            let start = self.origin + block * self.block - side;
            let first = if from == 0 {
                start - self.halo * self.row
            } else {
                start + from * self.row
            };
            // SAFETY: all ranges lie within this place, which lies within the arena; zero is a
            // valid value of both formats.
            unsafe {
                let base = arena.cast::<E::T>();
                let zero = |at: usize, len: usize| base.add(at).write_bytes(0, len);
                zero(first, start + from * self.row - first);
                for y in from..to {
                    zero(start + y * self.row, side);
                    zero(start + (y + 1) * self.row - side, side);
                }
                if to == self.size.height {
                    zero(start + to * self.row, self.halo * self.row);
                }
            }
        }
    }
}

//! The inner loop: a strip of pixels times a few blocks of outputs, summed in registers.

use std::marker::PhantomData;

use crate::element::Product;
use crate::simd::{Kernel, LANES, Simd};

/// Most pixels times blocks one tile may have.
pub(crate) const TILE_SUMS: usize = 28;

/// One block of one input feature.
#[derive(Debug, Clone, Copy)]
pub(crate) struct InBlock {
    /// Of pixel (0, 0), from the base, in stored numbers.
    pub(crate) origin: usize,
    /// Between rows.
    pub(crate) row: usize,
    /// Multiplications that cover its channels.
    pub(crate) steps: usize,
}

/// What one tile sums up.
pub(crate) struct TileArgs<'a, T> {
    /// What the blocks' origins count from.
    pub(crate) base: *const T,
    pub(crate) blocks: &'a [InBlock],
    /// Side of the window, odd.
    pub(crate) kernel: usize,
    /// Output row and first output column.
    pub(crate) y: usize,
    pub(crate) x: usize,
    pub(crate) weights: *const T,
    pub(crate) bias: *const f32,
    /// `[block][pixel][16]`.
    pub(crate) sums: *mut f32,
}

/// A compiled tile of some shape.
pub(crate) type TileFn<T> = unsafe fn(&TileArgs<'_, T>);

struct Tile<'a, P: Product, const STRIDE: usize, const PIXELS: usize, const BLOCKS: usize> {
    args: &'a TileArgs<'a, P::T>,
    format: PhantomData<P>,
}

impl<P: Product, const STRIDE: usize, const PIXELS: usize, const BLOCKS: usize> Kernel
    for Tile<'_, P, STRIDE, PIXELS, BLOCKS>
{
    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let TileArgs {
            base,
            blocks,
            kernel,
            y,
            x,
            mut weights,
            bias,
            sums: out,
        } = *self.args;
        let reach = kernel / 2;
        // SAFETY: whoever made the arguments vouches that every window of the tile lies within
        // the padded blocks, and that weights, biases and sums are as long as the shape says.
        unsafe {
            let mut sums = [[S::splat(0.0); BLOCKS]; PIXELS];
            for pixel in &mut sums {
                for (block, sum) in pixel.iter_mut().enumerate() {
                    if P::OUTPUTS == LANES {
                        *sum = S::load(bias.add(block * LANES));
                    }
                }
            }
            for block in blocks {
                let row = block.row;
                // The halo makes the first window start at or after the block's first number.
                let corner = block.origin + y * STRIDE * row + x * STRIDE * LANES;
                let corner = base.add(corner - reach * row - reach * LANES);
                for ky in 0..kernel {
                    for kx in 0..kernel {
                        let mut input = corner.add(ky * row + kx * LANES);
                        for _ in 0..block.steps {
                            let w: [P::W<S>; BLOCKS] = std::array::from_fn(|block| {
                                P::weights::<S>(weights.add(block * P::OUTPUTS * P::STEP))
                            });
                            // Pixel by pixel with its place known, so that every address is the
                            // input's plus a constant.
                            macro_rules! pixels {
                                ($($pixel:literal)*) => {
                                    $(if $pixel < PIXELS {
                                        let x = P::spread::<S, $pixel, STRIDE>(input);
                                        for (sum, w) in sums[$pixel].iter_mut().zip(&w) {
                                            *sum = P::mul_add::<S>(x, *w, *sum);
                                        }
                                    })*
                                };
                            }
                            pixels!(0 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15);
                            weights = weights.add(BLOCKS * P::OUTPUTS * P::STEP);
                            input = input.add(P::STEP);
                        }
                    }
                }
            }
            for (pixel, sums) in sums.iter().enumerate() {
                for (block, sum) in sums.iter().enumerate() {
                    let mut sum = P::close::<S>(*sum);
                    if P::OUTPUTS != LANES {
                        sum = S::add(sum, S::load(bias.add(block * LANES)));
                    }
                    S::store(out.add((block * PIXELS + pixel) * LANES), sum);
                }
            }
        }
    }
}

/// # Safety
/// The processor has the instructions of `S`, and `args` is as the kernel above wants it.
unsafe fn tile<
    S: Simd,
    P: Product,
    const STRIDE: usize,
    const PIXELS: usize,
    const BLOCKS: usize,
>(
    args: &TileArgs<'_, P::T>,
) {
    let kernel = Tile::<P, STRIDE, PIXELS, BLOCKS> {
        args,
        format: PhantomData,
    };
    // SAFETY: passed on from the caller.
    unsafe { S::vectorize(kernel) }
}

/// The compiled tile for `pixels` by `blocks`; shapes beyond the registers have none.
fn select<S: Simd, P: Product, const STRIDE: usize>(
    pixels: usize,
    blocks: usize,
) -> Option<TileFn<P::T>> {
    macro_rules! shapes {
        ($($blocks:literal: $($pixels:literal)*;)*) => {
            match (pixels, blocks) {
                $($(($pixels, $blocks) => {
                    if $pixels * $blocks <= S::SUMS {
                        Some(tile::<S, P, STRIDE, $pixels, $blocks>)
                    } else {
                        None
                    }
                })*)*
                _ => None,
            }
        };
    }
    shapes! {
        1: 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16;
        2: 1 2 3 4 5 6 7 8 9 10 11 12 13 14;
        3: 1 2 3 4 5 6 7 8 9;
    }
}

/// As [`select`], by stride (1 or 2).
pub(crate) fn tile_fn<S: Simd, P: Product>(
    stride: usize,
    pixels: usize,
    blocks: usize,
) -> Option<TileFn<P::T>> {
    match stride {
        1 => select::<S, P, 1>(pixels, blocks),
        2 => select::<S, P, 2>(pixels, blocks),
        _ => None,
    }
}

/// Most pixels a tile of `blocks` can have on `S`.
fn pixels_max<S: Simd>(blocks: usize) -> usize {
    (S::SUMS / blocks).min(match blocks {
        1 => 16,
        2 => 14,
        _ => 9,
    })
}

/// Pixels per tile that cover a row of `width` with the least work; the last tile of a row
/// overlaps the one before it where the width is no multiple.
pub(crate) fn tile_pixels<S: Simd>(width: usize, blocks: usize) -> usize {
    // A tile's own overhead is worth about a pixel.
    let cost = |pixels: &usize| width.div_ceil(*pixels) * (pixels + 1);
    (1..=pixels_max::<S>(blocks).min(width))
        .rev()
        .min_by_key(cost)
        .unwrap_or(1)
}

/// Cuts `blocks` outputs into groups of at most `widest` that one tile handles, equal where
/// possible: pairs, and one triple where the count is odd.
pub(crate) fn group_sizes<S: Simd>(blocks: usize, widest: usize) -> Vec<usize> {
    if S::SUMS < TILE_SUMS {
        return vec![1; blocks];
    }
    match (blocks, blocks % 2, widest) {
        (0, ..) => Vec::new(),
        (1, ..) => vec![1],
        (_, 0, _) => vec![2; blocks / 2],
        (_, _, 3..) => [vec![2; blocks / 2 - 1], vec![3]].concat(),
        _ => [vec![2; blocks / 2], vec![1]].concat(),
    }
}

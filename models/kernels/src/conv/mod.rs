//! Direct convolution over blocked features, with everything that follows it in the same pass.

mod filter;
mod finish;
mod tile;

use std::mem::MaybeUninit;
use std::ops::Range;

pub use finish::Store;

pub(crate) use filter::{Dense, Filter, Group, consecutive, shuffled};
pub(crate) use finish::{Finish, Gain, LINE, Spot};
pub(crate) use tile::{InBlock, TILE_SUMS, TileArgs, TileFn, group_sizes, tile_fn, tile_pixels};

use crate::element::{Element, Product};
use crate::layout::{Frame, Place, Size};
use crate::simd::{Kernel, LANES, Simd};

/// Weights up to this size stay in a second-level cache of 1 MiB while rows pass by.
const CACHED_WEIGHT_BYTES: usize = 512 << 10;

/// A group of output blocks with its compiled tile.
pub(crate) struct Stripe<E: Element> {
    pub(crate) group: Group,
    pub(crate) pixels: usize,
    pub(crate) tile: TileFn<E::T>,
}

/// A convolution ready to run.
pub(crate) struct ConvOp<E: Element> {
    inputs: Vec<InBlock>,
    kernel: usize,
    filter: Filter,
    stripes: Vec<Stripe<E>>,
    finish: Finish,
    /// Before the store enlarges it.
    size: Size,
    stride: usize,
    /// Whether threads share the rows; else each takes groups of outputs over all rows.
    rows_outside: bool,
}

/// The blocks of `features` for a tile's loop.
pub(crate) fn in_blocks<P: Product>(features: &[Place]) -> Vec<InBlock> {
    let mut blocks = Vec::new();
    for place in features {
        for block in 0..place.block_count() {
            let channels = (place.channels - block * LANES).min(LANES);
            blocks.push(InBlock {
                origin: place.at(block, 0, 0),
                row: place.row,
                steps: channels.div_ceil(P::STEP),
            });
        }
    }
    blocks
}

impl<E: Element> ConvOp<E> {
    /// The inputs' halos reach `kernel / 2`; the weights fit the inputs and the finish.
    pub(crate) fn new<S: Simd>(
        inputs: &[Place],
        dense: Dense<'_>,
        bias: &[f32],
        stride: usize,
        finish: Finish,
    ) -> Self {
        // Half of the lanes would idle.
        let is_narrow = finish.out.channels <= E::Narrow::OUTPUTS;
        if is_narrow && finish.store != Store::Shuffle {
            return Self::with::<S, E::Narrow>(inputs, dense, bias, stride, finish);
        }
        Self::with::<S, E>(inputs, dense, bias, stride, finish)
    }

    fn with<S: Simd, P: Product<T = E::T>>(
        inputs: &[Place],
        dense: Dense<'_>,
        bias: &[f32],
        stride: usize,
        finish: Finish,
    ) -> Self {
        let channels = finish.out.channels;
        let outputs = match finish.store {
            Store::Shuffle => shuffled(channels),
            Store::Direct | Store::Nearest => consecutive([channels]),
        };
        let lanes = consecutive(inputs.iter().map(|place| place.channels));
        let sizes = group_sizes::<S>(outputs.len(), 3);
        let filter = Filter::pack::<E, P>(dense, bias, &lanes, &outputs, &sizes);
        let scale = finish.store.scale();
        let size = Size {
            height: finish.out.size.height / scale,
            width: finish.out.size.width / scale,
        };
        let stripes = filter.groups.iter().map(|group| {
            let pixels = tile_pixels::<S>(size.width, group.count);
            Stripe {
                group: *group,
                pixels,
                tile: tile_fn::<S, P>(stride, pixels, group.count)
                    .expect("groups and tiles are chosen among the compiled shapes"),
            }
        });
        Self {
            inputs: in_blocks::<P>(inputs),
            kernel: dense.kernel,
            stride,
            stripes: stripes.collect(),
            rows_outside: filter.weight_bytes() <= CACHED_WEIGHT_BYTES,
            filter,
            finish,
            size,
        }
    }

    /// What threads may share: rows, or groups of outputs where the weights do not stay in a
    /// cache while rows pass by and one thread should meet each of them alone.
    pub(crate) fn units(&self) -> usize {
        if self.rows_outside {
            self.size.height
        } else {
            self.stripes.len()
        }
    }

    pub(crate) fn weight_bytes(&self) -> usize {
        self.filter.weight_bytes()
    }

    /// # Safety
    /// The processor has the instructions of `S`; `frame` is that of the program this was built
    /// for; no other thread works on the same units.
    pub(crate) unsafe fn run<S: Simd>(&self, frame: &Frame, units: Range<usize>) {
        let kernel = ConvUnits {
            op: self,
            frame,
            units,
        };
        // SAFETY: passed on from the caller.
        unsafe { S::vectorize(kernel) }
    }
}

/// Room for one tile's sums.
#[repr(align(64))]
pub(crate) struct Sums(MaybeUninit<[f32; TILE_SUMS * LANES]>);

impl Sums {
    pub(crate) fn room() -> Self {
        Self(MaybeUninit::uninit())
    }

    pub(crate) fn as_mut_ptr(&mut self) -> *mut f32 {
        self.0.as_mut_ptr().cast()
    }
}

struct ConvUnits<'a, E: Element> {
    op: &'a ConvOp<E>,
    frame: &'a Frame,
    units: Range<usize>,
}

impl<E: Element> Kernel for ConvUnits<'_, E> {
    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let Self { op, frame, units } = self;
        let scale = op.finish.store.scale();
        let out = &op.finish.out;
        // SAFETY: the caller of `ConvOp::run` vouches for the frame and the units; the halo of a
        // block belongs to its rows, or to the one group that stores its first phase.
        unsafe {
            if op.rows_outside {
                for y in units.clone() {
                    for stripe in &op.stripes {
                        op.row::<S>(frame, stripe, y);
                    }
                }
                let rows = units.start * scale..units.end * scale;
                out.clear_halo::<E>(frame.arena, 0..out.block_count(), rows);
                return;
            }
            for stripe in &op.stripes[units] {
                for y in 0..op.size.height {
                    op.row::<S>(frame, stripe, y);
                }
                let Group { first, count, .. } = stripe.group;
                for block in first..first + count {
                    let (phase, block) = op.finish.target(block);
                    if phase == 0 {
                        let rows = 0..out.size.height;
                        out.clear_halo::<E>(frame.arena, block..block + 1, rows);
                    }
                }
            }
        }
    }
}

impl<E: Element> ConvOp<E> {
    /// # Safety
    /// As for `run`; `y` is one of the rows.
    #[inline(always)]
    unsafe fn row<S: Simd>(&self, frame: &Frame, stripe: &Stripe<E>, y: usize) {
        let mut sums = Sums::room();
        let Stripe {
            group,
            pixels,
            tile,
        } = stripe;
        let last = self.size.width - pixels;
        for x in (0..self.size.width).step_by(*pixels) {
            let x = x.min(last);
            let args = TileArgs {
                base: frame.arena.cast::<E::T>().cast_const(),
                blocks: &self.inputs,
                kernel: self.kernel,
                y,
                x,
                weights: self.filter.weights::<E>(group),
                bias: self.filter.bias(group, frame.variant),
                sums: sums.as_mut_ptr(),
            };
            let spot = Spot {
                first_block: group.first,
                blocks: group.count,
                pixels: *pixels,
                y,
                x,
            };
            if group.first == 0 {
                self.expect_rows::<S>(&args, *pixels);
            }
            // SAFETY: the tile lies within the row, the halo covers its windows, and it fills
            // the sums that the finish then reads.
            unsafe {
                self.finish.expect::<S, E>(frame, spot);
                tile(&args);
                self.finish.run::<S, E>(frame, spot, sums.as_mut_ptr());
            }
        }
    }

    /// Asks for the inputs that the tile below the one of `args` will read first.
    #[inline(always)]
    fn expect_rows<S: Simd>(&self, args: &TileArgs<'_, E::T>, pixels: usize) {
        let line = LINE / size_of::<E::T>();
        let below = args.y * self.stride + self.kernel / 2 + 1;
        for block in args.blocks {
            for row in below..below + self.stride {
                let first = block.origin + row * block.row + args.x * self.stride * LANES;
                for at in (0..pixels * self.stride * LANES).step_by(line) {
                    // SAFETY: an expectation may name any address.
                    unsafe { S::expect_read(args.base.wrapping_add(first + at).cast()) };
                }
            }
        }
    }
}

//! Guided adaptive receptive fields as one loop: coefficients, kernels, windows, mixture, gate.
//!
//! Strip by strip, everything between the hidden feature and the gated result stays in the
//! first-level cache: no plane of coefficients, kernels or filtered channels is ever written out.

use std::ops::Range;

use crate::activation::tanh;
use crate::conv::{
    Dense, Filter, Finish, InBlock, Spot, Stripe, TILE_SUMS, TileArgs, consecutive, group_sizes,
    in_blocks, tile_fn, tile_pixels,
};
use crate::element::Element;
use crate::layout::{Frame, Place};
use crate::memory::Memory;
use crate::simd::{Kernel, LANES, Simd};

/// Pixels a window kernel is applied to at once.
const STRIP: usize = 4;

/// The taps some atom uses, and the atoms there.
pub(crate) struct Taps {
    /// Row and column offsets from the pixel.
    pub(crate) offsets: Vec<(isize, isize)>,
    /// `[K][J]`: what each atom holds at each tap.
    pub(crate) atoms: Vec<f32>,
    pub(crate) atom_count: usize,
}

impl Taps {
    /// From all atoms `[K, side, side]`; taps at which every atom is zero are dropped.
    pub(crate) fn new(atoms: &[f32], side: usize) -> Self {
        let area = side * side;
        let live: Vec<usize> = (0..area)
            .filter(|tap| atoms.iter().skip(*tap).step_by(area).any(|a| *a != 0.0))
            .collect();
        let reach = (side / 2).cast_signed();
        let offset = |tap: &usize| {
            let (row, column) = ((tap / side).cast_signed(), (tap % side).cast_signed());
            (row - reach, column - reach)
        };
        Self {
            offsets: live.iter().map(offset).collect(),
            atoms: atoms
                .chunks(area)
                .flat_map(|atom| live.iter().map(|&tap| atom[tap]))
                .collect(),
            atom_count: atoms.len() / area,
        }
    }
}

/// The two 1x1 convolutions around the filtering, and the number of filters.
pub(crate) struct GarfWeights<'a> {
    /// `[M * K, d]` and `[M * K]`.
    pub(crate) coefficients: (&'a [f32], &'a [f32]),
    /// `[d, d * M]` and `[d]`; input channel c * M + m.
    pub(crate) mix: (&'a [f32], &'a [f32]),
    pub(crate) filters: usize,
}

/// GARF ready to run.
pub(crate) struct GarfOp<E: Element> {
    hidden: Vec<InBlock>,
    coefficients: (Filter, Vec<Stripe<E>>),
    /// The filtered channels of a strip, as input blocks of the mixture.
    filtered: Vec<InBlock>,
    mix: (Filter, Vec<Stripe<E>>),
    finish: Finish,
    x: Place,
    /// From a pixel of `x` to each tap, in stored numbers.
    taps: Vec<isize>,
    /// `[K][tap block][16]`.
    atoms: Memory,
    atom_count: usize,
    filters: usize,
    pixels: usize,
    /// Single-precision numbers of coefficients and kernels in the working memory.
    rooms: (usize, usize),
}

impl<E: Element> GarfOp<E> {
    /// `x` and `hidden` have the size of the finish's target; the halo of `x` covers the taps.
    pub(crate) fn new<S: Simd>(
        x: Place,
        hidden: Place,
        taps: &Taps,
        weights: &GarfWeights<'_>,
        finish: Finish,
    ) -> Self {
        let filters = weights.filters;
        let dense = |weight, inputs| Dense {
            weight,
            inputs,
            kernel: 1,
        };
        let outputs = consecutive([filters * taps.atom_count]);
        let pixels = tile_pixels::<S>(x.size.width, if S::SUMS < TILE_SUMS { 1 } else { 2 });
        let coefficients = stripes::<S, E>(
            Filter::pack::<E, E>(
                dense(weights.coefficients.0, hidden.channels),
                weights.coefficients.1,
                &consecutive([hidden.channels]),
                &outputs,
                &group_sizes::<S>(outputs.len(), 2),
            ),
            pixels,
        );
        // Block (b, m) of the filtered channels holds filter m of the channels of block b.
        let mut lanes = Vec::new();
        for block in consecutive([x.channels]) {
            for m in 0..filters {
                lanes.push(block.iter().map(|c| c * filters + m).collect());
            }
        }
        let mixed = consecutive([finish.out.channels]);
        let mix = stripes::<S, E>(
            Filter::pack::<E, E>(
                dense(weights.mix.0, x.channels * filters),
                weights.mix.1,
                &lanes,
                &mixed,
                &group_sizes::<S>(mixed.len(), 2),
            ),
            pixels,
        );
        let filtered = lanes.iter().enumerate().map(|(index, lanes)| InBlock {
            origin: index * pixels * LANES,
            row: 0,
            steps: lanes.len().div_ceil(E::STEP),
        });
        let tap_blocks = taps.offsets.len().div_ceil(LANES);
        let mut atoms = Vec::new();
        for atom in taps.atoms.chunks(taps.offsets.len().max(1)) {
            let padding = tap_blocks * LANES - atom.len();
            atoms.extend(
                atom.iter()
                    .copied()
                    .chain(std::iter::repeat_n(0.0, padding)),
            );
        }
        let row = x.row.cast_signed();
        let lane_count = LANES.cast_signed();
        Self {
            hidden: in_blocks::<E>(&[hidden]),
            coefficients,
            filtered: filtered.collect(),
            mix,
            finish,
            x,
            taps: taps
                .offsets
                .iter()
                .map(|(dy, dx)| dy * row + dx * lane_count)
                .collect(),
            atoms: Memory::from_values(&atoms),
            atom_count: taps.atom_count,
            filters,
            pixels,
            rooms: (
                outputs.len() * pixels * LANES,
                pixels * filters * tap_blocks * LANES,
            ),
        }
    }

    pub(crate) fn rows(&self) -> usize {
        self.x.size.height
    }

    pub(crate) fn weight_bytes(&self) -> usize {
        self.coefficients.0.weight_bytes() + self.mix.0.weight_bytes() + self.atoms.len()
    }

    /// Working memory per thread, in bytes.
    pub(crate) fn scratch_bytes(&self) -> usize {
        let filtered = self.filtered.len() * self.pixels * LANES * size_of::<E::T>();
        (self.rooms.0 + self.rooms.1) * size_of::<f32>() + filtered
    }

    /// # Safety
    /// As for a convolution; `frame.scratch` has the room asked for.
    pub(crate) unsafe fn run<S: Simd>(&self, frame: &Frame, rows: Range<usize>) {
        let kernel = GarfRows {
            op: self,
            frame,
            rows,
        };
        // SAFETY: passed on from the caller.
        unsafe { S::vectorize(kernel) }
    }
}

fn stripes<S: Simd, E: Element>(filter: Filter, pixels: usize) -> (Filter, Vec<Stripe<E>>) {
    let stripe = |group: &crate::conv::Group| Stripe {
        group: *group,
        pixels,
        tile: tile_fn::<S, E>(1, pixels, group.count)
            .expect("pairs of blocks fit the registers at the pixels chosen for pairs"),
    };
    let stripes = filter.groups.iter().map(stripe).collect();
    (filter, stripes)
}

/// The working memory of one strip.
struct Room<E: Element> {
    /// `[coefficient block][pixel][16]`.
    coefficients: *mut f32,
    /// `[pixel][M][tap block][16]`.
    kernels: *mut f32,
    /// `[block of x][M][pixel][16]`.
    filtered: *mut E::T,
}

struct GarfRows<'a, E: Element> {
    op: &'a GarfOp<E>,
    frame: &'a Frame,
    rows: Range<usize>,
}

impl<E: Element> Kernel for GarfRows<'_, E> {
    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let Self { op, frame, rows } = self;
        let coefficients = frame.scratch.cast::<f32>();
        // SAFETY: the scratch has the room asked for; every strip lies within its row; the
        // halo of x covers the taps.
        unsafe {
            let kernels = coefficients.add(op.rooms.0);
            let room = Room::<E> {
                coefficients,
                kernels,
                filtered: kernels.add(op.rooms.1).cast(),
            };
            let width = op.x.size.width;
            for y in rows.clone() {
                for x in (0..width).step_by(op.pixels) {
                    let x = x.min(width - op.pixels);
                    op.coefficients::<S>(frame, &room, y, x);
                    op.kernels::<S>(&room);
                    op.filter::<S>(frame, &room, y, x);
                    op.mix::<S>(frame, &room, y, x);
                }
            }
            let out = &op.finish.out;
            out.clear_halo::<E>(frame.arena, 0..out.block_count(), rows);
        }
    }
}

/// # Safety of the steps
/// As for `run`, with the room of the calling thread and a strip within the picture.
impl<E: Element> GarfOp<E> {
    /// `tanh(coef2(hidden))`.
    #[inline(always)]
    unsafe fn coefficients<S: Simd>(&self, frame: &Frame, room: &Room<E>, y: usize, x: usize) {
        let (filter, stripes) = &self.coefficients;
        // SAFETY: see the head of the block.
        unsafe {
            for Stripe { group, tile, .. } in stripes {
                tile(&TileArgs {
                    base: frame.arena.cast::<E::T>().cast_const(),
                    blocks: &self.hidden,
                    kernel: 1,
                    y,
                    x,
                    weights: filter.weights::<E>(group),
                    bias: filter.bias(group, 0),
                    sums: room.coefficients.add(group.first * self.pixels * LANES),
                });
            }
            for at in (0..self.rooms.0).step_by(LANES) {
                let at = room.coefficients.add(at);
                S::store(at, tanh::<S>(S::load(at)));
            }
        }
    }

    /// Combines the atoms into M kernels per pixel.
    #[inline(always)]
    unsafe fn kernels<S: Simd>(&self, room: &Room<E>) {
        let tap_blocks = self.taps.len().div_ceil(LANES);
        let atoms = self.atoms.as_ptr().cast::<f32>();
        let kernel_len = tap_blocks * LANES;
        for m in 0..self.filters {
            for block in 0..tap_blocks {
                let mut first = 0;
                while first < self.pixels {
                    // SAFETY: see the head of the block; a strip of one covers what is left.
                    first += unsafe {
                        let atoms = atoms.add(block * LANES);
                        let out = room.kernels.add(m * kernel_len + block * LANES);
                        if first + STRIP <= self.pixels {
                            self.combine::<S, STRIP>(room, m, first, atoms, out, kernel_len)
                        } else {
                            self.combine::<S, 1>(room, m, first, atoms, out, kernel_len)
                        }
                    };
                }
            }
        }
    }

    /// One block of taps of kernel `m` for `N` pixels; returns `N`.
    #[inline(always)]
    unsafe fn combine<S: Simd, const N: usize>(
        &self,
        room: &Room<E>,
        m: usize,
        first: usize,
        atoms: *const f32,
        out: *mut f32,
        kernel_len: usize,
    ) -> usize {
        // SAFETY: see the head of the block.
        unsafe {
            let mut sums = [S::splat(0.0); N];
            for k in 0..self.atom_count {
                let atom = S::load(atoms.add(k * kernel_len));
                let index = m * self.atom_count + k;
                let at = (index / LANES * self.pixels + first) * LANES + index % LANES;
                let coefficient = room.coefficients.add(at);
                for (pixel, sum) in sums.iter_mut().enumerate() {
                    let a = S::splat(*coefficient.add(pixel * LANES));
                    *sum = S::mul_add(a, atom, *sum);
                }
            }
            for (pixel, sum) in sums.iter().enumerate() {
                let kernel = (first + pixel) * self.filters * kernel_len;
                S::store(out.add(kernel), *sum);
            }
        }
        N
    }

    /// Applies every pixel's kernels to its window, channel block by channel block.
    #[inline(always)]
    unsafe fn filter<S: Simd>(&self, frame: &Frame, room: &Room<E>, y: usize, x: usize) {
        for block in 0..self.x.block_count() {
            let mut m = 0;
            while m < self.filters {
                macro_rules! widths {
                    ($($count:literal)*) => {
                        match self.filters - m {
                            $($count => {
                                // SAFETY: see the head of the block.
                                unsafe {
                                    self.windows::<S, $count>(frame, room, block, m, y, x);
                                }
                                m += $count;
                            })*
                            // SAFETY: see the head of the block.
                            _ => unsafe {
                                self.windows::<S, 3>(frame, room, block, m, y, x);
                                m += 3;
                            },
                        }
                    };
                }
                widths!(1 2 3 4 6);
            }
        }
    }

    /// Filters `m..m + M` of one block over the strip.
    #[inline(always)]
    unsafe fn windows<S: Simd, const M: usize>(
        &self,
        frame: &Frame,
        room: &Room<E>,
        block: usize,
        m: usize,
        y: usize,
        x: usize,
    ) {
        let mut first = 0;
        while first < self.pixels {
            // SAFETY: see the head of the block; a strip of one covers what is left.
            unsafe {
                let input = frame.arena.cast::<E::T>().cast_const();
                let input = input.add(self.x.at(block, y, x + first));
                if first + STRIP <= self.pixels {
                    self.apply::<S, M, STRIP>(room, input, block, m, first);
                    first += STRIP;
                } else {
                    self.apply::<S, M, 1>(room, input, block, m, first);
                    first += 1;
                }
            }
        }
    }

    /// `N` pixels from `first` by `M` filters from `m`; `input` is the first pixel's block.
    #[inline(always)]
    unsafe fn apply<S: Simd, const M: usize, const N: usize>(
        &self,
        room: &Room<E>,
        input: *const E::T,
        block: usize,
        m: usize,
        first: usize,
    ) {
        let kernel_len = self.taps.len().div_ceil(LANES) * LANES;
        // SAFETY: see the head of the block.
        unsafe {
            let kernels = room.kernels.add((first * self.filters + m) * kernel_len);
            let mut sums = [[S::splat(0.0); M]; N];
            for (tap, offset) in self.taps.iter().enumerate() {
                for (pixel, sums) in sums.iter_mut().enumerate() {
                    let x = E::load::<S>(input.offset(*offset).add(pixel * LANES));
                    let kernel = kernels.add(pixel * self.filters * kernel_len + tap);
                    for (index, sum) in sums.iter_mut().enumerate() {
                        let weight = S::splat(*kernel.add(index * kernel_len));
                        *sum = S::mul_add(x, weight, *sum);
                    }
                }
            }
            for (pixel, sums) in sums.iter().enumerate() {
                for (index, sum) in sums.iter().enumerate() {
                    let at = (block * self.filters + m + index) * self.pixels + first + pixel;
                    E::store::<S>(room.filtered.add(at * LANES), *sum);
                }
            }
        }
    }

    /// The mixture, and the gate with what is trusted of x.
    #[inline(always)]
    unsafe fn mix<S: Simd>(&self, frame: &Frame, room: &Room<E>, y: usize, x: usize) {
        let (filter, stripes) = &self.mix;
        let mut sums = crate::conv::Sums::room();
        for Stripe { group, tile, .. } in stripes {
            let spot = Spot {
                first_block: group.first,
                blocks: group.count,
                pixels: self.pixels,
                y,
                x,
            };
            // SAFETY: see the head of the block; the tile reads the strip's own blocks.
            unsafe {
                tile(&TileArgs {
                    base: room.filtered.cast_const(),
                    blocks: &self.filtered,
                    kernel: 1,
                    y: 0,
                    x: 0,
                    weights: filter.weights::<E>(group),
                    bias: filter.bias(group, 0),
                    sums: sums.as_mut_ptr(),
                });
                self.finish.run::<S, E>(frame, spot, sums.as_mut_ptr());
            }
        }
    }
}

//! The two inner loops of a convolution and of its gradients, over shifted vectors in scratch
//! memory: weighted sums of vectors, and products of vectors with vectors.

use crate::simd::{LANES, Simd};

/// Outputs summed at once.
pub(super) const GROUP: usize = 4;
/// Vectors of an output held in registers at most.
const WIDE: usize = 6;
/// Taps multiplied at once, on many registers and on few.
const TAPS: usize = 6;
const TAPS_FEW: usize = 2;

/// Whether `S` has thirty-two registers of sixteen values.
const fn has_many<S: Simd>() -> bool {
    S::SUMS >= GROUP * WIDE
}

/// Puts weights `[output][tap]` in the order [`weighted_sums`] reads them: groups of outputs,
/// then taps, then the group's outputs.
pub(super) fn pack(weights: &[f32], outputs: usize) -> Vec<f32> {
    let taps = weights.len() / outputs;
    let mut packed = Vec::with_capacity(weights.len());
    for first in (0..outputs).step_by(GROUP) {
        for tap in 0..taps {
            let group = first..(first + GROUP).min(outputs);
            packed.extend(group.map(|output| weights[output * taps + tap]));
        }
    }
    packed
}

/// `sums[output][n] = sum over taps of weights * source[offset of tap + n]` for `n` in `0..len`.
pub(super) struct WeightedSums<'a> {
    pub(super) source: &'a [f32],
    pub(super) offsets: &'a [usize],
    /// From [`pack`].
    pub(super) weights: &'a [f32],
    pub(super) outputs: usize,
    pub(super) len: usize,
}

/// Distance of the outputs of [`WeightedSums`] for a length.
pub(super) fn sums_row(len: usize) -> usize {
    len.next_multiple_of(LANES)
}

impl WeightedSums<'_> {
    /// Writes `[outputs][sums_row(len)]` to `sums`; what lies beyond `len` means nothing.
    ///
    /// # Safety
    /// The processor has the instructions of `S`.
    #[inline(always)]
    pub(super) unsafe fn run<S: Simd>(&self, sums: &mut [f32]) {
        let (vectors, row) = (self.len.div_ceil(LANES), sums_row(self.len));
        let reach = self.offsets.iter().max().map_or(0, |most| most + row);
        assert!(
            reach <= self.source.len()
                && self.outputs * row <= sums.len()
                && self.outputs * self.offsets.len() == self.weights.len()
        );
        if vectors == 0 {
            return;
        }
        let widest = if has_many::<S>() { WIDE } else { 1 };
        let wide = vectors.div_ceil(vectors.div_ceil(widest));
        for first in (0..self.outputs).step_by(GROUP) {
            let group = GROUP.min(self.outputs - first);
            let weights = self.weights[first * self.offsets.len()..].as_ptr();
            for tile in (0..vectors).step_by(wide) {
                // The last tile overlaps the one before it.
                let at = tile.min(vectors - wide) * LANES;
                // SAFETY: `at + wide * LANES` is at most `row`; the assertion above bounds what is
                // read at every offset and what is written for every output of the group.
                unsafe {
                    let sums = sums.as_mut_ptr().add(first * row + at);
                    self.tile::<S>((wide, group), at, weights, sums, row);
                }
            }
        }
    }

    /// # Safety
    /// As [`Self::run`], and the tile lies inside.
    #[inline(always)]
    unsafe fn tile<S: Simd>(
        &self,
        shape: (usize, usize),
        at: usize,
        weights: *const f32,
        sums: *mut f32,
        row: usize,
    ) {
        macro_rules! shapes {
            ($($wide:literal)*; $groups:tt) => { match shape {
                $((wide, group) if wide == $wide => shapes!(@ group, $wide, $groups),)*
                _ => unreachable!("no tile of {shape:?}"),
            } };
            (@ $group:ident, $wide:literal, ($($of:literal)*)) => { match $group {
                $($of => if $wide == 1 || has_many::<S>() {
                    // SAFETY: passed on from the caller.
                    unsafe { self.tile_of::<S, $wide, $of>(at, weights, sums, row) }
                },)*
                _ => unreachable!("no tile of {shape:?}"),
            } };
        }
        shapes!(1 2 3 4 5 6; (1 2 3 4));
    }

    /// # Safety
    /// As [`Self::tile`].
    #[inline(always)]
    unsafe fn tile_of<S: Simd, const W: usize, const G: usize>(
        &self,
        at: usize,
        mut weights: *const f32,
        out: *mut f32,
        row: usize,
    ) {
        // SAFETY: the caller vouches for the vectors at every offset; weights hold G per tap.
        unsafe {
            let source = self.source.as_ptr().add(at);
            let mut sums = [[S::splat(0.0); W]; G];
            for offset in self.offsets {
                let from = source.add(*offset);
                let x: [S::V; W] = std::array::from_fn(|i| S::load(from.add(i * LANES)));
                for (g, sums) in sums.iter_mut().enumerate() {
                    let w = S::splat(*weights.add(g));
                    for (sum, x) in sums.iter_mut().zip(&x) {
                        *sum = S::mul_add(*x, w, *sum);
                    }
                }
                weights = weights.add(G);
            }
            for (g, sums) in sums.iter().enumerate() {
                for (i, sum) in sums.iter().enumerate() {
                    S::store(out.add(g * row + i * LANES), *sum);
                }
            }
        }
    }
}

/// `products[output][tap] = sum over n in 0..len of grad[output][n] * source[offset of tap + n]`.
pub(super) struct Products<'a> {
    pub(super) source: &'a [f32],
    pub(super) offsets: &'a [usize],
    /// One stretch per output, at a distance of `grad_row`.
    pub(super) grad: &'a [f32],
    pub(super) grad_row: usize,
    pub(super) outputs: usize,
    pub(super) len: usize,
}

impl Products<'_> {
    /// Writes `[outputs][taps]` to `products`.
    ///
    /// # Safety
    /// The processor has the instructions of `S`.
    #[inline(always)]
    pub(super) unsafe fn run<S: Simd>(&self, products: &mut [f32]) {
        let reach = self
            .offsets
            .iter()
            .max()
            .map_or(0, |most| most + sums_row(self.len));
        assert!(
            reach <= self.source.len()
                && (self.outputs - 1) * self.grad_row + self.len <= self.grad.len()
                && self.outputs * self.offsets.len() == products.len()
        );
        let (taps, group) = if has_many::<S>() {
            (TAPS, GROUP)
        } else {
            (TAPS_FEW, 2)
        };
        for tap in (0..self.offsets.len()).step_by(taps) {
            for first in (0..self.outputs).step_by(group) {
                // SAFETY: passed on from the caller; the assertion above bounds all reads.
                unsafe {
                    match (has_many::<S>(), group.min(self.outputs - first)) {
                        (true, 1) => self.tile::<S, 1, TAPS>(first, tap, products),
                        (true, 2) => self.tile::<S, 2, TAPS>(first, tap, products),
                        (true, 3) => self.tile::<S, 3, TAPS>(first, tap, products),
                        (true, _) => self.tile::<S, 4, TAPS>(first, tap, products),
                        (false, 1) => self.tile::<S, 1, TAPS_FEW>(first, tap, products),
                        (false, _) => self.tile::<S, 2, TAPS_FEW>(first, tap, products),
                    }
                }
            }
        }
    }

    /// # Safety
    /// As [`Self::run`].
    #[inline(always)]
    unsafe fn tile<S: Simd, const G: usize, const T: usize>(
        &self,
        first: usize,
        tap: usize,
        products: &mut [f32],
    ) {
        let taps = self.offsets.len();
        // Taps beyond the last repeat it and are dropped at the end.
        let offsets: [usize; T] = std::array::from_fn(|t| self.offsets[(tap + t).min(taps - 1)]);
        let (whole, rest) = (self.len / LANES * LANES, self.len % LANES);
        // SAFETY: every gradient holds `len` values and every offset `sums_row(len)` behind it.
        unsafe {
            let grad: [*const f32; G] =
                std::array::from_fn(|g| self.grad.as_ptr().add((first + g) * self.grad_row));
            let source: [*const f32; T] =
                std::array::from_fn(|t| self.source.as_ptr().add(offsets[t]));
            let mut sums = [[S::splat(0.0); T]; G];
            for n in (0..whole).step_by(LANES) {
                let grad: [S::V; G] = std::array::from_fn(|g| S::load(grad[g].add(n)));
                accumulate::<S, G, T>(&mut sums, &grad, &source, n);
            }
            if rest > 0 {
                let mut tails = [[0f32; LANES]; G];
                for (tail, grad) in tails.iter_mut().zip(grad) {
                    let from = std::slice::from_raw_parts(grad.add(whole), rest);
                    tail[..rest].copy_from_slice(from);
                }
                let grad: [S::V; G] = std::array::from_fn(|g| S::load(tails[g].as_ptr()));
                accumulate::<S, G, T>(&mut sums, &grad, &source, whole);
            }
            for (g, sums) in sums.iter().enumerate() {
                let products = &mut products[(first + g) * taps + tap..][..T.min(taps - tap)];
                for (product, sum) in products.iter_mut().zip(sums) {
                    *product = S::sum(*sum);
                }
            }
        }
    }
}

/// # Safety
/// As [`Simd`]: sixteen values lie behind each source from `n` on.
#[inline(always)]
unsafe fn accumulate<S: Simd, const G: usize, const T: usize>(
    sums: &mut [[S::V; T]; G],
    grad: &[S::V; G],
    source: &[*const f32; T],
    n: usize,
) {
    for (t, source) in source.iter().enumerate() {
        // SAFETY: passed on from the caller.
        unsafe {
            let x = S::load(source.add(n));
            for (sums, grad) in sums.iter_mut().zip(grad) {
                sums[t] = S::mul_add(*grad, x, sums[t]);
            }
        }
    }
}

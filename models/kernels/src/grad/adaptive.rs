//! Filtering every pixel with kernels of its own, combined from fixed atoms, and its gradients.
//!
//! Kernels are built for a stretch of rows at a time and never leave scratch memory. Rows lie at
//! one distance between zeros, as for convolutions: a tap is an offset.

use super::sums::{WeightedSums, pack, sums_row};
use super::work::{Fresh, each, run, with_scratch};
use crate::isa::Isa;
use crate::simd::{Kernel, LANES, Simd};

/// Values that all of one stretch should hold, about half of a 1 MiB cache.
const STRETCH_LEN: usize = 128 * 1024;

/// Operands of adaptive filtering on plain planes.
#[derive(Debug, Clone, Copy)]
pub struct PlaneFilter<'a> {
    /// Pictures.
    pub batch: usize,
    /// Channels filtered.
    pub channels: usize,
    /// Kernels per pixel.
    pub filters: usize,
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// Row and column of each tap in a picture padded by `reach`.
    pub taps: &'a [(usize, usize)],
    /// Pixels a kernel reaches beyond its centre.
    pub reach: usize,
    /// What each atom holds at each tap, `[taps][atoms]`.
    pub atoms: &'a [f32],
    /// What is filtered, `[B, C, H, W]`.
    pub x: &'a [f32],
    /// Coefficients of the atoms, `[B, filters * atoms, H, W]`.
    pub coefficients: &'a [f32],
    /// Instructions to use.
    pub isa: Isa,
}

/// Rows of one picture, from `first` on.
#[derive(Clone, Copy)]
struct Stretch {
    picture: usize,
    first: usize,
    count: usize,
}

impl PlaneFilter<'_> {
    fn atom_count(&self) -> usize {
        self.atoms.len() / self.taps.len()
    }

    fn plane(&self) -> usize {
        self.height * self.width
    }

    /// # Panics
    /// If an operand's length is not what the sizes say.
    fn check(&self) {
        let pixels = self.batch * self.plane();
        let (taps, atoms) = (self.taps.len(), self.atom_count());
        assert!(pixels > 0 && self.channels > 0 && self.filters > 0 && taps > 0 && atoms > 0);
        assert_eq!(self.atoms.len(), taps * atoms, "atoms");
        assert_eq!(self.x.len(), pixels * self.channels, "what is filtered");
        let wanted = pixels * self.filters * atoms;
        assert_eq!(self.coefficients.len(), wanted, "coefficients");
        let side = 2 * self.reach + 1;
        assert!(
            self.taps.iter().all(|(y, x)| *y < side && *x < side),
            "taps"
        );
    }

    /// Distance of rows in scratch memory.
    fn row(&self) -> usize {
        self.width + self.reach
    }

    /// Places from the first pixel of a stretch to its last, in scratch memory.
    fn span(&self, stretch: Stretch) -> usize {
        stretch.count * self.row() - self.reach
    }

    /// Rows of a stretch; a function of the sizes alone.
    fn stretch_rows(&self) -> usize {
        let per_pixel = self.filters * (2 * self.taps.len() + 2 * self.atom_count())
            + self.channels * (2 + self.filters);
        let rows = (STRETCH_LEN / per_pixel / self.row()).clamp(1, self.height);
        self.height.div_ceil(self.height.div_ceil(rows))
    }

    fn stretches(&self) -> Vec<Stretch> {
        let rows = self.stretch_rows();
        let firsts = || (0..self.height).step_by(rows);
        (0..self.batch)
            .flat_map(|picture| {
                firsts().map(move |first| Stretch {
                    picture,
                    first,
                    count: rows.min(self.height - first),
                })
            })
            .collect()
    }

    /// Length of a plane's stretch with the rows around it.
    fn wide_len(&self) -> usize {
        self.reach + (self.stretch_rows() + 2 * self.reach) * self.row()
    }

    /// Where the stretch itself begins in it.
    fn origin(&self) -> usize {
        self.reach + self.reach * self.row()
    }

    /// Copies consecutive planes, with the rows around the stretch; zeros follow the last.
    #[inline(always)]
    fn copy_planes(&self, from: &[f32], stretch: Stretch, to: &mut [f32]) {
        let count = from.len() / self.batch / self.plane();
        let from = &from[stretch.picture * count * self.plane()..][..count * self.plane()];
        let (planes, slack) = to.split_at_mut(count * self.wide_len());
        slack.fill(0.0);
        let places = planes.chunks_exact_mut(self.wide_len());
        for (from, to) in from.chunks_exact(self.plane()).zip(places) {
            let (before, rows) = to.split_at_mut(self.reach);
            before.fill(0.0);
            for (i, to) in rows.chunks_exact_mut(self.row()).enumerate() {
                let y = (stretch.first + i).checked_sub(self.reach);
                match y.filter(|y| *y < self.height) {
                    None => to.fill(0.0),
                    Some(y) => {
                        let (to, right) = to.split_at_mut(self.width);
                        to.copy_from_slice(&from[y * self.width..][..self.width]);
                        right.fill(0.0);
                    }
                }
            }
        }
    }

    /// Copies consecutive sums of a stretch to their `planes`, of which each picture has `count`
    /// and these are those from `first` on.
    ///
    /// # Safety
    /// The rows are the stretch's alone.
    #[inline(always)]
    unsafe fn give(
        &self,
        stretch: Stretch,
        sums: &[f32],
        (first, count): (usize, usize),
        to: &Fresh,
    ) {
        let planes = sums.chunks_exact(sums_row(self.span(stretch)));
        for (i, sums) in planes.enumerate() {
            let plane = stretch.picture * count + first + i;
            let start = plane * self.plane() + stretch.first * self.width;
            // SAFETY: passed on from the caller; the values are only written.
            let to = unsafe { to.part(start, stretch.count * self.width) };
            let rows = to.chunks_exact_mut(self.width).zip(sums.chunks(self.row()));
            rows.for_each(|(to, sums)| to.copy_from_slice(&sums[..self.width]));
        }
    }

    /// `[B, C * filters, H, W]`, index `c * filters + m`.
    ///
    /// # Panics
    /// If an operand's length is not what the sizes say, or the processor lacks the instructions.
    pub fn forward(&self) -> Vec<f32> {
        self.check();
        let out = Fresh::new(self.x.len() * self.filters);
        let plan = Plan::new(self);
        let stretches = self.stretches();
        each(stretches.len(), |i| {
            with_scratch(plan.forward_len(), |scratch| {
                let unit = Forward {
                    plan: &plan,
                    stretch: stretches[i],
                    out: &out,
                    scratch,
                };
                run(self.isa, unit);
            });
        });
        // SAFETY: the stretches cover every row of every plane.
        unsafe { out.into_values() }
    }

    /// Gradients of what is filtered and of the coefficients, from that of the result.
    ///
    /// # Panics
    /// As [`Self::forward`].
    pub fn backward(&self, grad: &[f32]) -> (Vec<f32>, Vec<f32>) {
        self.check();
        assert_eq!(grad.len(), self.x.len() * self.filters, "gradient");
        let plan = Plan::new(self);
        let (x_grad, coefficient_grad) = (
            Fresh::new(self.x.len()),
            Fresh::new(self.coefficients.len()),
        );
        let stretches = self.stretches();
        each(stretches.len(), |i| {
            with_scratch(plan.backward_len(), |scratch| {
                let unit = Backward {
                    plan: &plan,
                    stretch: stretches[i],
                    grad,
                    x_grad: &x_grad,
                    coefficient_grad: &coefficient_grad,
                    scratch,
                };
                run(self.isa, unit);
            });
        });
        // SAFETY: the stretches cover every row of every plane.
        unsafe { (x_grad.into_values(), coefficient_grad.into_values()) }
    }
}

/// What all units of a pass share.
struct Plan<'a> {
    filter: &'a PlaneFilter<'a>,
    /// Per tap a sum over atoms, and per atom a sum over taps.
    atoms: Vec<f32>,
    atoms_turned: Vec<f32>,
    /// Where each tap finds what the first pixel of a stretch sees, in a stretch of a plane.
    offsets: Vec<usize>,
    /// Where it finds the pixels that see the first one.
    offsets_back: Vec<usize>,
}

impl<'a> Plan<'a> {
    fn new(filter: &'a PlaneFilter<'a>) -> Self {
        let (taps, atoms) = (filter.taps.len(), filter.atom_count());
        let turned: Vec<f32> = (0..atoms)
            .flat_map(|atom| (0..taps).map(move |tap| filter.atoms[tap * atoms + atom]))
            .collect();
        // One `reach` of zeros stands before the first row.
        let offset = |(y, x): &(usize, usize)| y * filter.row() + x;
        let offsets: Vec<usize> = filter.taps.iter().map(offset).collect();
        let back = |offset: &usize| 2 * filter.origin() - offset;
        Self {
            filter,
            atoms: pack(filter.atoms, taps),
            atoms_turned: pack(&turned, atoms),
            offsets_back: offsets.iter().map(back).collect(),
            offsets,
        }
    }

    /// Room for `planes` stretches with the rows around, and a vector to read beyond them.
    fn wide(&self, planes: usize) -> usize {
        planes * self.filter.wide_len() + LANES
    }

    /// Room for `planes` sums, over the rows around as well.
    fn sums(&self, planes: usize) -> usize {
        planes * sums_row(self.filter.wide_len()) + LANES
    }

    fn coefficient_planes(&self) -> usize {
        self.filter.filters * self.filter.atom_count()
    }

    fn kernel_planes(&self) -> usize {
        self.filter.filters * self.filter.taps.len()
    }

    fn result_planes(&self) -> usize {
        self.filter.filters * self.filter.channels
    }

    fn forward_len(&self) -> usize {
        self.wide(self.filter.channels)
            + self.wide(self.coefficient_planes())
            + self.sums(self.kernel_planes())
            + self.sums(self.result_planes())
    }

    fn backward_len(&self) -> usize {
        self.wide(self.filter.channels)
            + self.wide(self.coefficient_planes())
            + 2 * self.sums(self.kernel_planes())
            + self.wide(self.result_planes())
            + self.sums(self.filter.channels)
            + self.sums(self.filter.atom_count())
    }

    /// Kernels `[filters][taps]` for `len` places from `at` on, at a distance of `sums_row(len)`.
    ///
    /// # Safety
    /// The processor has the instructions of `S`.
    #[inline(always)]
    unsafe fn build<S: Simd>(
        &self,
        coefficients: &[f32],
        (at, len): (usize, usize),
        kernels: &mut [f32],
    ) {
        let (count, wide) = (self.filter.atom_count(), self.filter.wide_len());
        let parts = kernels.chunks_exact_mut(self.filter.taps.len() * sums_row(len));
        for (m, kernels) in parts.enumerate().take(self.filter.filters) {
            let offsets: Vec<usize> = (0..count).map(|k| (m * count + k) * wide + at).collect();
            let product = WeightedSums {
                source: coefficients,
                offsets: &offsets,
                weights: &self.atoms,
                outputs: self.filter.taps.len(),
                len,
            };
            // SAFETY: passed on from the caller.
            unsafe { product.run::<S>(kernels) };
        }
    }
}

/// Calls a function generic over the sizes of a tile for what is left of two dimensions.
macro_rules! tile {
    ($function:ident, $first:expr, $second:expr, ($($argument:expr),*)) => {
        match ($first.min(4), $second.min(2)) {
            (1, 1) => $function::<S, 1, 1>($($argument),*),
            (2, 1) => $function::<S, 2, 1>($($argument),*),
            (3, 1) => $function::<S, 3, 1>($($argument),*),
            (_, 1) => $function::<S, 4, 1>($($argument),*),
            (1, _) => $function::<S, 1, 2>($($argument),*),
            (2, _) => $function::<S, 2, 2>($($argument),*),
            (3, _) => $function::<S, 3, 2>($($argument),*),
            (_, _) => $function::<S, 4, 2>($($argument),*),
        }
    };
}

struct Forward<'a> {
    plan: &'a Plan<'a>,
    stretch: Stretch,
    out: &'a Fresh,
    scratch: &'a mut [f32],
}

impl Kernel for Forward<'_> {
    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let Self {
            plan,
            stretch,
            out,
            scratch,
        } = self;
        let filter = plan.filter;
        let (x, rest) = scratch.split_at_mut(plan.wide(filter.channels));
        let (coefficients, rest) = rest.split_at_mut(plan.wide(plan.coefficient_planes()));
        let (kernels, sums) = rest.split_at_mut(plan.sums(plan.kernel_planes()));
        filter.copy_planes(filter.x, stretch, x);
        filter.copy_planes(filter.coefficients, stretch, coefficients);
        let len = filter.span(stretch);
        let (row, wide, taps) = (sums_row(len), filter.wide_len(), filter.taps.len());
        let planes = plan.result_planes();
        // SAFETY: the caller vouches for the instructions. Tiles read `row` values at an offset
        // of every plane, which lie in the stretch and the vector behind it.
        unsafe {
            plan.build::<S>(coefficients, (filter.origin(), len), kernels);
            for c in (0..filter.channels).step_by(4) {
                for m in (0..filter.filters).step_by(2) {
                    let left = (filter.channels - c, filter.filters - m);
                    let x = x[c * wide..].as_ptr();
                    let kernels = kernels[m * taps * row..].as_ptr();
                    let sums = sums[(c * filter.filters + m) * row..].as_mut_ptr();
                    tile!(
                        apply,
                        left.0,
                        left.1,
                        (x, wide, kernels, row, &plan.offsets, sums, filter.filters)
                    );
                }
            }
            filter.give(stretch, &sums[..planes * row], (0, planes), out);
        }
    }
}

/// `sums[c][m] = sum over taps of kernels[m][tap] * x[c]` at the tap's offset.
///
/// # Safety
/// The processor has the instructions of `S`; `x` holds C planes at a distance of `wide`,
/// `kernels` M times one plane per tap at a distance of `row`, and `sums` C times `filters` planes.
#[inline(always)]
unsafe fn apply<S: Simd, const C: usize, const M: usize>(
    x: *const f32,
    wide: usize,
    kernels: *const f32,
    row: usize,
    offsets: &[usize],
    out: *mut f32,
    filters: usize,
) {
    for n in (0..row).step_by(LANES) {
        // SAFETY: passed on from the caller.
        unsafe {
            let mut sums = [[S::splat(0.0); M]; C];
            for (tap, offset) in offsets.iter().enumerate() {
                let kernel = kernels.add(tap * row + n);
                let kernel: [S::V; M] =
                    std::array::from_fn(|m| S::load(kernel.add(m * offsets.len() * row)));
                for (c, sums) in sums.iter_mut().enumerate() {
                    let x = S::load(x.add(c * wide + offset + n));
                    for (sum, kernel) in sums.iter_mut().zip(&kernel) {
                        *sum = S::mul_add(x, *kernel, *sum);
                    }
                }
            }
            for (c, sums) in sums.iter().enumerate() {
                for (m, sum) in sums.iter().enumerate() {
                    S::store(out.add((c * filters + m) * row + n), *sum);
                }
            }
        }
    }
}

struct Backward<'a> {
    plan: &'a Plan<'a>,
    stretch: Stretch,
    grad: &'a [f32],
    x_grad: &'a Fresh,
    coefficient_grad: &'a Fresh,
    scratch: &'a mut [f32],
}

impl Kernel for Backward<'_> {
    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let Self {
            plan,
            stretch,
            grad,
            x_grad,
            coefficient_grad,
            scratch,
        } = self;
        let filter = plan.filter;
        let (x, rest) = scratch.split_at_mut(plan.wide(filter.channels));
        let (coefficients, rest) = rest.split_at_mut(plan.wide(plan.coefficient_planes()));
        let (kernels, rest) = rest.split_at_mut(plan.sums(plan.kernel_planes()));
        let (kernel_grads, rest) = rest.split_at_mut(plan.sums(plan.kernel_planes()));
        let (inner, rest) = rest.split_at_mut(plan.wide(plan.result_planes()));
        let (sums, atom_sums) = rest.split_at_mut(plan.sums(filter.channels));
        filter.copy_planes(filter.x, stretch, x);
        filter.copy_planes(filter.coefficients, stretch, coefficients);
        filter.copy_planes(grad, stretch, inner);
        let (len, wide, taps) = (filter.span(stretch), filter.wide_len(), filter.taps.len());
        let (row, kernel_row) = (sums_row(len), sums_row(wide));
        let (channels, filters, atoms) = (filter.channels, filter.filters, filter.atom_count());
        // SAFETY: the caller vouches for the instructions. Tiles read `row` values at an offset
        // of every plane, which lie in the stretch and the vector behind it.
        unsafe {
            plan.build::<S>(coefficients, (0, wide), kernels);
            kernels[plan.kernel_planes() * kernel_row..].fill(0.0);
            for c in (0..channels).step_by(4) {
                let inner = inner[c * filters * wide..].as_ptr();
                let sums = sums[c * row..].as_mut_ptr();
                let back = &plan.offsets_back;
                let kernels = kernels.as_ptr();
                let planes = (wide, kernel_row, row, filters);
                match channels - c {
                    1 => spread::<S, 1>(inner, kernels, planes, back, sums),
                    2 => spread::<S, 2>(inner, kernels, planes, back, sums),
                    3 => spread::<S, 3>(inner, kernels, planes, back, sums),
                    _ => spread::<S, 4>(inner, kernels, planes, back, sums),
                }
            }
            filter.give(stretch, &sums[..channels * row], (0, channels), x_grad);
            for m in (0..filters).step_by(2) {
                for tap in (0..taps).step_by(4) {
                    let inner = inner[m * wide + filter.origin()..].as_ptr();
                    let sums = kernel_grads[(m * taps + tap) * row..].as_mut_ptr();
                    let offsets = &plan.offsets[tap..];
                    let planes = (wide, row, filters, taps);
                    let x = x.as_ptr();
                    tile!(
                        correlate,
                        offsets.len(),
                        (filters - m),
                        (inner, x, planes, channels, offsets, sums)
                    );
                }
            }
            let offsets: Vec<usize> = (0..taps).map(|tap| tap * row).collect();
            for (m, source) in kernel_grads.chunks(taps * row).enumerate().take(filters) {
                let product = WeightedSums {
                    source,
                    offsets: &offsets,
                    weights: &plan.atoms_turned,
                    outputs: atoms,
                    len,
                };
                product.run::<S>(atom_sums);
                let place = (m * atoms, filters * atoms);
                filter.give(stretch, &atom_sums[..atoms * row], place, coefficient_grad);
            }
        }
    }
}

/// `sums[c] = sum over m and taps of kernels[m][tap] * inner[c][m]`, both at the tap's offset.
///
/// # Safety
/// As [`apply`]; `planes` are the distances of inner gradients, of kernels and of sums, and the
/// number of filters.
#[inline(always)]
unsafe fn spread<S: Simd, const C: usize>(
    inner: *const f32,
    kernels: *const f32,
    (wide, kernel_row, row, filters): (usize, usize, usize, usize),
    offsets: &[usize],
    out: *mut f32,
) {
    for n in (0..row).step_by(LANES) {
        // SAFETY: passed on from the caller.
        unsafe {
            let mut sums = [S::splat(0.0); C];
            for m in 0..filters {
                for (tap, offset) in offsets.iter().enumerate() {
                    let at = offset + n;
                    let kernel = S::load(kernels.add((m * offsets.len() + tap) * kernel_row + at));
                    for (c, sum) in sums.iter_mut().enumerate() {
                        let inner = S::load(inner.add((c * filters + m) * wide + at));
                        *sum = S::mul_add(inner, kernel, *sum);
                    }
                }
            }
            for (c, sum) in sums.iter().enumerate() {
                S::store(out.add(c * row + n), *sum);
            }
        }
    }
}

/// `sums[m][tap] = sum over channels of inner[c][m] * x[c]` at the tap's offset.
///
/// # Safety
/// As [`apply`]; `planes` are the distances of inner gradients and inputs and of sums, and the
/// numbers of filters and of all taps.
#[inline(always)]
unsafe fn correlate<S: Simd, const T: usize, const M: usize>(
    inner: *const f32,
    x: *const f32,
    (wide, row, filters, taps): (usize, usize, usize, usize),
    channels: usize,
    offsets: &[usize],
    out: *mut f32,
) {
    let offsets: [usize; T] = std::array::from_fn(|tap| offsets[tap]);
    for n in (0..row).step_by(LANES) {
        // SAFETY: passed on from the caller.
        unsafe {
            let mut sums = [[S::splat(0.0); T]; M];
            for c in 0..channels {
                let inner = inner.add(c * filters * wide + n);
                let inner: [S::V; M] = std::array::from_fn(|m| S::load(inner.add(m * wide)));
                for (tap, offset) in offsets.iter().enumerate() {
                    let x = S::load(x.add(c * wide + offset + n));
                    for (sums, inner) in sums.iter_mut().zip(&inner) {
                        sums[tap] = S::mul_add(x, *inner, sums[tap]);
                    }
                }
            }
            for (m, sums) in sums.iter().enumerate() {
                for (tap, sum) in sums.iter().enumerate() {
                    S::store(out.add((m * taps + tap) * row + n), *sum);
                }
            }
        }
    }
}

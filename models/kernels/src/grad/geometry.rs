//! How a convolution's operands lie in scratch memory.
//!
//! A stretch of rows of a picture is copied once between zeros, all rows at one distance
//! ([`Geometry::row`]) that leaves room for the zeros a window sees beyond the edges. Then what a
//! tap of the window sees is the same stretch of numbers at another offset, whole rows at a time,
//! so that a convolution is a product of weights with shifted vectors whatever the width of the
//! picture. With stride 2, even and odd rows and columns are parted at the copy.

/// Values that one stretch should hold per channel: a window's rows then stay in the
/// first-level cache while all its taps are summed.
const STRETCH_LEN: usize = 2048;

/// A convolution with zero padding `kernel / 2`, on pictures of one size.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Geometry {
    /// Pictures.
    pub batch: usize,
    /// Channels that enter, of all sources together.
    pub inputs: usize,
    /// Channels that leave.
    pub outputs: usize,
    /// Side of the window, odd.
    pub kernel: usize,
    /// 1 or 2.
    pub stride: usize,
    /// Rows that enter.
    pub height: usize,
    /// Columns that enter.
    pub width: usize,
}

/// Rows `first..first + count` of the output.
#[derive(Debug, Clone, Copy)]
pub(super) struct Stretch {
    pub(super) picture: usize,
    pub(super) first: usize,
    pub(super) count: usize,
}

/// Where the weights of one part of an input gradient find what they multiply: inputs whose rows
/// and columns leave the same remainder by the stride meet the same taps.
#[derive(Debug)]
pub(super) struct GradPhase {
    /// First row and column of the input in a stretch's first picture row.
    pub(super) row: usize,
    pub(super) column: usize,
    /// Columns of the input.
    pub(super) columns: usize,
    /// Of each output and tap, in scratch memory of the output's gradient.
    pub(super) offsets: Vec<usize>,
    /// Row and column of each tap in the window.
    pub(super) taps: Vec<(usize, usize)>,
}

impl Geometry {
    /// Rows that leave.
    pub fn out_height(&self) -> usize {
        self.height.div_ceil(self.stride)
    }

    /// Columns that leave.
    pub fn out_width(&self) -> usize {
        self.width.div_ceil(self.stride)
    }

    /// Values of one picture that leave.
    pub fn out_len(&self) -> usize {
        self.outputs * self.out_height() * self.out_width()
    }

    /// Weights per output.
    pub fn taps(&self) -> usize {
        self.inputs * self.kernel * self.kernel
    }

    /// # Panics
    /// On sizes no kernel here handles.
    pub(super) fn check(&self) {
        assert!(
            self.kernel % 2 == 1
                && (1..=2).contains(&self.stride)
                && self.inputs > 0
                && self.outputs > 0
                && self.height > 0
                && self.width > 0,
            "no convolution: {self:?}"
        );
    }

    /// Pixels the window reaches beyond its centre.
    pub(super) fn reach(&self) -> usize {
        self.kernel / 2
    }

    /// Distance of rows in scratch memory.
    pub(super) fn row(&self) -> usize {
        self.out_width() + self.reach()
    }

    /// Output rows of a stretch, the last of a picture excepted; a function of the sizes alone.
    pub(super) fn stretch_rows(&self) -> usize {
        let height = self.out_height();
        let rows = (STRETCH_LEN / self.row()).clamp(1, height);
        height.div_ceil(height.div_ceil(rows))
    }

    /// Places from the first output of a stretch of `rows` to its last, in scratch memory.
    pub(super) fn span(&self, rows: usize) -> usize {
        rows * self.row() - self.reach()
    }

    /// All pictures, cut into stretches of rows.
    pub(super) fn stretches(&self) -> Vec<Stretch> {
        let (height, rows) = (self.out_height(), self.stretch_rows());
        (0..self.batch)
            .flat_map(|picture| {
                (0..height).step_by(rows).map(move |first| Stretch {
                    picture,
                    first,
                    count: rows.min(height - first),
                })
            })
            .collect()
    }

    /// Rows of one phase of an input channel in scratch memory.
    fn phase_rows(&self) -> usize {
        self.stretch_rows() + (self.kernel - 1) / self.stride
    }

    /// Length of one phase of an input channel.
    fn phase_len(&self) -> usize {
        self.phase_rows() * self.row() + self.reach()
    }

    /// Length of an input channel in scratch memory: its phases, row phase outside.
    pub(super) fn channel_len(&self) -> usize {
        self.stride * self.stride * self.phase_len()
    }

    /// Length of an output channel's gradient in scratch memory: the stretch's rows between as
    /// many others as the window reaches, after as many zeros.
    pub(super) fn grad_len(&self) -> usize {
        self.reach() + (self.stretch_rows() + 2 * self.reach()) * self.row()
    }

    /// Where the first value of a stretch lies in an output channel's gradient.
    pub(super) fn grad_origin(&self) -> usize {
        self.reach() + self.reach() * self.row()
    }

    /// Where each tap of each input finds what the first output of a stretch sees, in the order
    /// of the weights.
    pub(super) fn tap_offsets(&self) -> Vec<usize> {
        let Self { kernel, stride, .. } = *self;
        let mut offsets = Vec::with_capacity(self.taps());
        for input in 0..self.inputs {
            for (ky, kx) in (0..kernel).flat_map(|ky| (0..kernel).map(move |kx| (ky, kx))) {
                let phase = (ky % stride) * stride + kx % stride;
                let place = (ky / stride) * self.row() + kx / stride;
                offsets.push(input * self.channel_len() + phase * self.phase_len() + place);
            }
        }
        offsets
    }

    /// The parts of the input gradient. Input row `y` meets tap `ky` of output row `o` where
    /// `y + reach = stride * o + ky`; with `ky = stride * i + a` that is `o = m - i` for the rows
    /// `y = stride * m + a - reach`. Columns likewise.
    pub(super) fn grad_phases(&self) -> Vec<GradPhase> {
        let Self { kernel, stride, .. } = *self;
        let reach = self.reach();
        // The first m of a stretch, from the stretch's first row.
        let first = |a: usize| reach.saturating_sub(a).div_ceil(stride);
        let mut phases = Vec::new();
        for (a, b) in (0..stride).flat_map(|a| (0..stride).map(move |b| (a, b))) {
            let taps: Vec<(usize, usize)> = (a..kernel)
                .step_by(stride)
                .flat_map(|ky| (b..kernel).step_by(stride).map(move |kx| (ky, kx)))
                .collect();
            let mut offsets = Vec::with_capacity(self.outputs * taps.len());
            for output in 0..self.outputs {
                let origin = output * self.grad_len() + self.grad_origin();
                for (ky, kx) in &taps {
                    let down = origin + first(a) * self.row() + first(b);
                    offsets.push(down - (ky / stride) * self.row() - kx / stride);
                }
            }
            phases.push(GradPhase {
                row: stride * first(a) + a - reach,
                column: stride * first(b) + b - reach,
                columns: (self.width + reach - b)
                    .div_ceil(stride)
                    .saturating_sub(first(b)),
                offsets,
                taps,
            });
        }
        phases
    }

    /// Copies what a stretch from output row `first` on sees of one input `plane` to `to`,
    /// `channel_len` long.
    #[inline(always)]
    pub(super) fn copy_input(&self, first: usize, plane: &[f32], to: &mut [f32]) {
        let (stride, reach, row) = (self.stride, self.reach(), self.row());
        let phases = to.chunks_exact_mut(self.phase_len());
        for (phase, to) in phases.enumerate() {
            let (a, b) = (phase / stride, phase % stride);
            let (rows, end) = to.split_at_mut(self.phase_rows() * row);
            end.fill(0.0);
            for (i, to) in rows.chunks_exact_mut(row).enumerate() {
                let y = (stride * (first + i) + a).checked_sub(reach);
                match y.filter(|y| *y < self.height) {
                    None => to.fill(0.0),
                    Some(y) => self.copy_row(b, &plane[y * self.width..][..self.width], to),
                }
            }
        }
    }

    /// Copies every column of phase `b` to its place between zeros.
    #[inline(always)]
    fn copy_row(&self, b: usize, from: &[f32], to: &mut [f32]) {
        let (stride, reach) = (self.stride, self.reach());
        // Places before the first column that lies inside, and that column.
        let before = reach.saturating_sub(b).div_ceil(stride);
        let seen = from.get(before * stride + b - reach..).unwrap_or_default();
        let len = seen.len().div_ceil(stride).min(to.len() - before);
        let (left, right) = to.split_at_mut(before);
        let (middle, right) = right.split_at_mut(len);
        left.fill(0.0);
        right.fill(0.0);
        if stride == 1 {
            middle.copy_from_slice(&seen[..len]);
        } else {
            for (to, from) in middle.iter_mut().zip(seen.iter().step_by(2)) {
                *to = *from;
            }
        }
    }
}

//! Where each pixel of one picture lies in the next: dense optical flow.
//!
//! Total variation with an absolute data term, from coarse to fine, by the dual scheme of Zach, Pock
//! and Bischof (2007) as set out by Sanchez, Meinhardt-Llopis and Facciolo (IPOL, 2013), with a
//! median after every warp (Sun, Roth and Black, 2010). The number of rounds is fixed, so the same
//! pictures give the same bits.
//!
//! What passes its surroundings by half its own size from picture to picture is too small to be seen
//! where it would have to be found, on the coarse levels, and is lost.

use noctule_depth::Size;

use super::error::SynthError;
use super::plane::{Corners, Plane};

/// Weight of the data against smoothness, for grey of 0 to 255.
const DATA: f32 = 0.15;
/// How closely the two halves of the scheme are tied.
const TIE: f32 = 0.3;
/// Step of the dual variable.
const DUAL_STEP: f32 = 0.25;
/// Times that each level is warped anew, and rounds of the scheme within each.
const WARPS: usize = 5;
const ROUNDS: usize = 20;
/// No level is smaller than this, pixels.
const SIDE_MIN: usize = 12;

/// A displacement for every pixel of a picture.
#[derive(Debug, Clone, PartialEq)]
pub struct OpticalFlow {
    /// Pixels to the right, `[H, W]`.
    pub(super) dx: Plane,
    /// Pixels down, `[H, W]`.
    pub(super) dy: Plane,
}

impl OpticalFlow {
    /// Finds where `from` lies in `to`, both grey, 0 to 255, `[H, W]`; what it shows is best encoded
    /// as the eye sees it (gamma), not linear in light.
    ///
    /// # Errors
    /// [`SynthError::Grey`], when a picture has another size or holds what is no finite number.
    pub fn between(from: &[f32], to: &[f32], size: Size) -> Result<Self, SynthError> {
        let plane = |values: &[f32]| {
            let (len, wanted) = (values.len(), size.pixels());
            let is_finite = values.iter().all(|value| value.is_finite());
            if len != wanted || !is_finite {
                return Err(SynthError::Grey {
                    len,
                    wanted,
                    is_finite,
                });
            }
            Ok(Plane {
                width: size.width(),
                height: size.height(),
                values: values.to_vec(),
            })
        };
        Ok(Self::of_planes(&plane(from)?, &plane(to)?))
    }

    /// As [`between`](Self::between); both planes have one size.
    pub(super) fn of_planes(from: &Plane, to: &Plane) -> Self {
        let mut levels = vec![(from.clone(), to.clone())];
        while let Some((from, to)) = levels.last()
            && from.width.min(from.height) >= 2 * SIDE_MIN
        {
            levels.push((from.halved(), to.halved()));
        }
        let mut flow: Option<Self> = None;
        for (from, to) in levels.iter().rev() {
            let (w, h) = (from.width, from.height);
            let mut found = flow.map_or_else(
                || Self {
                    dx: Plane::zeros(w, h),
                    dy: Plane::zeros(w, h),
                },
                |coarse| Self {
                    dx: coarse.dx.doubled(w, h, 2.0),
                    dy: coarse.dy.doubled(w, h, 2.0),
                },
            );
            found.refine(from, to);
            flow = Some(found);
        }
        flow.expect("there is a level at least")
    }

    /// Columns and rows.
    pub fn size(&self) -> (usize, usize) {
        (self.dx.width, self.dx.height)
    }

    /// Displacement of pixel `(x, y)`, to the right and down, pixels; of the nearest one where there
    /// is none.
    pub fn at(&self, x: usize, y: usize) -> [f32; 2] {
        let cell = y.min(self.dx.height - 1) * self.dx.width + x.min(self.dx.width - 1);
        [self.dx.values[cell], self.dy.values[cell]]
    }

    /// One level: warps, and rounds within each.
    fn refine(&mut self, from: &Plane, to: &Plane) {
        let slopes = to.slopes();
        let mut dual = Dual::new(from.width, from.height);
        let mut data = Data::new(from.values.len());
        for _ in 0..WARPS {
            data.linearise(self, from, to, &slopes);
            for _ in 0..ROUNDS {
                self.follow(&data, &dual);
                dual.follow(self);
            }
            self.dx = self.dx.medians();
            self.dy = self.dy.medians();
        }
    }

    /// Half a round: a step of thresholded data, and the dual's divergence.
    fn follow(&mut self, data: &Data, dual: &Dual) {
        let (w, h) = (self.dx.width, self.dx.height);
        let mut divergence = [vec![0.0; w], vec![0.0; w]];
        for y in 0..h {
            let here = y * w..(y + 1) * w;
            dual.divergence(y, w, &mut divergence);
            let [div_x, div_y] = &divergence;
            let (dx, dy) = (
                &mut self.dx.values[here.clone()],
                &mut self.dy.values[here.clone()],
            );
            let (gx, gy) = (&data.gx[here.clone()], &data.gy[here.clone()]);
            let (rest, inverse) = (&data.rest[here.clone()], &data.inverse[here]);
            for x in 0..w {
                let residual = rest[x] + gx[x] * dx[x] + gy[x] * dy[x];
                let step = (-residual * inverse[x]).clamp(-DATA * TIE, DATA * TIE);
                dx[x] += step * gx[x] + TIE * div_x[x];
                dy[x] += step * gy[x] + TIE * div_y[x];
            }
        }
    }
}

/// The data term around the present flow: residual `rest + g . flow`.
struct Data {
    gx: Vec<f32>,
    gy: Vec<f32>,
    rest: Vec<f32>,
    /// One over the squared slope; 0 where there is none.
    inverse: Vec<f32>,
}

impl Data {
    fn new(len: usize) -> Self {
        let zeros = || vec![0.0; len];
        Self {
            gx: zeros(),
            gy: zeros(),
            rest: zeros(),
            inverse: zeros(),
        }
    }

    fn linearise(&mut self, flow: &OpticalFlow, from: &Plane, to: &Plane, slopes: &[Plane; 2]) {
        let (w, h) = (from.width, from.height);
        for (cell, grey) in from.values.iter().enumerate() {
            let (dx, dy) = (flow.dx.values[cell], flow.dy.values[cell]);
            let (x, y) = ((cell % w) as f32 + dx, (cell / w) as f32 + dy);
            let is_inside =
                (0.0..=(w - 1) as f32).contains(&x) && (0.0..=(h - 1) as f32).contains(&y);
            // What leaves the picture follows its neighbours.
            let (gx, gy, residual) = if is_inside {
                let corners = Corners::around(x, y, w, h);
                let slope = slopes.each_ref().map(|slope| corners.of(&slope.values));
                (slope[0], slope[1], corners.of(&to.values) - grey)
            } else {
                (0.0, 0.0, 0.0)
            };
            let square = gx * gx + gy * gy;
            self.gx[cell] = gx;
            self.gy[cell] = gy;
            self.rest[cell] = residual - gx * dx - gy * dy;
            self.inverse[cell] = if square > 1e-6 { 1.0 / square } else { 0.0 };
        }
    }
}

/// The dual variable: two components for each of the flow's.
struct Dual {
    x: [Plane; 2],
    y: [Plane; 2],
}

impl Dual {
    fn new(width: usize, height: usize) -> Self {
        let zeros = || [Plane::zeros(width, height), Plane::zeros(width, height)];
        Self {
            x: zeros(),
            y: zeros(),
        }
    }

    /// Backward differences of one row; the last column's and row's duals are 0 and stay so.
    fn divergence(&self, y: usize, w: usize, out: &mut [Vec<f32>; 2]) {
        for (dual, out) in [&self.x, &self.y].into_iter().zip(out) {
            let (across, down) = (dual[0].row(y), dual[1].row(y));
            out.copy_from_slice(down);
            out.iter_mut().zip(across).for_each(|(o, a)| *o += a);
            let left = out[1..w].iter_mut().zip(across);
            left.for_each(|(o, a)| *o -= a);
            if y > 0 {
                let above = dual[1].row(y - 1);
                out.iter_mut().zip(above).for_each(|(o, a)| *o -= a);
            }
        }
    }

    /// Half a round: ascent along the flow's slopes, kept within the unit disc.
    fn follow(&mut self, flow: &OpticalFlow) {
        const RATE: f32 = DUAL_STEP / TIE;
        let (w, h) = (flow.dx.width, flow.dx.height);
        for (dual, of) in [(&mut self.x, &flow.dx), (&mut self.y, &flow.dy)] {
            let [across, down] = dual;
            for y in 0..h {
                let (row, below) = (of.row(y), of.row((y + 1).min(h - 1)));
                let across = &mut across.values[y * w..][..w];
                let down = &mut down.values[y * w..][..w];
                for x in 0..w - 1 {
                    let (gx, gy) = (row[x + 1] - row[x], below[x] - row[x]);
                    let scale = 1.0 / (1.0 + RATE * (gx * gx + gy * gy).sqrt());
                    across[x] = (across[x] + RATE * gx) * scale;
                    down[x] = (down[x] + RATE * gy) * scale;
                }
                let gy = below[w - 1] - row[w - 1];
                down[w - 1] = (down[w - 1] + RATE * gy) / (1.0 + RATE * gy.abs());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Grey that repeats nowhere near, moved by `(dx, dy)`: waves of unrelated lengths and
    /// directions.
    fn texture(size: (usize, usize), dx: f32, dy: f32) -> Plane {
        let mut plane = Plane::zeros(size.0, size.1);
        for (i, value) in plane.values.iter_mut().enumerate() {
            let (x, y) = ((i % size.0) as f32 - dx, (i / size.0) as f32 - dy);
            let wave = |k: f32| {
                let (turn, length) = (2.399_963 * k, 9.0 + 1.618_034 * k * k);
                (turn.cos() * x + turn.sin() * y) * std::f32::consts::TAU / length + 1.3 * k * k
            };
            *value = 128.0 + (0..9).map(|k| 14.0 * wave(k as f32).sin()).sum::<f32>();
        }
        plane
    }

    #[test]
    fn a_moved_texture_is_found_to_a_tenth_of_a_pixel() {
        for (dx, dy) in [(0.4, -0.3), (3.3, 1.7), (-11.5, 4.25)] {
            let flow =
                OpticalFlow::of_planes(&texture((120, 90), 0.0, 0.0), &texture((120, 90), dx, dy));
            let (mut worst, mut sum, mut count) = (0.0_f32, 0.0, 0.0);
            for y in 15..75 {
                for x in 20..100 {
                    let [fx, fy] = flow.at(x, y);
                    let error = (fx - dx).hypot(fy - dy);
                    worst = worst.max(error);
                    sum += error;
                    count += 1.0;
                }
            }
            eprintln!("({dx}, {dy}): mean {} px, worst {worst} px", sum / count);
            assert!(sum / count < 0.1 && worst < 0.3, "{dx} {dy}");
        }
    }

    #[test]
    fn what_has_no_texture_or_hardly_a_size_stands_still() {
        for size in [(1, 1), (1, 40), (37, 1), (2, 3), (25, 24), (61, 33)] {
            let flat = Plane {
                width: size.0,
                height: size.1,
                values: vec![77.0; size.0 * size.1],
            };
            let flow = OpticalFlow::of_planes(&flat, &flat);
            assert!(flow.dx.values.iter().all(|d| *d == 0.0));
            let noisy = texture(size, 100.0, 3.0);
            let flow = OpticalFlow::of_planes(&noisy, &flat);
            assert!(flow.dx.values.iter().all(|d| d.is_finite()));
        }
    }

    #[test]
    fn pictures_that_are_none_are_refused() {
        let size = Size::new(2, 2).expect("a size");
        let error = OpticalFlow::between(&[0.0; 3], &[0.0; 4], size).expect_err("short");
        assert!(error.to_string().contains("3 numbers"), "{error}");
        assert!(OpticalFlow::between(&[f32::NAN; 4], &[0.0; 4], size).is_err());
        assert!(OpticalFlow::between(&[1.0; 4], &[0.0; 4], size).is_ok());
    }
}

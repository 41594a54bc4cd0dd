//! Pictures between two frames, moved along the flow between them.
//!
//! Every pixel of either frame is carried to the instant wanted, with its displacement and with
//! what is known of its visibility; each pixel of the new picture then looks up both frames (or
//! the one that sees it) where the displacement that arrived there says. Where nothing reliable
//! arrives the frames are blended.

use super::flow::OpticalFlow;
use super::plane::{Corners, Plane};
use super::view::{Light, View};

/// How much a displacement seen by one frame alone weighs against one that both agree on: what is
/// in both frames lies in front of what is not.
const ONE_SIDED: f32 = 0.03;
/// How much blending weighs. Small, and never 0: no pixel is left without light.
const BLENDED: f32 = 0.002;
/// Share of pixels that may move farther than what [`Gap::reach`] tells.
const REACH_BEYOND: f64 = 0.005;

/// Which frames see what a pixel shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Sight {
    /// Both: the flows there and back agree.
    Both,
    /// This one alone: in the other it is hidden, or outside.
    Here,
    /// Unknown: the flows contradict one another.
    Lost,
}

/// What moves from one frame to the next.
#[derive(Debug, Clone)]
pub(super) struct Gap {
    /// Forward on the first frame's pixels, and backward on the second's.
    sides: [Side; 2],
}

#[derive(Debug, Clone)]
struct Side {
    flow: OpticalFlow,
    sight: Vec<Sight>,
}

impl Gap {
    /// Of two frames, grey of 0 to 255.
    pub(super) fn between(first: &Plane, second: &Plane) -> Self {
        let (forward, backward) = rayon::join(
            || OpticalFlow::of_planes(first, second),
            || OpticalFlow::of_planes(second, first),
        );
        let (ahead, back) = (agreeing(&forward, &backward), agreeing(&backward, &forward));
        let sight = [
            sight(&forward, &ahead, &back),
            sight(&backward, &back, &ahead),
        ];
        let [here, there] = sight;
        Self {
            sides: [
                Side {
                    flow: forward,
                    sight: here,
                },
                Side {
                    flow: backward,
                    sight: there,
                },
            ],
        }
    }

    /// How far pixels of the view move from the first frame to the second; a few, and those nothing
    /// is known of, may move farther.
    pub(super) fn reach(&self, view: &View) -> f32 {
        let side = &self.sides[0];
        let mut lengths: Vec<f32> = view
            .cells()
            .filter(|cell| side.sight[*cell] != Sight::Lost)
            .map(|cell| side.flow.dx.values[cell].hypot(side.flow.dy.values[cell]))
            .collect();
        let rank = (lengths.len() as f64 * (1.0 - REACH_BEYOND)) as usize;
        match lengths.len().checked_sub(1) {
            Some(last) => {
                *lengths
                    .select_nth_unstable_by(rank.min(last), f32::total_cmp)
                    .1
            }
            None => 0.0,
        }
    }

    /// The light `share` of the way from `first` to `second`, within the view.
    pub(super) fn light(
        &self,
        [first, second]: [&Light; 2],
        share: f32,
        view: &View,
        arrivals: &mut Vec<Arrivals>,
        out: &mut Light,
    ) {
        arrivals.clear();
        arrivals.resize(view.size.pixels(), Arrivals::default());
        self.carry(share, view, arrivals);
        let (w, area) = (view.size.width(), view.size.pixels());
        let (width, height) = self.sides[0].flow.size();
        let plane = width * height;
        out.clear();
        out.resize(3 * area, 0.0);
        for (cell, (arrived, at)) in arrivals.iter().zip(view.cells()).enumerate() {
            let (x, y) = ((view.x + cell % w) as f32, (view.y + cell / w) as f32);
            // Where a displacement that arrived here came from and goes to.
            let ends = |[dx, dy]: [f32; 2]| {
                let ahead = 1.0 - share;
                [
                    Corners::around(x - share * dx, y - share * dy, width, height),
                    Corners::around(x + ahead * dx, y + ahead * dy, width, height),
                ]
            };
            let both = arrived
                .both
                .mean()
                .map(|mean| (arrived.both.weight, ends(mean)));
            let sided = [0, 1].map(|side: usize| {
                let weight = ONE_SIDED * arrived.one[side].weight;
                let mean = arrived.one[side].mean();
                mean.map(|mean| (weight, ends(mean)[side]))
            });
            let weight = BLENDED
                + both.map_or(0.0, |(weight, _)| weight)
                + sided
                    .iter()
                    .flatten()
                    .map(|(weight, _)| weight)
                    .sum::<f32>();
            for channel in 0..3 {
                let part = channel * plane..(channel + 1) * plane;
                let (first, second) = (&first[part.clone()], &second[part]);
                let mix = |a: f32, b: f32| a + share * (b - a);
                let mut light = BLENDED * mix(first[at], second[at]);
                if let Some((weight, [from, to])) = &both {
                    light += weight * mix(from.of(first), to.of(second));
                }
                for (frame, sided) in [first, second].into_iter().zip(&sided) {
                    if let Some((weight, corners)) = sided {
                        light += weight * corners.of(frame);
                    }
                }
                out[channel * area + cell] = light / weight;
            }
        }
    }

    /// Carries the displacements of both frames' pixels to where they are at `share`.
    fn carry(&self, share: f32, view: &View, arrivals: &mut [Arrivals]) {
        let (w, h) = (view.size.width(), view.size.height());
        let (width, _) = self.sides[0].flow.size();
        // A frame's word weighs less the farther it is away; so the picture turns into either
        // frame as it comes near.
        let times = [(share, 1.0 - share), (1.0 - share, share)];
        for (index, (side, (travelled, trust))) in self.sides.iter().zip(times).enumerate() {
            let sign = if index == 0 { 1.0 } else { -1.0 };
            for (cell, sight) in side.sight.iter().enumerate() {
                if *sight == Sight::Lost {
                    continue;
                }
                let (dx, dy) = (side.flow.dx.values[cell], side.flow.dy.values[cell]);
                let x = (cell % width) as f32 + travelled * dx - view.x as f32;
                let y = (cell / width) as f32 + travelled * dy - view.y as f32;
                if x <= -1.0 || y <= -1.0 || x >= w as f32 || y >= h as f32 {
                    continue;
                }
                let (left, top) = (x.floor(), y.floor());
                let (fx, fy) = (x - left, y - top);
                for (column, sx) in [(left, 1.0 - fx), (left + 1.0, fx)] {
                    for (row, sy) in [(top, 1.0 - fy), (top + 1.0, fy)] {
                        let is_inside =
                            column >= 0.0 && row >= 0.0 && column < w as f32 && row < h as f32;
                        if !is_inside {
                            continue;
                        }
                        let arrived = &mut arrivals[row as usize * w + column as usize];
                        let sum = match sight {
                            Sight::Both => &mut arrived.both,
                            _ => &mut arrived.one[index],
                        };
                        sum.add(trust * sx * sy, [sign * dx, sign * dy]);
                    }
                }
            }
        }
    }
}

/// Displacements that arrived at one pixel, all counted from the first frame to the second.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Arrivals {
    both: Sum,
    /// Of what the first frame alone sees, and the second.
    one: [Sum; 2],
}

#[derive(Debug, Clone, Copy, Default)]
struct Sum {
    weight: f32,
    of: [f32; 2],
}

impl Sum {
    fn add(&mut self, weight: f32, [dx, dy]: [f32; 2]) {
        self.weight += weight;
        self.of[0] += weight * dx;
        self.of[1] += weight * dy;
    }

    fn mean(&self) -> Option<[f32; 2]> {
        (self.weight > 1e-6).then(|| self.of.map(|sum| sum / self.weight))
    }
}

/// Where a pixel ends up, if that is inside.
fn landing(flow: &OpticalFlow, cell: usize) -> Option<Corners> {
    let (w, h) = flow.size();
    let x = (cell % w) as f32 + flow.dx.values[cell];
    let y = (cell / w) as f32 + flow.dy.values[cell];
    let is_inside = (0.0..=(w - 1) as f32).contains(&x) && (0.0..=(h - 1) as f32).contains(&y);
    is_inside.then(|| Corners::around(x, y, w, h))
}

/// Pixels whose way there and back ends where it began (bounds: Sundaram, Brox, Keutzer, 2010).
fn agreeing(flow: &OpticalFlow, back: &OpticalFlow) -> Vec<bool> {
    let agrees = |cell: usize| {
        let Some(corners) = landing(flow, cell) else {
            return false;
        };
        let (dx, dy) = (flow.dx.values[cell], flow.dy.values[cell]);
        let (bx, by) = (corners.of(&back.dx.values), corners.of(&back.dy.values));
        let square = |x: f32, y: f32| x * x + y * y;
        square(dx + bx, dy + by) <= 0.01 * (square(dx, dy) + square(bx, by)) + 0.5
    };
    (0..flow.dx.values.len()).map(agrees).collect()
}

/// A pixel that does not agree is hidden where it lands on one that does; else nothing is known.
fn sight(flow: &OpticalFlow, agrees: &[bool], other_agrees: &[bool]) -> Vec<Sight> {
    let of = |(cell, agrees): (usize, &bool)| match landing(flow, cell) {
        _ if *agrees => Sight::Both,
        None => Sight::Here,
        Some(corners) if other_agrees[corners.nearest()] => Sight::Here,
        Some(_) => Sight::Lost,
    };
    agrees.iter().enumerate().map(of).collect()
}

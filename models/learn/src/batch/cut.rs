//! Which part of an example enters a batch and what is done to it, and what comes of it.

use noctule_depth::Ground;
use noctule_world::STEPS;

use super::crop::Crop;
use super::vary::{self, Purpose, Vary};
use crate::cache::Example;
use crate::chance::Chance;
use crate::settings::{Augment, Domain};

/// Exponent of the world's encoding.
pub(crate) const GAMMA: f32 = 2.2;
/// Weights of red, green and blue in grey (paper, eq. 10).
pub(crate) const GREY: [f32; 3] = [0.299, 0.587, 0.114];

/// Which part of an example is taken and what is done to it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Cut {
    pub crop: Crop,
    /// First step and number of steps.
    pub window: (usize, usize),
    pub event_drop: f64,
    pub event_noise: f64,
    pub return_drop: f64,
    pub gain: f64,
    pub vary: Vary,
}

impl Cut {
    /// The whole example as it is.
    pub(super) fn whole(size: usize) -> Self {
        Self {
            crop: Crop {
                x0: 0,
                y0: 0,
                span: size,
                side: size,
                flip: false,
            },
            window: (0, STEPS),
            event_drop: 0.0,
            event_noise: 0.0,
            return_drop: 0.0,
            gain: 1.0,
            vary: Vary::NONE,
        }
    }

    /// A random one; every setting draws, whether it varies or not, so that turning one on does
    /// not move the others. Changes to sensors and the zoom draw from chances of their own, which
    /// `chance` starts and does not notice.
    pub(super) fn random(
        augment: &Augment,
        size: usize,
        side: usize,
        window: (usize, usize),
        chance: &mut Chance,
    ) -> Self {
        let [low, high] = augment.gain;
        let key = chance.clone().word();
        let (x0, y0) = (chance.below(size - side + 1), chance.below(size - side + 1));
        let flip = chance.happens(augment.flip);
        let plain = Crop {
            x0,
            y0,
            span: side,
            side,
            flip,
        };
        Self {
            crop: enlarged(augment, size, side, key).map_or(plain, |(x0, y0, span)| Crop {
                x0,
                y0,
                span,
                ..plain
            }),
            window,
            event_drop: chance.between(0.0, augment.event_drop_max),
            event_noise: chance.between(0.0, augment.event_noise_max),
            return_drop: chance.between(0.0, augment.return_drop_max),
            gain: chance.between(low.ln(), high.ln()).exp(),
            vary: Vary::random(augment, key),
        }
    }

    /// Moves the square over an outline of what moves on its own, where that is drawn and there is
    /// one: each row of an outline is as likely, and it comes to lie in the middle half if it can.
    pub(super) fn over_movers(&mut self, example: &Example, probability: f64) {
        let mut chance = vary::of(self.vary.key, Purpose::Movers);
        if !chance.happens(probability) {
            return;
        }
        let (size, (first, steps)) = (example.size, self.window);
        let area = size * size;
        let is_end =
            |i: &usize| !i.is_multiple_of(size) && example.movers[i - 1] != example.movers[*i];
        let outline: Vec<usize> = (first * area..(first + steps) * area)
            .filter(is_end)
            .collect();
        if outline.is_empty() {
            return;
        }
        let at = outline[chance.below(outline.len())];
        let span = self.crop.span;
        let mut start = |at: usize| {
            let before = span / 4 + chance.below(span.div_ceil(2));
            at.saturating_sub(before).min(size - span)
        };
        (self.crop.x0, self.crop.y0) = (start(at % size), start(at % area / size));
    }

    /// The example's ground in the cut's own pixels, as the network is told of it.
    pub(super) fn ground(&self, ground: Option<&Ground>) -> Option<Ground> {
        let told = self.vary.ground(ground)?;
        Some(self.crop.ground(&told))
    }
}

/// Corner and side of a smaller square, where the zoom is drawn.
fn enlarged(
    augment: &Augment,
    size: usize,
    side: usize,
    key: u64,
) -> Option<(usize, usize, usize)> {
    let mut chance = vary::of(key, Purpose::Zoom);
    let is_drawn = chance.happens(augment.zoom);
    let factor = chance.between(0.0, augment.zoom_max.ln()).exp();
    let span = (side as f64 / factor).round() as usize;
    let span = span.clamp(1, side);
    let (x0, y0) = (chance.below(size - span + 1), chance.below(size - span + 1));
    is_drawn.then_some((x0, y0, span))
}

/// What a batch needs beside the network's inputs and the depth truth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Wanted {
    /// Sharp pictures and the grey that events imply; how the latter is averaged, and the contrast.
    pub pictures: Option<(Domain, f64)>,
    /// The band around depth edges.
    pub edges: bool,
    /// What moves on its own.
    pub movers: bool,
}

/// A cut of one example, one vector per field, row-major.
#[derive(Debug, Default, Clone, PartialEq)]
pub(super) struct Piece {
    /// `[3, H, W]`
    pub blur: Vec<f32>,
    /// From the start of the exposure, `[first + n, BINS, H, W]`
    pub voxel: Vec<f32>,
    /// `[n, 1, H, W]`
    pub sparse: Vec<f32>,
    /// `[n, 1, H, W]`
    pub depth: Vec<f32>,
    /// `[n, 3, H, W]`
    pub sharp: Vec<f32>,
    /// `[n, 1, H, W]`
    pub event_grey: Vec<f32>,
    /// `[n, 1, H, W]`
    pub edges: Vec<f32>,
    /// `[n, 1, H, W]`
    pub movers: Vec<f32>,
}

//! One exposure's frames in memory, before squares are cut out of them.

use noctule_depth::{Canvas, Size};

use super::{Clip, KittiClips, Part, SQUARE};
use crate::cache::error::CacheError;
use crate::chance::Chance;
use crate::clip::{PERIOD_US, rings_apart};
use crate::read::Window;
use crate::synth::Footage;

/// Rows above the squares from which flow is known too.
const MARGIN: usize = 64;

/// One exposure's frames, in memory.
pub(super) struct Scene {
    /// Of the pictures.
    pub(super) size: Size,
    /// Of the squares.
    pub(super) square: Size,
    pub(super) footage: Footage,
    /// Rows of the footage above the squares.
    pub(super) above: usize,
    /// First row of the squares.
    pub(super) top: usize,
    /// Frames of the footage before the first.
    pub(super) before: u32,
    /// Of each frame, for each phase: what is given and what is truth.
    pub(super) depth: Vec<Vec<[Vec<f32>; 2]>>,
}

impl Scene {
    pub(super) fn read(
        clips: &KittiClips,
        clip: &Clip,
        side: usize,
        fault: &dyn Fn(String) -> CacheError,
    ) -> Result<Self, CacheError> {
        let (drive, frames) = (&clip.drive, clip.frames);
        let has = |frame: u32| {
            let [first, last] = clips.seen;
            (first..=last).contains(&frame) && drive.pictures().binary_search(&frame).is_ok()
        };
        let before = u32::from(frames.first > 0 && has(frames.first - 1));
        let after = u32::from(has(frames.end()));
        let numbers = frames.first - before..frames.end() + after;
        let pictures: Vec<Canvas> = numbers
            .map(|frame| drive.picture(frame))
            .collect::<Result<_, _>>()?;
        let (width, height) = (pictures[0].width(), pictures[0].height());
        let odd = |picture: &&Canvas| (picture.width(), picture.height()) != (width, height);
        if let Some(odd) = pictures.iter().find(odd) {
            let (w, h) = (odd.width(), odd.height());
            return Err(fault(format!(
                "pictures of {width}x{height} and {w}x{h} pixels"
            )));
        }
        let room = || {
            fault(format!(
                "pictures of {width}x{height} have no room for {side}x{side}"
            ))
        };
        let y = height
            .checked_sub(side)
            .filter(|_| width >= side)
            .ok_or_else(room)?;
        let top = y.saturating_sub(MARGIN);
        let whole = |width, height| Size::new(width, height).map_err(|e| fault(e.to_string()));
        let strip = Window {
            x: 0,
            y: top,
            size: whole(width, height - top)?,
        };
        let parts: Option<Vec<Vec<u8>>> = pictures
            .iter()
            .map(|picture| strip.of_picture(picture))
            .collect();
        let parts = parts.ok_or_else(room)?;
        let footage = Footage::from_srgb(parts.iter().map(Vec::as_slice), strip.size, PERIOD_US);
        let size = whole(width, height)?;
        let depth = (frames.first..frames.end()).map(|frame| {
            let scan = drive.scan(frame)?;
            let apart = |phase| rings_apart(&scan, drive.calibration(), size, phase);
            Ok(clips.phases().map(apart).collect())
        });
        Ok(Self {
            size,
            square: whole(side, side)?,
            footage: footage.map_err(|e| fault(e.to_string()))?,
            above: y - top,
            top: y,
            before,
            depth: depth.collect::<Result<_, CacheError>>()?,
        })
    }

    /// First columns of the squares.
    pub(super) fn columns(
        &self,
        clips: &KittiClips,
        clip: &Clip,
    ) -> Result<Vec<usize>, CacheError> {
        let (width, side) = (self.size.width(), self.square.width());
        match clips.part {
            Part::Train => {
                let first = u64::from(clip.frames.first);
                let column = |cut: usize| {
                    // Spread evenly, and moved by chance within each share.
                    let share = Chance::of(&[SQUARE, first, cut as u64]).unit();
                    ((cut as f64 + share) / clips.cuts as f64 * (width - side + 1) as f64) as usize
                };
                Ok((0..clips.cuts).map(column).collect())
            }
            Part::Validation => {
                let squares = Window::squares(width, self.size.height(), side);
                let squares = squares.ok_or_else(|| CacheError::Drive {
                    drive: clip.drive.name().to_owned(),
                    fault: format!("pictures of {width} columns have no room for {side}"),
                })?;
                Ok(squares.map(|square| square.x).to_vec())
            }
        }
    }

    /// What is given and what is truth at each step of the square at column `x`: a step without a
    /// scan of its own is given the newest, and has no truth.
    pub(super) fn steps(
        &self,
        clips: &KittiClips,
        clip: &Clip,
        x: usize,
        phase: u8,
    ) -> Option<[Vec<f32>; 2]> {
        let window = Window {
            x,
            y: self.size.height() - self.square.height(),
            size: self.square,
        };
        let (mut sparse, mut depth) = (Vec::new(), Vec::new());
        let [first, last] = clips.scored;
        let steps = clip.frames.steps_per_frame();
        let area = self.square.pixels();
        for (frame, phases) in (clip.frames.first..).zip(&self.depth) {
            let [given, truth] = &phases[usize::from(phase)];
            let given = window.of_map(given, self.size.width())?;
            sparse.extend(given.repeat(steps));
            match (first..=last).contains(&frame) {
                true => depth.extend(window.of_map(truth, self.size.width())?),
                false => depth.extend(vec![0.0; area]),
            }
            depth.extend(vec![0.0; (steps - 1) * area]);
        }
        Some([sparse, depth])
    }
}

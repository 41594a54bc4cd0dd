//! Runs of KITTI's frames as exposures of eight steps: which, when they open, and what is given and
//! what is truth at each step. Training and evaluation share these rules.

use noctule_depth::{DepthImage, Size};
use noctule_world::STEPS;

use crate::read::{Calibration, Drive, ScanPoint, rings_by_elevation, sparse_depth};

/// One ring of so many is given, the others are truth.
pub(crate) const RING_STRIDE: u8 = 4;
/// Drives of fewer frames are clips.
pub(crate) const LONG: usize = 32;
/// Frames of a clip that are left to training; the others are scored on.
pub(crate) const CLIP_SKIP: u32 = 8;
/// Frames of a clip that make one exposure.
const CLIP_FRAMES: u32 = 4;
/// KITTI's nominal frame period, microseconds.
pub(crate) const PERIOD_US: f64 = 100_000.0;

/// Consecutive frames that make one exposure.
///
/// Step centres lie on frames, or, of a clip, on frames and half-way between. The exposure reaches
/// half a step beyond the outer centres.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Frames {
    /// The frame of the first step.
    pub first: u32,
    /// Eight, or four of a clip.
    pub count: u32,
}

impl Frames {
    /// One beyond the last; the light after the last centre comes from it.
    pub(crate) fn end(self) -> u32 {
        self.first + self.count
    }

    pub(crate) fn steps_per_frame(self) -> usize {
        STEPS / self.count as usize
    }

    /// When the exposure opens and closes, in frames, where the light counts from `before` frames
    /// before the first.
    pub(crate) fn span(self, before: u32) -> (f64, f64) {
        let step = f64::from(self.count) / STEPS as f64;
        let open = f64::from(before) - 0.5 * step;
        (open, open + f64::from(self.count))
    }
}

/// Frames that have both a picture and a scan.
pub(crate) fn scanned(drive: &Drive) -> Vec<u32> {
    let has_picture = |frame: &u32| drive.pictures().binary_search(frame).is_ok();
    drive.scans().iter().copied().filter(has_picture).collect()
}

/// Exposures of a drive's `scanned` frames: of a long drive runs of eight that share no frame, of a
/// clip every run of four.
pub(crate) fn exposures(scanned: &[u32], is_long: bool) -> Vec<Frames> {
    match is_long {
        true => runs(scanned, STEPS as u32),
        false => {
            let count = CLIP_FRAMES;
            let is_whole = |first: &u32| {
                let has = |frame: u32| scanned.binary_search(&frame).is_ok();
                let mut wanted = (0..count).map(|k| first.checked_add(k));
                ends(*first, count) && wanted.all(|frame| frame.is_some_and(has))
            };
            let starts = scanned.iter().copied().filter(is_whole);
            starts.map(|first| Frames { first, count }).collect()
        }
    }
}

/// Runs of `count` consecutive frames that share none.
pub(crate) fn runs(frames: &[u32], count: u32) -> Vec<Frames> {
    let mut found = Vec::new();
    let mut rest = frames;
    while let Some(&first) = rest.first() {
        let run = (0..count)
            .zip(rest)
            .take_while(|(k, frame)| first.checked_add(*k) == Some(**frame));
        let run = run.count();
        if run == count as usize && ends(first, count) {
            found.push(Frames { first, count });
        }
        rest = &rest[run..];
    }
    found
}

/// Whether one beyond the last is a number.
fn ends(first: u32, count: u32) -> bool {
    first.checked_add(count).is_some()
}

/// Splits a scan into what is given and what is scored: maps of every fourth ring, and of the
/// others where none of the fourth fell.
pub fn held_out(
    scan: &[ScanPoint],
    calibration: &Calibration,
    size: Size,
) -> (DepthImage, DepthImage) {
    let image = |depth_m| DepthImage {
        width: size.width(),
        height: size.height(),
        depth_m,
    };
    let [given, truth] = rings_apart(scan, calibration, size, 0);
    (image(given), image(truth))
}

/// As [`held_out`], given the fourth rings counted from ring `phase`, below [`RING_STRIDE`].
pub(crate) fn rings_apart(
    scan: &[ScanPoint],
    calibration: &Calibration,
    size: Size,
    phase: u8,
) -> [Vec<f32>; 2] {
    let rings = rings_by_elevation(scan);
    let map = |is_given: bool| {
        let points = scan.iter().zip(&rings);
        let points = points.filter(|(_, ring)| (**ring % RING_STRIDE == phase) == is_given);
        sparse_depth(points.map(|(point, _)| point), calibration, size)
    };
    let (given, mut truth) = (map(true), map(false));
    for (truth, given) in truth.iter_mut().zip(&given) {
        if *given > 0.0 {
            *truth = 0.0;
        }
    }
    [given, truth]
}

//! KITTI as exposures with truth: windows of frames, blurred and made events of.
//!
//! Which of three ways a folder is scored by follows from what lies in it:
//!
//! - a selection (`image`, `velodyne_raw`, `groundtruth_depth`): single frames. Nothing moves in
//!   a single frame, so the picture is its own blur, there are no events, and all eight steps see
//!   and are scored on the same;
//! - benchmark drives with ground truth: windows of eight frames of the part `val`, projected
//!   scans in, accumulated ground truth against;
//! - raw drives: every fourth of 64 rings in, the returns of the others against. A drive of fewer
//!   than [`LONG`] frames is a clip, of which the first [`CLIP_SKIP`] frames are left to training:
//!   windows of four frames are made eight steps, and only steps that were scanned are scored.
//!
//! Every window gives three exposures: left, centre and right at the bottom of the picture.

use std::path::Path;

use noctule_depth::{DepthImage, Ground, Size};
use noctule_world::STEPS;

use super::error::EvalError;
use super::scene::{Scene, Scenes, voxels};
use crate::clip::{CLIP_SKIP, Frames, LONG, PERIOD_US, exposures, held_out, runs, scanned};
use crate::read::{
    BenchmarkDrive, ColourCamera, Drive, ReadError, Selection, Split, Window, benchmark_drives,
    is_validation_drive, raw_drives,
};
use crate::score::DEPTH_CAP_M;
use crate::synth::{Footage, Synthesis, expose};

/// Side of the squares that are scored, pixels.
const SIDE: usize = 256;
/// Squares of one picture.
const SQUARES: usize = 3;
/// Pixels around a square from which flow is known too.
const MARGIN: usize = 64;
/// A folder of KITTI, ready to be scored on.
#[derive(Debug, Clone)]
pub struct KittiScenes {
    source: Source,
}

#[derive(Debug, Clone)]
enum Source {
    Selection(Selection),
    Benchmark(Vec<BenchmarkDrive>, Vec<Place>),
    Raw(Vec<Drive>, Vec<Place>),
}

/// A window of a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Place {
    drive: usize,
    frames: Frames,
}

impl KittiScenes {
    /// Finds what can be scored at `root`.
    ///
    /// # Errors
    /// [`ReadError`], when a layout is begun and not complete, or nothing can be scored.
    pub fn open(root: &Path) -> Result<Self, ReadError> {
        let camera = ColourCamera::Left;
        if Selection::is_at(root) {
            let selection = Selection::open(root)?;
            return Self::nonempty(root, selection.len(), Source::Selection(selection));
        }
        let benchmark = benchmark_drives(root, Split::Validation, camera)?;
        if !benchmark.is_empty() {
            let mut places = Vec::new();
            for (drive, held) in benchmark.iter().enumerate() {
                places.extend(of_drive(drive, runs(held.frames(), STEPS as u32)));
            }
            return Self::nonempty(root, places.len(), Source::Benchmark(benchmark, places));
        }
        let mut drives = raw_drives(root, camera)?;
        if drives.iter().any(|drive| is_validation_drive(drive.name())) {
            drives.retain(|drive| is_validation_drive(drive.name()));
        }
        let places: Vec<Place> = (0..)
            .zip(&drives)
            .flat_map(|(i, drive)| of_raw(i, drive))
            .collect();
        Self::nonempty(root, places.len(), Source::Raw(drives, places))
    }

    fn nonempty(root: &Path, count: usize, source: Source) -> Result<Self, ReadError> {
        match count {
            0 => Err(ReadError::Missing {
                path: root.into(),
                wanted: "frames to score on".into(),
            }),
            _ => Ok(Self { source }),
        }
    }
}

/// Windows of one raw drive.
fn of_raw(index: usize, drive: &Drive) -> Vec<Place> {
    let scanned = scanned(drive);
    let is_long = scanned.len() >= LONG;
    let mut found = exposures(&scanned, is_long);
    if !is_long {
        // A window of a clip closes between its last frame and the next.
        found.retain(|frames| {
            let closes = drive.pictures().binary_search(&frames.end()).is_ok();
            frames.first >= CLIP_SKIP && closes
        });
    }
    of_drive(index, found)
}

fn of_drive(drive: usize, frames: Vec<Frames>) -> Vec<Place> {
    let place = |frames| Place { drive, frames };
    frames.into_iter().map(place).collect()
}

impl Scenes for KittiScenes {
    fn count(&self) -> usize {
        SQUARES
            * match &self.source {
                Source::Selection(selection) => selection.len(),
                Source::Benchmark(_, places) | Source::Raw(_, places) => places.len(),
            }
    }

    fn scene(&self, index: usize) -> Result<Scene, EvalError> {
        let (place, square) = (index / SQUARES, index % SQUARES);
        match &self.source {
            Source::Selection(selection) => selected(selection, place, square),
            Source::Benchmark(drives, places) => {
                let place = places[place];
                let drive = &drives[place.drive];
                let pictures = Pictures {
                    name: drive.name(),
                    has: &|frame| drive.has_picture(frame),
                    read: &|frame| drive.picture(frame),
                    ground: None,
                };
                let depth = |frame| Ok((drive.sparse(frame)?, drive.truth(frame)?));
                moving(place.frames, square, index, &pictures, &depth)
            }
            Source::Raw(drives, places) => {
                let place = places[place];
                let drive = &drives[place.drive];
                let pictures = Pictures {
                    name: drive.name(),
                    has: &|frame| drive.pictures().binary_search(&frame).is_ok(),
                    read: &|frame| drive.picture(frame),
                    ground: drive.calibration().ground(),
                };
                let size = drive.picture(place.frames.first)?;
                let size = Size::new(size.width(), size.height())?;
                let depth = |frame| Ok(held_out(&drive.scan(frame)?, drive.calibration(), size));
                moving(place.frames, square, index, &pictures, &depth)
            }
        }
    }
}

/// A drive's pictures, wherever they lie.
struct Pictures<'a> {
    name: &'a str,
    has: &'a dyn Fn(u32) -> bool,
    read: &'a dyn Fn(u32) -> Result<noctule_depth::Canvas, ReadError>,
    /// In whole pictures.
    ground: Option<Ground>,
}

type Depth<'a> = &'a dyn Fn(u32) -> Result<(DepthImage, DepthImage), ReadError>;

/// A window of frames as one exposure.
///
/// A step without a scan of its own sees the newest one and is not scored. Light beyond the outer
/// centres comes from the neighbouring frames, where the drive has them.
fn moving(
    frames: Frames,
    square: usize,
    seed: usize,
    pictures: &Pictures<'_>,
    depth: Depth<'_>,
) -> Result<Scene, EvalError> {
    let name = format!(
        "{}:{}:{}",
        pictures.name,
        frames.first,
        ["left", "centre", "right"][square]
    );
    let fault = |fault: String| EvalError::Scene {
        scene: name.clone(),
        fault,
    };
    let (first, last) = (frames.first, frames.end());
    let before = u32::from(first > 0 && (pictures.has)(first - 1));
    let after = u32::from((pictures.has)(last));
    let (mut parts, mut whole) = (Vec::new(), None);
    for frame in first - before..last + after {
        let picture = (pictures.read)(frame)?;
        let size = (picture.width(), picture.height());
        let around = square_of(size, square).and_then(|w| w.grown(MARGIN, size.0, size.1));
        let part = around.and_then(|around| around.of_picture(&picture));
        let part = part.ok_or_else(|| fault(too_small(size)))?;
        if *whole.get_or_insert(size) != size {
            return Err(fault(format!(
                "frame {frame} is {}x{}, others are not",
                size.0, size.1
            )));
        }
        parts.push(part);
    }
    let size = whole.unwrap_or_default();
    let window = square_of(size, square).ok_or_else(|| fault(too_small(size)))?;
    let around = window.grown(MARGIN, size.0, size.1);
    let around = around.ok_or_else(|| fault(too_small(size)))?;
    let footage = Footage::from_srgb(parts.iter().map(Vec::as_slice), around.size, PERIOD_US)
        .and_then(|whole| whole.seen_through(window.x - around.x, window.y - around.y, window.size))
        .map_err(|e| fault(e.to_string()))?;
    let (open, close) = frames.span(before);
    let recipe = Synthesis::of_seed(seed as u64);
    let exposed = expose(&footage, open, close, &recipe).map_err(|e| fault(e.to_string()))?;
    let (mut sparse, mut truth) = (Vec::new(), Vec::new());
    let steps_per_frame = frames.steps_per_frame();
    for frame in first..last {
        let (given, scored) = depth(frame)?;
        let cut = |map: &DepthImage| {
            let fits = (map.width, map.height) == size;
            let part = fits
                .then(|| window.of_map(&map.depth_m, map.width))
                .flatten();
            part.ok_or_else(|| {
                fault(format!(
                    "depth of frame {frame} is {}x{}, its picture {}x{}",
                    map.width, map.height, size.0, size.1
                ))
            })
        };
        let (given, scored) = (cut(&given)?, cut(&scored)?);
        sparse.extend(given.repeat(steps_per_frame));
        truth.extend(scored);
        truth.extend(vec![0.0; (steps_per_frame - 1) * window.size.pixels()]);
    }
    let voxel = voxels(&exposed.events, exposed.exposure_us, window.size);
    Ok(Scene {
        size: window.size,
        blur: encoded(&exposed.blur),
        voxel: voxel.map_err(|e| fault(e.to_string()))?,
        sparse,
        ground: pictures.ground.map(|g| g.cut(window.x, window.y)),
        depth: truth,
        movers: Vec::new(),
        thin: Vec::new(),
        flow: Vec::new(),
        cap_m: DEPTH_CAP_M,
        name,
    })
}

/// A single frame as an exposure of a world that stands still.
fn selected(selection: &Selection, index: usize, square: usize) -> Result<Scene, EvalError> {
    let frame = selection.read(index)?;
    let name = format!(
        "{}:{}",
        selection.name(index).unwrap_or_default(),
        ["left", "centre", "right"][square]
    );
    let fault = |fault: String| EvalError::Scene {
        scene: name.clone(),
        fault,
    };
    let size = (frame.picture.width(), frame.picture.height());
    let window = square_of(size, square).ok_or_else(|| fault(too_small(size)))?;
    let part = |map: &DepthImage| {
        let part = window.of_map(&map.depth_m, map.width);
        part.map(|part| part.repeat(STEPS))
            .ok_or_else(|| fault(too_small(size)))
    };
    let picture = window
        .of_picture(&frame.picture)
        .ok_or_else(|| fault(too_small(size)))?;
    let truth = frame
        .truth
        .as_ref()
        .ok_or_else(|| fault("has no groundtruth_depth to score on".into()))?;
    let plane = |channel: usize| picture.iter().skip(channel).step_by(3).copied();
    let planes: Vec<u8> = (0..3).flat_map(plane).collect();
    let voxel = voxels(&[], PERIOD_US as u32, window.size);
    Ok(Scene {
        size: window.size,
        blur: encoded(&planes),
        voxel: voxel.map_err(|e| fault(e.to_string()))?,
        sparse: part(&frame.sparse)?,
        ground: frame.ground().map(|g| g.cut(window.x, window.y)),
        depth: part(truth)?,
        movers: Vec::new(),
        thin: Vec::new(),
        flow: Vec::new(),
        cap_m: DEPTH_CAP_M,
        name,
    })
}

fn square_of((width, height): (usize, usize), square: usize) -> Option<Window> {
    Window::squares(width, height, SIDE).map(|squares| squares[square])
}

fn too_small((width, height): (usize, usize)) -> String {
    format!("pictures of {width}x{height} pixels have no room for {SIDE}x{SIDE}")
}

fn encoded(codes: &[u8]) -> Vec<f32> {
    codes.iter().map(|&code| f32::from(code) / 255.0).collect()
}

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

use noctule_depth::{DepthImage, Size};
use noctule_world::STEPS;

use super::error::EvalError;
use super::scene::{Scene, Scenes, voxels};
use crate::read::{
    BenchmarkDrive, Calibration, ColourCamera, Drive, ReadError, ScanPoint, Selection, Split,
    Window, benchmark_drives, is_validation_drive, raw_drives, rings_by_elevation, sparse_depth,
};
use crate::score::DEPTH_CAP_M;
use crate::synth::{Footage, Synthesis, expose};

/// Side of the squares that are scored, pixels.
const SIDE: usize = 256;
/// Squares of one picture.
const SQUARES: usize = 3;
/// One ring of so many is kept.
const RING_STRIDE: u8 = 4;
/// Raw drives of fewer frames are clips.
const LONG: usize = 32;
/// Frames of a clip that are left to training.
const CLIP_SKIP: u32 = 8;
/// Frames of a clip that make one window.
const CLIP_FRAMES: u32 = 4;
/// KITTI's nominal frame period, microseconds.
const PERIOD_US: f64 = 100_000.0;

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
    first: u32,
    /// Frames it spans: eight, or four of a clip.
    frames: u32,
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
                places.extend(windows(drive, held.frames(), STEPS as u32));
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
    let scanned: Vec<u32> = drive
        .scans()
        .iter()
        .copied()
        .filter(|frame| drive.pictures().binary_search(frame).is_ok())
        .collect();
    if scanned.len() >= LONG {
        return windows(index, &scanned, STEPS as u32);
    }
    // A window of a clip closes between its last frame and the next.
    let starts = scanned.iter().filter(|first| **first >= CLIP_SKIP);
    let is_whole = |first: &u32| {
        let all = |frames: &[u32], count: u32| {
            (0..count).all(|k| frames.binary_search(&first.saturating_add(k)).is_ok())
        };
        all(&scanned, CLIP_FRAMES) && all(drive.pictures(), CLIP_FRAMES + 1)
    };
    let starts = starts.copied().filter(is_whole);
    let place = |first| Place {
        drive: index,
        first,
        frames: CLIP_FRAMES,
    };
    starts.map(place).collect()
}

/// Runs of `len` consecutive frames that share none.
fn windows(drive: usize, frames: &[u32], len: u32) -> Vec<Place> {
    let mut found = Vec::new();
    let mut rest = frames;
    while let Some(&first) = rest.first() {
        let run = (0..len)
            .zip(rest)
            .take_while(|(k, frame)| first.checked_add(*k) == Some(**frame));
        let run = run.count();
        if run == len as usize {
            found.push(Place {
                drive,
                first,
                frames: len,
            });
        }
        rest = &rest[run..];
    }
    found
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
                };
                let depth = |frame| Ok((drive.sparse(frame)?, drive.truth(frame)?));
                moving(place, square, index, &pictures, &depth)
            }
            Source::Raw(drives, places) => {
                let place = places[place];
                let drive = &drives[place.drive];
                let pictures = Pictures {
                    name: drive.name(),
                    has: &|frame| drive.pictures().binary_search(&frame).is_ok(),
                    read: &|frame| drive.picture(frame),
                };
                let size = drive.picture(place.first)?;
                let size = Size::new(size.width(), size.height())?;
                let depth = |frame| Ok(held_out(&drive.scan(frame)?, drive.calibration(), size));
                moving(place, square, index, &pictures, &depth)
            }
        }
    }
}

/// Splits a scan into what is given and what is scored: maps of every fourth ring, and of the
/// others where none of the fourth fell.
pub fn held_out(
    scan: &[ScanPoint],
    calibration: &Calibration,
    size: Size,
) -> (DepthImage, DepthImage) {
    let rings = rings_by_elevation(scan);
    let map = |is_kept: bool| {
        let points = scan.iter().zip(&rings);
        let points = points.filter(|(_, ring)| (**ring % RING_STRIDE == 0) == is_kept);
        sparse_depth(points.map(|(point, _)| point), calibration, size)
    };
    let (sparse, mut truth) = (map(true), map(false));
    for (truth, sparse) in truth.iter_mut().zip(&sparse) {
        if *sparse > 0.0 {
            *truth = 0.0;
        }
    }
    let image = |depth_m| DepthImage {
        width: size.width(),
        height: size.height(),
        depth_m,
    };
    (image(sparse), image(truth))
}

/// A drive's pictures, wherever they lie.
struct Pictures<'a> {
    name: &'a str,
    has: &'a dyn Fn(u32) -> bool,
    read: &'a dyn Fn(u32) -> Result<noctule_depth::Canvas, ReadError>,
}

type Depth<'a> = &'a dyn Fn(u32) -> Result<(DepthImage, DepthImage), ReadError>;

/// A window of frames as one exposure.
///
/// Step centres lie on frames, or, of a clip, on frames and half-way between; a step without a scan
/// of its own sees the newest one and is not scored. The exposure reaches half a step beyond the
/// outer centres; light there comes from the neighbouring frames, where the drive has them.
fn moving(
    place: Place,
    square: usize,
    seed: usize,
    pictures: &Pictures<'_>,
    depth: Depth<'_>,
) -> Result<Scene, EvalError> {
    let name = format!(
        "{}:{}:{}",
        pictures.name,
        place.first,
        ["left", "centre", "right"][square]
    );
    let fault = |fault: String| EvalError::Scene {
        scene: name.clone(),
        fault,
    };
    let before = u32::from(place.first > 0 && (pictures.has)(place.first - 1));
    let last = place.first + place.frames; // one beyond, for the light after the last centre
    let after = u32::from((pictures.has)(last));
    let (mut parts, mut whole) = (Vec::new(), None);
    for frame in place.first - before..last + after {
        let picture = (pictures.read)(frame)?;
        let size = (picture.width(), picture.height());
        let part = square_of(size, square).and_then(|window| window.of_picture(&picture));
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
    let footage = Footage::from_srgb(parts.iter().map(Vec::as_slice), window.size, PERIOD_US);
    let footage = footage.map_err(|e| fault(e.to_string()))?;
    let step = f64::from(place.frames) / STEPS as f64;
    let open = f64::from(before) - 0.5 * step;
    let exposed = expose(
        &footage,
        open,
        open + f64::from(place.frames),
        &Synthesis::of_seed(seed as u64),
    )
    .map_err(|e| fault(e.to_string()))?;
    let (mut sparse, mut truth) = (Vec::new(), Vec::new());
    let steps_per_frame = STEPS / place.frames as usize;
    for frame in place.first..last {
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

//! Real drives as examples: runs of KITTI's frames, blurred, made events of, and kept in shards.
//!
//! A shard holds one exposure's squares. Its path names what its content depends on: a fingerprint
//! of the synthesis, of the drives' calibration and first scans, and of what was asked for.

use std::fmt::Write as _;
use std::fs;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

use noctule_depth::{Canvas, Size};
use noctule_world::STEPS;
use rayon::prelude::*;
use sha2::{Digest, Sha256};

use super::error::CacheError;
use super::example::{Example, Origin};
use super::shard::{self, Shard};
use super::{Cache, Examples, Prepared};
use crate::chance::Chance;
use crate::clip::{
    CLIP_SKIP, Frames, LONG, PERIOD_US, RING_STRIDE, exposures, rings_apart, scanned,
};
use crate::read::{ColourCamera, Drive, Window, is_validation_drive, raw_drives};
use crate::settings::KittiDrives;
use crate::synth::{Footage, InBetween, Synthesis, expose};

/// Salt of columns and nights of the squares.
const SQUARE: u64 = 0x006b_6974_7469;
/// Squares of an exposure that is validated on, as evaluation has them.
const VALIDATION_SQUARES: usize = 3;
/// Rows above the squares from which flow is known too.
const MARGIN: usize = 64;

/// What real exposures are for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// Squares at random columns, every ring of four given once.
    Train,
    /// Evaluation's three squares and rings; only held frames are scored.
    Validation,
}

/// The exposures that settings ask real drives for.
#[derive(Debug, Clone)]
pub struct KittiClips {
    part: Part,
    cuts: usize,
    /// First and last frame whose light may be seen.
    seen: [u32; 2],
    /// First and last frame with truth.
    scored: [u32; 2],
    clips: Vec<Clip>,
    key: String,
}

#[derive(Debug, Clone)]
struct Clip {
    drive: Drive,
    frames: Frames,
}

impl KittiClips {
    /// Lists the exposures of one part; without frames to validate on, validation's is empty.
    ///
    /// # Errors
    /// [`CacheError::Read`] for drives that cannot be read, [`CacheError::Drive`] for one that is
    /// not there, must not be trained on, or has no whole exposure among the frames.
    pub fn open(settings: &KittiDrives, part: Part) -> Result<Self, CacheError> {
        let mut found = Self {
            part,
            cuts: match part {
                Part::Train => settings.cuts,
                Part::Validation => VALIDATION_SQUARES,
            },
            seen: settings.frames,
            scored: settings.frames,
            clips: Vec::new(),
            key: String::new(),
        };
        if part == Part::Validation {
            let Some(frames) = settings.validation else {
                return Ok(found);
            };
            (found.seen, found.scored) = ([0, frames[1]], frames);
        }
        let mut digest = Sha256::new();
        digest.update(fingerprint());
        for drive in allowed_drives(settings)? {
            let frames = found.frames_of(&drive)?;
            let first = frames.first().map(|frames| drive.scan(frames.first));
            let about = format!(
                "{} {:?} {:?} {:?} {:?}",
                drive.name(),
                drive.calibration(),
                drive.calibration().ground(),
                frames,
                first.transpose()?
            );
            digest.update(about);
            let clips = frames.into_iter().map(|frames| Clip {
                drive: drive.clone(),
                frames,
            });
            found.clips.extend(clips);
        }
        let about = format!(
            "{part:?} {} {:?} {:?}",
            found.cuts, found.seen, found.scored
        );
        digest.update(about);
        for byte in &digest.finalize()[..6] {
            write!(found.key, "{byte:02x}").expect("writing to a string cannot fail");
        }
        Ok(found)
    }

    /// How many examples they make.
    pub fn len(&self) -> usize {
        self.clips.len() * self.of_each()
    }

    /// Whether they make none.
    pub fn is_empty(&self) -> bool {
        self.clips.is_empty()
    }

    /// Examples of one exposure.
    fn of_each(&self) -> usize {
        self.cuts * self.phases().len()
    }

    fn phases(&self) -> std::ops::Range<u8> {
        match self.part {
            Part::Train => 0..RING_STRIDE,
            Part::Validation => 0..1,
        }
    }

    /// A drive's exposures.
    fn frames_of(&self, drive: &Drive) -> Result<Vec<Frames>, CacheError> {
        let fault = |fault: String| CacheError::Drive {
            drive: drive.name().to_owned(),
            fault,
        };
        let scanned = scanned(drive);
        let is_long = scanned.len() >= LONG;
        let [first, last] = self.scored;
        if !is_long && last >= CLIP_SKIP {
            return Err(fault(format!(
                "a clip of {} frames is scored on those from {CLIP_SKIP} on, asked for {first} to \
                 {last}",
                scanned.len()
            )));
        }
        let found = match self.part {
            Part::Train => {
                let inside = |frame: &u32| (first..=last).contains(frame);
                let inside: Vec<u32> = scanned.into_iter().filter(inside).collect();
                exposures(&inside, is_long)
            }
            Part::Validation => {
                // Those that end with the frames, and before that.
                let whole = exposures(&scanned, is_long);
                let count = if is_long {
                    STEPS as u32
                } else {
                    whole.first().map_or(1, |f| f.count)
                };
                let ends = (first..=last).rev().step_by(count as usize);
                let run = |end: u32| {
                    let first = (end + 1).checked_sub(count)?;
                    let mut wanted = first..=end;
                    let is_there = wanted.all(|frame| scanned.binary_search(&frame).is_ok());
                    is_there.then_some(Frames { first, count })
                };
                ends.filter_map(run).collect()
            }
        };
        match found.is_empty() {
            true => Err(fault(format!(
                "has no whole exposure in frames {first} to {last}"
            ))),
            false => Ok(found),
        }
    }

    /// All examples of one exposure, squares of `side` pixels.
    fn render(&self, clip: &Clip, side: usize) -> Result<Vec<Example>, CacheError> {
        let fault = |fault: String| CacheError::Drive {
            drive: format!("{}, frame {}", clip.drive.name(), clip.frames.first),
            fault,
        };
        let scene = Scene::read(self, clip, side, &fault)?;
        let squares = scene.columns(self, clip)?;
        let (open, close) = clip.frames.span(scene.before);
        // Once for all squares: the flow is theirs in common.
        let _ = scene.footage.light(0.5, InBetween::Moved);
        let made: Result<Vec<Vec<Example>>, CacheError> = (0_u64..)
            .zip(squares)
            .collect::<Vec<_>>()
            .into_par_iter()
            .map(|(cut, x)| {
                let wrong = |e: crate::synth::SynthError| fault(e.to_string());
                let seen = scene.footage.seen_through(x, scene.above, scene.square);
                let seed = Chance::of(&[SQUARE, u64::from(clip.frames.first), cut, 1]).word();
                let recipe = Synthesis::of_seed(seed);
                let seen = seen.map_err(wrong)?;
                let exposed = expose(&seen, open, close, &recipe).map_err(wrong)?;
                let of_phase = |phase: u8| -> Result<Example, CacheError> {
                    let number = cut * u64::from(RING_STRIDE) + u64::from(phase);
                    let [sparse, depth] = scene
                        .steps(self, clip, x, phase)
                        .ok_or_else(|| fault(format!("no map has {side} columns from {x} on")))?;
                    Ok(Example {
                        seed: number,
                        origin: Origin::Kitti,
                        size: side,
                        exposure_us: exposed.exposure_us,
                        ground: clip
                            .drive
                            .calibration()
                            .ground()
                            .map(|g| g.cut(x, scene.top)),
                        blur: exposed.blur.clone(),
                        events: exposed.events.clone(),
                        sparse,
                        depth,
                        sharp: exposed.sharp.clone(),
                        movers: vec![false; STEPS * side * side],
                        thin: vec![false; STEPS * side * side],
                    })
                };
                self.phases().map(of_phase).collect()
            })
            .collect();
        Ok(made?.into_iter().flatten().collect())
    }
}

/// One exposure's frames, in memory.
struct Scene {
    /// Of the pictures.
    size: Size,
    /// Of the squares.
    square: Size,
    footage: Footage,
    /// Rows of the footage above the squares.
    above: usize,
    /// First row of the squares.
    top: usize,
    /// Frames of the footage before the first.
    before: u32,
    /// Of each frame, for each phase: what is given and what is truth.
    depth: Vec<Vec<[Vec<f32>; 2]>>,
}

impl Scene {
    fn read(
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
    fn columns(&self, clips: &KittiClips, clip: &Clip) -> Result<Vec<usize>, CacheError> {
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
    fn steps(&self, clips: &KittiClips, clip: &Clip, x: usize, phase: u8) -> Option<[Vec<f32>; 2]> {
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

/// The drives of the settings that may be trained on.
fn allowed_drives(settings: &KittiDrives) -> Result<Vec<Drive>, CacheError> {
    let mut drives = raw_drives(&settings.root, ColourCamera::Left)?;
    for name in &settings.drives {
        let fault = match drives.iter().any(|drive| drive.name() == name) {
            false => format!("is not in {}", settings.root.display()),
            true if is_validation_drive(name) => "is held back from training".to_owned(),
            true => continue,
        };
        let drive = name.clone();
        return Err(CacheError::Drive { drive, fault });
    }
    drives.retain(|drive| match settings.drives.is_empty() {
        true => !is_validation_drive(drive.name()),
        false => settings.drives.iter().any(|name| name == drive.name()),
    });
    match drives.is_empty() {
        true => Err(CacheError::Drive {
            drive: settings.root.display().to_string(),
            fault: "all drives are held back from training".to_owned(),
        }),
        false => Ok(drives),
    }
}

/// Changes when the synthesis makes anything otherwise: an exposure of a small moving pattern.
fn fingerprint() -> Vec<u8> {
    let size = Size::new(32, 24).expect("a size");
    let frame = |shift: usize| -> Vec<u8> {
        let cells = (0..24_usize).flat_map(|y| (0..32_usize).map(move |x| (x + 2 * shift, y)));
        let code = |(x, y): (usize, usize)| (((x * x + 5 * x * y + 3 * y) / 4) % 200) as u8;
        cells.flat_map(|cell| [code(cell); 3]).collect()
    };
    let frames: Vec<Vec<u8>> = (0..3).map(frame).collect();
    let footage = Footage::from_srgb(frames.iter().map(Vec::as_slice), size, PERIOD_US);
    let footage = footage.expect("small and whole");
    let exposed = expose(&footage, 0.0, 2.0, &Synthesis::of_seed(1)).expect("within the footage");
    let mut bytes = exposed.blur;
    bytes.extend(exposed.sharp);
    for event in exposed.events {
        bytes.extend(event.t_us.to_le_bytes());
        bytes.extend([event.x() as u8, event.y() as u8, u8::from(event.is_on())]);
    }
    bytes
}

impl Cache {
    fn clip_path(&self, clips: &KittiClips, clip: &Clip) -> PathBuf {
        let (key, size) = (&clips.key, self.size);
        let folder = format!("kitti-{key}-{}-{size}", shard::FORMAT);
        let name = format!(
            "{}-{:010}.safetensors",
            clip.drive.name(),
            clip.frames.first
        );
        self.root.join(folder).join(name)
    }

    /// Makes what is missing of real drives, an exposure at a time, on the current rayon pool; as
    /// [`prepare`](Self::prepare) does nights.
    ///
    /// # Errors
    /// [`CacheError::Interrupted`] when stopped; finished exposures stay.
    pub fn prepare_clips(
        &self,
        clips: &KittiClips,
        stop: &AtomicBool,
        progress: &mut dyn FnMut(Prepared),
    ) -> Result<(), CacheError> {
        let mut state = Prepared {
            done: 0,
            rendered: 0,
            total: clips.len() as u64,
        };
        for clip in &clips.clips {
            if stop.load(Ordering::Relaxed) {
                return Err(CacheError::Interrupted);
            }
            let path = self.clip_path(clips, clip);
            if let Some(folder) = path.parent().filter(|folder| !folder.exists()) {
                fs::create_dir_all(folder).map_err(|source| CacheError::File {
                    path: folder.into(),
                    source,
                })?;
            }
            if !path.exists() {
                shard::write(&path, &clips.render(clip, self.size)?)?;
                state.rendered += clips.of_each() as u64;
            }
            state.done += clips.of_each() as u64;
            progress(state);
        }
        Ok(())
    }

    /// Opens every exposure of `clips` for reading.
    ///
    /// # Errors
    /// [`CacheError::File`] for a shard that is not there, [`CacheError::Shard`] for a damaged one.
    pub fn open_clips(&self, clips: &KittiClips) -> Result<Examples, CacheError> {
        let mut examples = Examples::default();
        for clip in &clips.clips {
            let held = Shard::open(&self.clip_path(clips, clip), Origin::Kitti, self.size)?;
            let seeds = (0..clips.cuts as u64).flat_map(|cut| {
                clips
                    .phases()
                    .map(move |phase| cut * u64::from(RING_STRIDE) + u64::from(phase))
            });
            examples.add(held, Origin::Kitti, seeds);
        }
        Ok(examples)
    }
}

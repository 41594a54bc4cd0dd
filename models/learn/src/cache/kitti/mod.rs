//! Real drives as examples: runs of KITTI's frames, blurred, made events of, and kept in shards.
//!
//! A shard holds one exposure's squares. Its path names what its content depends on: a fingerprint
//! of the synthesis, of the drives' calibration and first scans, and of what was asked for.

mod fingerprint;
mod scene;

use std::fmt::Write as _;
use std::fs;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

use noctule_world::STEPS;
use rayon::prelude::*;
use sha2::{Digest, Sha256};

use super::error::CacheError;
use super::example::{Example, Origin};
use super::shard::{self, Shard};
use super::{Cache, Examples, Prepared};
use crate::chance::Chance;
use crate::clip::{CLIP_SKIP, Frames, LONG, RING_STRIDE, exposures, scanned};
use crate::read::{ColourCamera, Drive, is_validation_drive, raw_drives};
use crate::settings::KittiDrives;
use crate::synth::{InBetween, Synthesis, expose};
use fingerprint::fingerprint;
use scene::Scene;

/// Salt of columns and nights of the squares.
const SQUARE: u64 = 0x006b_6974_7469;
/// Squares of an exposure that is validated on, as evaluation has them.
const VALIDATION_SQUARES: usize = 3;

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

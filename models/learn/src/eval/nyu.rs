//! NYU Depth v2 as exposures with truth.
//!
//! - Raw scenes: windows of eight consecutive pairs of picture and depth map. Where more than two
//!   periods of the slower stream lie between pairs, or two depth maps have the same picture, the
//!   sequence is torn and taken up behind the gap.
//! - Single frames, in a build with the feature `hdf5`: those for testing of the labelled set
//!   (`nyu_depth_v2_labeled.mat`), and pre-processed ones (`val/official/00001.h5`). Rooms that
//!   stand still.

use std::path::{Path, PathBuf};

use noctule_world::STEPS;

use super::error::EvalError;
use super::indoor::{self, RoomWindow, folder_name, windows};
use super::scene::{Scene, Scenes};
use crate::read::{
    NyuLayout, NyuPair, ReadError, nyu_pairs, nyu_test_frames, read_nyu_labelled, read_nyu_still,
};

/// Longest time from one picture to the next, seconds: 20 Hz, and half as much again.
const GAP_S_MAX: f64 = 0.075;

/// A folder of NYU Depth v2, ready to be scored on.
#[derive(Debug, Clone)]
pub struct NyuScenes {
    source: Source,
}

#[derive(Debug, Clone)]
enum Source {
    Raw(Vec<RoomWindow<NyuPair>>),
    Stills { root: PathBuf, files: Vec<PathBuf> },
    Labelled { set: PathBuf, frames: Vec<u32> },
}

impl NyuScenes {
    /// Finds what can be scored at `root`: a scene, a folder of scenes or of such folders.
    ///
    /// # Errors
    /// [`ReadError`], when nothing can be scored, or a file's name or list is not understood.
    pub fn open(root: &Path) -> Result<Self, ReadError> {
        match NyuLayout::of(root)? {
            NyuLayout::Raw(scenes) => Self::raw(root, &scenes),
            NyuLayout::Stills(files) => {
                let source = Source::Stills {
                    root: root.into(),
                    files,
                };
                Ok(Self { source })
            }
            NyuLayout::Labelled { set, splits } => {
                let frames = nyu_test_frames(&splits)?;
                let source = Source::Labelled { set, frames };
                Ok(Self { source })
            }
        }
    }

    fn raw(root: &Path, scenes: &[PathBuf]) -> Result<Self, ReadError> {
        let mut found = Vec::new();
        for scene in scenes {
            let folder = folder_name(root, scene);
            let name = |pair: &NyuPair| format!("{folder}:{}", pair.depth_time_s);
            for run in runs(nyu_pairs(scene)?) {
                found.append(&mut windows(run, &name, &period_us));
            }
        }
        match found.is_empty() {
            true => Err(ReadError::Missing {
                path: root.into(),
                wanted: format!(
                    "{STEPS} consecutive pairs of picture and depth, at most {GAP_S_MAX} s apart"
                ),
            }),
            false => Ok(Self {
                source: Source::Raw(found),
            }),
        }
    }
}

/// Pairs that follow one another without a gap.
fn runs(pairs: Vec<NyuPair>) -> Vec<Vec<NyuPair>> {
    let mut runs: Vec<Vec<NyuPair>> = Vec::new();
    for pair in pairs {
        let last = runs
            .last_mut()
            .and_then(|run| Some((run.last()?.picture_time_s, run)));
        match last {
            Some((before, run)) if follows(before, pair.picture_time_s) => run.push(pair),
            _ => runs.push(vec![pair]),
        }
    }
    runs
}

/// Whether a picture is the next one; not the same, and not one after a gap.
fn follows(before_s: f64, after_s: f64) -> bool {
    after_s > before_s && after_s - before_s <= GAP_S_MAX
}

/// Mean time from picture to picture, microseconds.
fn period_us(pairs: &[NyuPair]) -> f64 {
    let time = |pair: Option<&NyuPair>| pair.map_or(0.0, |pair| pair.picture_time_s);
    let gaps = pairs.len().saturating_sub(1).max(1);
    (time(pairs.last()) - time(pairs.first())) * 1e6 / gaps as f64
}

impl Scenes for NyuScenes {
    fn count(&self) -> usize {
        match &self.source {
            Source::Raw(windows) => windows.len(),
            Source::Stills { files, .. } => files.len(),
            Source::Labelled { frames, .. } => frames.len(),
        }
    }

    fn scene(&self, index: usize) -> Result<Scene, EvalError> {
        match &self.source {
            Source::Raw(windows) => windows[index].scene(),
            Source::Stills { root, files } => still(root, &files[index]),
            Source::Labelled { set, frames } => labelled(set, frames[index]),
        }
    }
}

fn still(root: &Path, path: &Path) -> Result<Scene, EvalError> {
    let (picture, depth) = read_nyu_still(path)?;
    let name = folder_name(root, &path.with_extension(""));
    indoor::still(&name, path, &picture, &depth)
}

fn labelled(set: &Path, frame: u32) -> Result<Scene, EvalError> {
    let (picture, depth) = read_nyu_labelled(set, frame)?;
    indoor::still(&format!("labelled:{frame:04}"), set, &picture, &depth)
}

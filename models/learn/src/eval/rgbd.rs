//! Sequences of an RGB-D camera (7-Scenes' layout) as exposures with truth, as NYU's raw scenes are.

use std::path::Path;

use noctule_world::STEPS;

use super::error::EvalError;
use super::indoor::{RoomWindow, folder_name, windows};
use super::scene::{Scene, Scenes};
use crate::read::{ReadError, RgbdFrame, rgbd_frames, rgbd_sequences};

/// Period of the camera, microseconds: 30 Hz. The layout has no time stamps.
const PERIOD_US: f64 = 1e6 / 30.0;

/// A folder of RGB-D sequences, ready to be scored on.
#[derive(Debug, Clone)]
pub struct RgbdScenes {
    windows: Vec<RoomWindow<RgbdFrame>>,
}

impl RgbdScenes {
    /// Finds what can be scored at `root`: a sequence, or folders of sequences up to two levels
    /// below. A missing number tears a sequence; it is taken up behind the gap.
    ///
    /// # Errors
    /// [`ReadError`], when nothing can be scored, or a frame lacks its picture or its depth.
    pub fn open(root: &Path) -> Result<Self, ReadError> {
        let mut found = Vec::new();
        for folder in rgbd_sequences(root)? {
            let label = folder_name(root, &folder);
            let name = |frame: &RgbdFrame| format!("{label}:{}", frame.number);
            let frames = rgbd_frames(&folder)?;
            let follows = |a: &RgbdFrame, b: &RgbdFrame| a.number.checked_add(1) == Some(b.number);
            for run in frames.chunk_by(follows) {
                found.append(&mut windows(run.to_vec(), &name, &|_| PERIOD_US));
            }
        }
        match found.is_empty() {
            true => Err(ReadError::Missing {
                path: root.into(),
                wanted: format!("{STEPS} consecutive frames with picture and depth"),
            }),
            false => Ok(Self { windows: found }),
        }
    }
}

impl Scenes for RgbdScenes {
    fn count(&self) -> usize {
        self.windows.len()
    }

    fn scene(&self, index: usize) -> Result<Scene, EvalError> {
        self.windows[index].scene()
    }
}

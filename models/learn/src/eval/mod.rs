//! Evaluation as the field does it: every method on the same exposures, scored alike.

mod data;
mod error;
mod indoor;
mod kitti;
mod method;
mod nyu;
mod rgbd;
mod scene;
mod table;

use std::sync::atomic::{AtomicBool, Ordering};

pub use data::{DataSet, Share, Withheld};
pub use error::EvalError;
pub use kitti::{KittiScenes, held_out};
pub use method::Method;
pub(crate) use method::complete;
pub use nyu::NyuScenes;
pub use rgbd::RgbdScenes;
pub use scene::{Scene, Scenes, WorldScenes};
pub use table::{MethodScores, Row, Scores, csv, markdown};

use crate::score::score_sequence;

/// Runs every method on a share of the exposures; `progress` is told how many are done, and of how
/// many.
///
/// # Errors
/// [`EvalError`], when an exposure cannot be had or a method fails on it;
/// [`EvalError::Interrupted`] soon after `stop` is set.
pub fn evaluate(
    scenes: &dyn Scenes,
    methods: &mut [Method],
    share: Share,
    stop: &AtomicBool,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Scores, EvalError> {
    let mut scores = Scores::default();
    let indices: Vec<usize> = share.of(scenes.count()).collect();
    for (done, &index) in indices.iter().enumerate() {
        if stop.load(Ordering::Relaxed) {
            return Err(EvalError::Interrupted);
        }
        let scene = scenes.scene(index)?;
        scene.check()?;
        for method in methods.iter_mut() {
            let predicted = method.predict(&scene)?;
            let found = score_sequence(&predicted.depth, scene.truth(), scene.size)?;
            let (params, gmac) = method.cost();
            let about = (method.name(), params, gmac);
            scores.add(about, index, &scene.name, &found, predicted.seconds)?;
        }
        progress(done + 1, indices.len());
    }
    Ok(scores)
}

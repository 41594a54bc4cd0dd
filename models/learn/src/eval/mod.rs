//! Evaluation as the field does it: every method on the same exposures, scored alike.

mod data;
mod error;
mod gallery;
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
pub use gallery::Gallery;
pub use kitti::KittiScenes;
pub use method::Method;
pub(crate) use method::complete;
pub use nyu::NyuScenes;
pub use rgbd::RgbdScenes;
pub use scene::{Scene, Scenes, WorldScenes};
pub use table::{MethodScores, Row, Scores, csv, markdown};

use crate::score::score_sequence;

/// One exposure that every method has completed.
#[derive(Debug)]
pub struct Observed<'a> {
    /// How many are done of how many, this one included.
    pub progress: (usize, usize),
    /// The exposure.
    pub scene: &'a Scene,
    /// Each method's name and maps, `[T, H, W]` in metres, in the order of the methods.
    pub maps: &'a [(String, Vec<f32>)],
}

/// Runs every method on a share of the exposures; `observe` is shown each as it is done.
///
/// # Errors
/// [`EvalError`], when an exposure cannot be had or a method fails on it;
/// [`EvalError::Interrupted`] soon after `stop` is set.
pub fn evaluate(
    scenes: &dyn Scenes,
    methods: &mut [Method],
    share: Share,
    stop: &AtomicBool,
    observe: &mut dyn FnMut(&Observed<'_>) -> Result<(), EvalError>,
) -> Result<Scores, EvalError> {
    let mut scores = Scores::default();
    let indices: Vec<usize> = share.of(scenes.count()).collect();
    for (done, &index) in indices.iter().enumerate() {
        if stop.load(Ordering::Relaxed) {
            return Err(EvalError::Interrupted);
        }
        let scene = scenes.scene(index)?;
        scene.check()?;
        let mut maps = Vec::with_capacity(methods.len());
        for method in methods.iter_mut() {
            let predicted = method.predict(&scene)?;
            let found = score_sequence(&predicted.depth, scene.truth(), scene.size)?;
            let (params, gmac) = method.cost();
            let about = (method.name(), params, gmac);
            scores.add(about, index, &scene.name, &found, predicted.seconds)?;
            maps.push((method.name().to_owned(), predicted.depth));
        }
        observe(&Observed {
            progress: (done + 1, indices.len()),
            scene: &scene,
            maps: &maps,
        })?;
    }
    Ok(scores)
}

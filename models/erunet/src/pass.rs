//! What one forward pass carries beside its tensors: which statistics normalise, what to keep, and where
//! the ground lies.

use std::collections::BTreeMap;

use candle_core::Tensor;
use noctule_depth::Ground;

/// Mean and variance of one batch normalisation's input, per channel.
#[derive(Debug, Clone)]
pub struct Moments {
    /// Mean over batch and pixels, `[C]`, detached.
    pub mean: Tensor,
    /// Variance over batch and pixels with Bessel's correction, `[C]`, detached: what the running
    /// variance is moved towards.
    pub variance: Tensor,
}

/// The settings and the by-products of one forward pass.
///
/// The default normalises with the stored running statistics and keeps nothing.
#[derive(Debug, Default)]
pub struct Pass {
    features: Option<BTreeMap<String, Tensor>>,
    moments: Option<BTreeMap<String, Moments>>,
    grounds: Vec<Option<Ground>>,
}

impl Pass {
    /// Running statistics, nothing kept.
    pub fn plain() -> Self {
        Self::default()
    }

    /// Running statistics; every named intermediate feature is kept (memory grows with steps).
    pub fn tracing() -> Self {
        Self {
            features: Some(BTreeMap::new()),
            ..Self::default()
        }
    }

    /// Statistics of the batch itself, which are collected by name (stage 2 of the training).
    pub fn training() -> Self {
        Self {
            moments: Some(BTreeMap::new()),
            ..Self::default()
        }
    }

    /// From now on over this ground, one for each exposure of the batch; `None` where it is not known.
    pub fn stand_over(&mut self, grounds: Vec<Option<Ground>>) {
        self.grounds = grounds;
    }

    pub(crate) fn grounds(&self) -> &[Option<Ground>] {
        &self.grounds
    }

    /// The features kept so far, by the oracle's names (`F_static`, `F_dyn.0`, `C.0`, ...).
    pub fn features(&self) -> impl Iterator<Item = (&str, &Tensor)> {
        self.features
            .iter()
            .flatten()
            .map(|(name, tensor)| (name.as_str(), tensor))
    }

    /// The batch statistics seen, by the name of their normalisation (`rdu.bott.bn`, ...).
    pub fn moments(&self) -> impl Iterator<Item = (&str, &Moments)> {
        self.moments
            .iter()
            .flatten()
            .map(|(name, moments)| (name.as_str(), moments))
    }

    pub(crate) fn uses_batch_statistics(&self) -> bool {
        self.moments.is_some()
    }

    pub(crate) fn keep(&mut self, name: &str, index: usize, feature: &Tensor) {
        if let Some(features) = &mut self.features {
            features.insert(format!("{name}.{index}"), feature.clone());
        }
    }

    pub(crate) fn keep_single(&mut self, name: &str, feature: &Tensor) {
        if let Some(features) = &mut self.features {
            features.insert(name.into(), feature.clone());
        }
    }

    pub(crate) fn collect(&mut self, name: &str, seen: Moments) {
        if let Some(moments) = &mut self.moments {
            moments.insert(name.into(), seen);
        }
    }
}

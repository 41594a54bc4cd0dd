//! The models behind one interface: begin a sequence, then one step after another.

use noctule_depth::{Completer, Ground, SizeError, confidence};

use super::Rung;
use crate::bus::BusError;
use crate::config::Config;
use crate::frame::{BundleLayout, BundlePlanes, FrameError, ModelId};

/// Why inference cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum InferError {
    /// The bus failed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// A frame of another shape than the layout's.
    #[error(transparent)]
    Frame(#[from] FrameError),
    /// A map of another size than the completer's.
    #[error(transparent)]
    Size(#[from] SizeError),
    /// A model that this program or its configuration lacks.
    #[error("model {model}: {reason}")]
    Missing {
        /// Which one.
        model: ModelId,
        /// Why it cannot run.
        reason: &'static str,
    },
    /// A weight file that cannot be used.
    #[cfg(feature = "model")]
    #[error("model {model}: {path}: {cause}")]
    File {
        /// Which one.
        model: ModelId,
        /// Its weights.
        path: std::path::PathBuf,
        /// Why.
        cause: Box<dyn std::error::Error + Send + Sync>,
    },
    /// A device that is not there.
    #[cfg(feature = "model")]
    #[error(
        "infer.device = \"cuda:{index}\": {reason}; is this a build with feature `cuda`, and is there such a GPU?"
    )]
    Device {
        /// Which GPU.
        index: usize,
        /// Why.
        reason: String,
    },
    /// A network failed.
    #[cfg(feature = "model")]
    #[error("model {model}: {cause}")]
    Network {
        /// Which one.
        model: ModelId,
        /// Why.
        cause: Box<dyn std::error::Error + Send + Sync>,
    },
}

/// Every model that can run here, for one layout.
pub struct Engines {
    layout: BundleLayout,
    completer: Completer,
    #[cfg(feature = "model")]
    networks: super::network::Networks,
}

impl Engines {
    /// Loads what the configuration names.
    ///
    /// # Errors
    /// When a weight file is missing or does not fit.
    pub fn load(config: &Config) -> Result<Self, InferError> {
        let layout = config.bundle_layout();
        let engines = Self {
            layout,
            completer: Completer::new(layout.width, layout.height)?,
            #[cfg(feature = "model")]
            networks: super::network::Networks::load(config)?,
        };
        #[cfg(not(feature = "model"))]
        if let Some(model) = config.infer.weights.keys().next() {
            let reason = "this program was built without networks (feature `model`)";
            return Err(InferError::Missing {
                model: *model,
                reason,
            });
        }
        Ok(engines)
    }

    /// Whether bundles of this layout can be run.
    #[must_use]
    pub fn fits(&self, layout: &BundleLayout) -> bool {
        *layout == self.layout
    }

    /// The models that can run, cheapest first.
    #[must_use]
    pub fn models(&self) -> Vec<ModelId> {
        let classical = [ModelId::Nearest, ModelId::Fill].into_iter();
        #[cfg(feature = "model")]
        return classical.chain(self.networks.models()).collect();
        #[cfg(not(feature = "model"))]
        classical.collect()
    }

    /// Starts a sequence of `model` over the bundle whose rasters are `planes`; `ground` says
    /// where level ground lies in them.
    ///
    /// # Errors
    /// When the network fails or is not loaded.
    pub fn begin<'a>(
        &'a mut self,
        model: ModelId,
        planes: &BundlePlanes<'_>,
        ground: Option<&Ground>,
    ) -> Result<Run<'a>, InferError> {
        let plane = self.layout.plane();
        match model {
            ModelId::Nearest | ModelId::Fill => Ok(Run {
                model,
                plane,
                kind: Kind::Classical(&mut self.completer),
            }),
            #[cfg(feature = "model")]
            _ => {
                let sequence = self.networks.begin(model, &self.layout, planes, ground)?;
                Ok(Run {
                    model,
                    plane,
                    kind: Kind::Network(sequence),
                })
            }
            #[cfg(not(feature = "model"))]
            _ => {
                let _ = (planes, ground);
                Err(InferError::Missing {
                    model,
                    reason: "this program was built without networks",
                })
            }
        }
    }

    /// Runs every model up to `asked` once over blank planes and times it: the ladder's first
    /// predictions. `now_ns` reads a clock.
    ///
    /// # Errors
    /// When a network fails.
    pub fn measure(
        &mut self,
        asked: ModelId,
        now_ns: &dyn Fn() -> u64,
    ) -> Result<Vec<Rung>, InferError> {
        let layout = self.layout;
        let voxels = vec![0.0; layout.voxels_len()];
        // One return in every sixteenth pixel of each row, as dense as a LiDAR is.
        let sparse: Vec<f32> = (0..layout.sparse_len())
            .map(|i| if i % 37 == 0 { 10.0 } else { 0.0 })
            .collect();
        let image = vec![0.5; layout.image_len()];
        let planes = BundlePlanes {
            voxels: &voxels,
            sparse: &sparse,
            image: &image,
        };
        let (mut depth, mut trust) = (vec![0.0; layout.plane()], vec![0.0; layout.plane()]);
        let mut rungs = Vec::new();
        for model in self.models().into_iter().filter(|m| *m <= asked) {
            let mut rung = Rung {
                model,
                begin_ns: 0,
                step_ns: 0,
            };
            // The first round warms caches and pages, the second counts.
            for _ in 0..2 {
                let start = now_ns();
                let mut run = self.begin(model, &planes, None)?;
                let begun = now_ns();
                run.step(&planes, 0, &mut depth, &mut trust)?;
                rung.begin_ns = begun - start;
                rung.step_ns = now_ns() - begun;
            }
            rungs.push(rung);
        }
        Ok(rungs)
    }
}

/// A sequence under way.
pub struct Run<'a> {
    model: ModelId,
    plane: usize,
    kind: Kind<'a>,
}

enum Kind<'a> {
    Classical(&'a mut Completer),
    #[cfg(feature = "model")]
    Network(super::network::NetworkRun<'a>),
}

impl Run<'_> {
    /// Which model runs.
    #[must_use]
    pub fn model(&self) -> ModelId {
        self.model
    }

    /// Computes step `step`: depth `[H, W]` in metres and confidence `[H, W]` in 0 to 1.
    ///
    /// A network's steps build on one another: take them in order from 0.
    ///
    /// # Errors
    /// When the network fails or a plane has the wrong size.
    pub fn step(
        &mut self,
        planes: &BundlePlanes<'_>,
        step: usize,
        depth: &mut [f32],
        trust: &mut [f32],
    ) -> Result<(), InferError> {
        let sparse = &planes.sparse[step * self.plane..][..self.plane];
        match &mut self.kind {
            Kind::Classical(completer) if self.model == ModelId::Nearest => {
                completer.nearest(sparse, depth, trust)?;
                trust
                    .iter_mut()
                    .for_each(|distance| *distance = confidence(*distance));
                Ok(())
            }
            Kind::Classical(completer) => Ok(completer.fill(sparse, depth, trust)?),
            #[cfg(feature = "model")]
            Kind::Network(run) => run.step(planes, step, depth, trust),
        }
    }
}

//! Ways to make eight depth maps of an exposure: networks, and what needs no learning.

use std::path::Path;
use std::time::Instant;

use candle_core::Device;
use noctule_depth::{Completer, Size};
use noctule_erunet::{Config, Plan, PlanError, PlanOptions, Variant, Weights, describe};
use noctule_raster::BINS;
use noctule_world::STEPS;

use super::data::Withheld;
use super::error::EvalError;
use super::scene::Scene;

/// Something that completes depth.
pub struct Method {
    name: String,
    kind: Kind,
    params: u64,
    gmac: f64,
}

enum Kind {
    Network(Box<Network>),
    Nearest,
    Fill,
    Median,
    FirstTruth,
}

struct Network {
    config: Config,
    weights: Weights,
    options: PlanOptions,
    withheld: Withheld,
    plan: Option<(Size, Plan)>,
}

/// Eight maps and what they took.
pub(super) struct Prediction {
    /// `[T, H, W]`, metres.
    pub depth: Vec<f32>,
    pub seconds: f64,
}

impl Method {
    /// The rows every table has: exact nearest return, surfaces through the returns, the truth's
    /// median everywhere, and the truth of the first step at every step.
    pub fn baselines() -> Vec<Self> {
        [
            ("nearest", Kind::Nearest),
            ("fill", Kind::Fill),
            ("median constant", Kind::Median),
            ("truth of step 1 reused", Kind::FirstTruth),
        ]
        .into_iter()
        .map(|(name, kind)| Self {
            name: name.to_owned(),
            kind,
            params: 0,
            gmac: 0.0,
        })
        .collect()
    }

    /// A network from a weights file that says what it is of.
    ///
    /// # Errors
    /// [`EvalError`], when the file is damaged or has no configuration.
    pub fn network(
        name: &str,
        path: &Path,
        withheld: Withheld,
        options: PlanOptions,
    ) -> Result<Self, EvalError> {
        let weights = Weights::read(path, &Device::Cpu)?;
        Self::of_weights(name, weights, withheld, options)
    }

    /// As [`Method::network`], from weights at hand.
    ///
    /// # Errors
    /// [`EvalError`], when they have no configuration or do not fit it.
    pub fn of_weights(
        name: &str,
        weights: Weights,
        withheld: Withheld,
        options: PlanOptions,
    ) -> Result<Self, EvalError> {
        let config = weights.config().cloned();
        // Nothing in the weights depends on the number of steps.
        let config = config
            .ok_or_else(|| EvalError::NoConfig(name.to_owned()))?
            .with_steps(STEPS);
        weights.check(&config)?;
        let cost = describe(&config, 256, 256)?;
        let variant = match config.variant {
            Variant::Full => "",
            Variant::NoEfr => ", w/o EFR (the blurred picture in place of a deblurred one)",
            Variant::NoHgcm => ", w/o HGCM",
        };
        Ok(Self {
            name: format!("{name}{variant}{}", withheld.label()),
            kind: Kind::Network(Box::new(Network {
                config,
                weights,
                options,
                withheld,
                plan: None,
            })),
            params: cost.params,
            gmac: cost.gmac,
        })
    }

    /// As tables call it.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Trained values, and multiply-adds per exposure at 256 x 256 pixels, in units of 10^9.
    pub fn cost(&self) -> (u64, f64) {
        (self.params, self.gmac)
    }

    pub(super) fn predict(&mut self, scene: &Scene) -> Result<Prediction, EvalError> {
        let started = Instant::now();
        let depth = match &mut self.kind {
            Kind::Network(network) => return network.predict(scene),
            Kind::Nearest => by_step(scene, Completer::nearest)?,
            Kind::Fill => by_step(scene, Completer::fill)?,
            Kind::Median => by_truth(scene, |truth| {
                let mut known: Vec<f32> = truth
                    .iter()
                    .copied()
                    .filter(|d| *d > 0.0 && *d <= scene.cap_m)
                    .collect();
                let middle = known.len() / 2;
                let median = match known.is_empty() {
                    true => scene.cap_m,
                    false => *known.select_nth_unstable_by(middle, f32::total_cmp).1,
                };
                vec![median; truth.len()]
            }),
            Kind::FirstTruth => {
                // Sky of the first step is as far as can be.
                let first = &scene.depth[..scene.size.pixels()];
                let held = |d: &f32| if *d > 0.0 { *d } else { scene.cap_m };
                first.iter().map(held).collect::<Vec<f32>>().repeat(STEPS)
            }
        };
        Ok(Prediction {
            depth,
            seconds: started.elapsed().as_secs_f64(),
        })
    }
}

fn by_truth(scene: &Scene, map: impl Fn(&[f32]) -> Vec<f32>) -> Vec<f32> {
    scene
        .depth
        .chunks_exact(scene.size.pixels())
        .flat_map(map)
        .collect()
}

type Complete =
    fn(&mut Completer, &[f32], &mut [f32], &mut [f32]) -> Result<(), noctule_depth::SizeError>;

fn by_step(scene: &Scene, complete: Complete) -> Result<Vec<f32>, EvalError> {
    let (size, area) = (scene.size, scene.size.pixels());
    let mut completer = Completer::new(size.width(), size.height())?;
    let (mut depth, mut aside) = (vec![0.0; STEPS * area], vec![0.0; area]);
    for (map, sparse) in depth
        .chunks_exact_mut(area)
        .zip(scene.sparse.chunks_exact(area))
    {
        complete(&mut completer, sparse, map, &mut aside)?;
    }
    Ok(depth)
}

impl Network {
    /// Compiles a plan for the scene's size, unless there is one.
    fn plan(&mut self, size: Size) -> Result<&mut Plan, EvalError> {
        let plan = match self.plan.take() {
            Some((held, plan)) if held == size => plan,
            _ => {
                let (config, weights) = (&self.config, &self.weights);
                Plan::new(config, weights, size.height(), size.width(), self.options)?
            }
        };
        Ok(&mut self.plan.insert((size, plan)).1)
    }

    fn predict(&mut self, scene: &Scene) -> Result<Prediction, EvalError> {
        let withheld = self.withheld;
        let plan = self.plan(scene.size)?;
        let started = Instant::now();
        let depth = complete(plan, scene, withheld)?;
        Ok(Prediction {
            depth,
            seconds: started.elapsed().as_secs_f64(),
        })
    }
}

/// All eight maps of one exposure, `[T, H, W]` in metres, from a plan of the scene's size.
pub(crate) fn complete(
    plan: &mut Plan,
    scene: &Scene,
    withheld: Withheld,
) -> Result<Vec<f32>, PlanError> {
    let area = scene.size.pixels();
    let nothing = vec![0.0; BINS.max(3) * area];
    plan.begin(
        if withheld.image {
            &nothing[..3 * area]
        } else {
            &scene.blur
        },
        withheld.ground(scene.ground.as_ref()).as_ref(),
    )?;
    let (mut depth, mut confidence) = (vec![0.0; STEPS * area], vec![0.0; area]);
    for (step, map) in depth.chunks_exact_mut(area).enumerate() {
        let voxel = match withheld.events {
            true => &nothing[..BINS * area],
            false => &scene.voxel[step * BINS * area..][..BINS * area],
        };
        let sparse = match withheld.lidar {
            true => &nothing[..area],
            false => &scene.sparse[step * area..][..area],
        };
        plan.step(voxel, sparse, map, &mut confidence)?;
    }
    Ok(depth)
}

//! What an evaluation runs over: exposures with truth, wherever they come from.

use std::ops::Range;

use noctule_depth::{Ground, Size};
use noctule_raster::{BINS, Grid, PackedEvent, PixelMap, RasterError, Rescale, VoxelRaster};
use noctule_world::{STEPS, Sample, Tier};

use super::error::EvalError;
use crate::cache::Example;
use crate::score::{DEPTH_CAP_M, Truth};

/// One exposure, ready to be completed and scored; `T` is 8.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// Said in tables of single images.
    pub name: String,
    /// Width and height, pixels.
    pub size: Size,
    /// The long exposure, `[3, H, W]`, encoded values over 255.
    pub blur: Vec<f32>,
    /// `[T, BINS, H, W]`, -1 to 1.
    pub voxel: Vec<f32>,
    /// `[T, H, W]`, metres, 0 for no return.
    pub sparse: Vec<f32>,
    /// Where level ground lies in the picture, where that is known.
    pub ground: Option<Ground>,
    /// Truth, `[T, H, W]`, metres, 0 for none.
    pub depth: Vec<f32>,
    /// `[T, H, W]`; empty where unknown.
    pub movers: Vec<bool>,
    /// `[T, H, W]`; empty where unknown.
    pub thin: Vec<bool>,
    /// `[T - 1, 2, H, W]`, pixels; empty where unknown.
    pub flow: Vec<f32>,
    /// Farthest depth that is scored, metres.
    pub cap_m: f32,
}

impl Scene {
    /// What predictions are scored against.
    pub fn truth(&self) -> Truth<'_> {
        Truth {
            depth: &self.depth,
            movers: &self.movers,
            thin: &self.thin,
            flow: &self.flow,
            cap_m: self.cap_m,
        }
    }

    /// Refuses fields whose lengths do not fit the size.
    ///
    /// # Errors
    /// [`EvalError::Scene`], naming the first such field.
    pub fn check(&self) -> Result<(), EvalError> {
        let area = self.size.pixels();
        let optional = |len: usize, wanted: usize| if len == 0 { 0 } else { wanted };
        for (field, len, wanted) in [
            ("blur", self.blur.len(), 3 * area),
            ("voxel", self.voxel.len(), STEPS * BINS * area),
            ("sparse", self.sparse.len(), STEPS * area),
            ("depth", self.depth.len(), STEPS * area),
            (
                "movers",
                self.movers.len(),
                optional(self.movers.len(), STEPS * area),
            ),
            (
                "thin",
                self.thin.len(),
                optional(self.thin.len(), STEPS * area),
            ),
            (
                "flow",
                self.flow.len(),
                optional(self.flow.len(), 2 * (STEPS - 1) * area),
            ),
        ] {
            if len != wanted {
                return Err(EvalError::Scene {
                    scene: self.name.clone(),
                    fault: format!("{field} has {len} values, wanted {wanted}"),
                });
            }
        }
        Ok(())
    }
}

/// A set of exposures in a fixed order.
pub trait Scenes {
    /// How many there are.
    fn count(&self) -> usize;

    /// Reads or renders number `index`, which is below [`count`](Self::count).
    ///
    /// # Errors
    /// When it cannot be had.
    fn scene(&self, index: usize) -> Result<Scene, EvalError>;
}

/// Drives of the synthetic night, one exposure each, rendered as they are asked for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WorldScenes {
    /// How hard they are.
    pub tier: Tier,
    /// Their seeds.
    pub seeds: Range<u64>,
    /// Width and height, pixels.
    pub size: usize,
}

impl Scenes for WorldScenes {
    fn count(&self) -> usize {
        usize::try_from(self.seeds.end.saturating_sub(self.seeds.start)).unwrap_or(usize::MAX)
    }

    fn scene(&self, index: usize) -> Result<Scene, EvalError> {
        let seed = self.seeds.start + index as u64;
        let name = format!("{}:{seed}", self.tier.letter());
        let fault = |fault: String| EvalError::Scene {
            scene: name.clone(),
            fault,
        };
        let sample = Sample::render(seed, self.tier, self.size);
        let example = Example::from_sample(seed, self.tier, &sample);
        let mut scene = Scene::of_example(&example.map_err(|e| fault(e.to_string()))?)?;
        scene.depth = sample.depth; // to the last bit, where an example rounds
        scene.flow = sample.flow;
        Ok(scene)
    }
}

impl Scene {
    /// A whole example as it is; its flow is not known.
    ///
    /// # Errors
    /// [`EvalError::Scene`], when its events do not fit the raster.
    pub fn of_example(example: &Example) -> Result<Self, EvalError> {
        let name = format!("{}:{}", example.origin.letter(), example.seed);
        let fault = |fault: String| EvalError::Scene {
            scene: name.clone(),
            fault,
        };
        let size = Size::new(example.size, example.size).map_err(|e| fault(e.to_string()))?;
        Ok(Self {
            size,
            blur: example.blur.iter().map(|&b| f32::from(b) / 255.0).collect(),
            voxel: voxels(&example.events, example.exposure_us, size)
                .map_err(|e| fault(e.to_string()))?,
            sparse: example.sparse.clone(),
            ground: example.ground,
            depth: example.depth.clone(),
            movers: example.movers.clone(),
            thin: example.thin.clone(),
            flow: Vec::new(),
            cap_m: DEPTH_CAP_M,
            name,
        })
    }
}

/// All events of an exposure, their times counted from its start, rastered as the vehicle does.
pub(super) fn voxels(
    events: &[PackedEvent],
    exposure_us: u32,
    size: Size,
) -> Result<Vec<f32>, RasterError> {
    let grid = Grid::new(size.width() as u32, size.height() as u32);
    let map = PixelMap::rescaled(&Rescale::identity(grid)?);
    let raster = VoxelRaster::new(STEPS, map)?;
    let mut voxel = vec![0.0; raster.shape().len()];
    let exposure = noctule_raster::Exposure::from_micros(0, u64::from(exposure_us))?;
    raster.raster(exposure, events, &mut voxel)?;
    Ok(voxel)
}

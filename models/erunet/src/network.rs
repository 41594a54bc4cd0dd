//! The whole network: restoration and completion, for a batch of exposures at once.
//!
//! For results as they become ready, step by step, see [`crate::Sequence`].

use candle_core::{Device, Tensor};
use thiserror::Error;

use crate::config::{Config, ConfigError, SIDE_MULTIPLE};
use crate::efr::Efr;
use crate::params::{Norms, Params, Source};
use crate::parts::build;
use crate::pass::Pass;
use crate::rdu::Rdu;
use crate::weights::{Weights, WeightsError};

/// Why a network could not be built or run.
#[derive(Debug, Error)]
pub enum NetworkError {
    /// The configuration describes no network.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The weights do not fit the configuration.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// An input has the wrong shape.
    #[error("{input} has shape {actual:?}, wanted {wanted}")]
    Shape {
        /// Which input.
        input: &'static str,
        /// Its dimensions.
        actual: Vec<usize>,
        /// What would have fitted, values included.
        wanted: String,
    },
    /// A sequence was stepped beyond its last step.
    #[error("all {steps} steps of the exposure are done")]
    StepsExhausted {
        /// Steps per exposure.
        steps: usize,
    },
    /// The tensor library failed: out of memory, wrong device, unsupported number format.
    #[error("tensor operation failed: {0}")]
    Tensor(#[from] candle_core::Error),
}

/// ERU-Net with its weights on one device.
pub struct Network {
    config: Config,
    efr: Option<Efr>,
    rdu: Rdu,
    device: Device,
}

/// What a batch of exposures yields.
#[derive(Debug)]
pub struct Outputs {
    /// `D_dense` in metres, `[B, T, 1, H, W]`.
    pub depth: Tensor,
    /// Confidence C of eq. 5 at level 0, 0 to 1, `[B, T, 1, H, W]`.
    pub confidence: Tensor,
}

impl Network {
    /// Builds the network over `weights`, on the device they lie on.
    ///
    /// With [`Norms::Keep`] the tensors are shared, not copied: pass tensors of variables and
    /// gradients reach them, and later changes to the variables show in later passes.
    pub fn new(config: &Config, weights: &Weights, norms: Norms) -> Result<Self, NetworkError> {
        config.validate()?;
        weights.check(config)?;
        let source = Source::Given(weights.tensors());
        let (efr, rdu) = build(config, &Params::root(&source, norms))?;
        let device = weights.device();
        Ok(Self {
            config: config.clone(),
            efr,
            rdu,
            device,
        })
    }

    /// The configuration the network was built from.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// The device inputs must lie on.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// Runs whole exposures with running statistics: `blur` `[B, 3, H, W]`, `voxel`
    /// `[B, T, bins, H, W]` in -1 to 1, `sparse` `[B, T, 1, H, W]` in metres, 0 for no return. The ground counts as not known.
    pub fn forward(
        &self,
        blur: &Tensor,
        voxel: &Tensor,
        sparse: &Tensor,
    ) -> Result<Outputs, NetworkError> {
        let mut pass = Pass::plain();
        let clear = self.restore(blur, voxel, &mut pass)?;
        self.complete(&clear, voxel, sparse, &mut pass)
    }

    /// Restoration alone, step after step: `blur` and `voxel` as in [`Network::forward`]; returns
    /// `F_clear` per step, each `[B, c0, H, W]`.
    pub fn restore(
        &self,
        blur: &Tensor,
        voxel: &Tensor,
        pass: &mut Pass,
    ) -> Result<Vec<Tensor>, NetworkError> {
        let (b, h, w) = self.check_blur(blur)?;
        let Config { steps, bins, .. } = self.config;
        check_shape("voxel", voxel, &[b, steps, bins, h, w])?;
        self.restore_window(blur, voxel, 0, pass)
    }

    /// Completion alone, all steps folded into the batch: `clear` from [`Network::restore`],
    /// `voxel` and `sparse` as in [`Network::forward`].
    pub fn complete(
        &self,
        clear: &[Tensor],
        voxel: &Tensor,
        sparse: &Tensor,
        pass: &mut Pass,
    ) -> Result<Outputs, NetworkError> {
        let steps = self.config.steps;
        if clear.len() != steps {
            return Err(NetworkError::Shape {
                input: "clear",
                actual: vec![clear.len()],
                wanted: format!("{steps} features"),
            });
        }
        self.complete_window(clear, voxel, sparse, pass)
    }

    /// The sharp pictures that restored features stand for: `[B, T, 3, H, W]`; `None` for a
    /// network without restoration. Stage 1 of the training needs them, inference does not.
    pub fn reconstruct(
        &self,
        clear: &[Tensor],
        blur: &Tensor,
    ) -> Result<Option<Tensor>, NetworkError> {
        let Some(efr) = &self.efr else {
            return Ok(None);
        };
        let pictures: Vec<Tensor> = clear
            .iter()
            .map(|clear| efr.reconstruct(clear, blur))
            .collect::<Result<_, _>>()?;
        Ok(Some(Tensor::stack(&pictures, 1)?))
    }

    /// What holds for all steps of an exposure, `[B, c0, H, W]`.
    pub(crate) fn appearance(&self, blur: &Tensor, pass: &mut Pass) -> candle_core::Result<Tensor> {
        match (&self.efr, self.rdu.picture_feature(blur)) {
            (Some(efr), _) => efr.appearance(blur, pass),
            (None, Some(feature)) => feature,
            (None, None) => unreachable!("a network without restoration has a picture stem"),
        }
    }

    /// `F_clear` of one step; without restoration the picture's feature serves every step.
    pub(crate) fn restore_step(
        &self,
        still: &Tensor,
        previous: Option<&Tensor>,
        voxel: &Tensor,
        t: usize,
        pass: &mut Pass,
    ) -> candle_core::Result<Tensor> {
        match &self.efr {
            Some(efr) => efr.step(still, previous, voxel, t, pass),
            None => Ok(still.clone()),
        }
    }

    pub(crate) fn complete_step(
        &self,
        clear: &Tensor,
        voxel: &Tensor,
        sparse: &Tensor,
        pass: &mut Pass,
    ) -> candle_core::Result<(Tensor, Tensor)> {
        self.rdu.forward(clear, voxel, sparse, pass)
    }

    /// Batch, height and width of a picture this network can take.
    pub(crate) fn check_blur(&self, blur: &Tensor) -> Result<(usize, usize, usize), NetworkError> {
        match *blur.dims() {
            [b, 3, h, w]
                if b > 0 && h > 0 && w > 0 && h % SIDE_MULTIPLE == 0 && w % SIDE_MULTIPLE == 0 =>
            {
                Ok((b, h, w))
            }
            ref dims => Err(NetworkError::Shape {
                input: "blur",
                actual: dims.to_vec(),
                wanted: format!("[B, 3, H, W] with H and W multiples of {SIDE_MULTIPLE}"),
            }),
        }
    }
}

pub(crate) fn check_shape(
    input: &'static str,
    tensor: &Tensor,
    wanted: &[usize],
) -> Result<(), NetworkError> {
    if tensor.dims() == wanted {
        return Ok(());
    }
    let actual = tensor.dims().to_vec();
    Err(NetworkError::Shape {
        input,
        actual,
        wanted: format!("{wanted:?}"),
    })
}

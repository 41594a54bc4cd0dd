//! One exposure in the making: each depth map is there as soon as its step is done.

use candle_core::Tensor;
use noctule_depth::Ground;

use crate::network::{Network, NetworkError, check_shape};
use crate::pass::Pass;

/// The depth map of one step.
#[derive(Debug)]
pub struct Step {
    /// Depth in metres, `[B, 1, H, W]`.
    pub depth: Tensor,
    /// Confidence C of eq. 5 at level 0, 0 to 1, `[B, 1, H, W]`.
    pub confidence: Tensor,
}

/// An exposure whose picture has been looked at and whose steps are being worked through.
///
/// The steps of [`Network::forward`] one by one, with the same results.
pub struct Sequence<'a> {
    network: &'a Network,
    still: Tensor,
    previous: Option<Tensor>,
    done: usize,
    size: (usize, usize, usize),
    ground: Option<Ground>,
}

impl Network {
    /// Starts one exposure (or a batch of them): `blur` `[B, 3, H, W]`, encoded values over 255;
    /// for a network without restoration, the deblurred picture. All exposures of a batch lie over
    /// one ground; `None` where it is not known.
    pub fn begin(
        &self,
        blur: &Tensor,
        ground: Option<&Ground>,
    ) -> Result<Sequence<'_>, NetworkError> {
        Sequence::new(self, blur, ground)
    }
}

impl<'a> Sequence<'a> {
    pub(crate) fn new(
        network: &'a Network,
        blur: &Tensor,
        ground: Option<&Ground>,
    ) -> Result<Self, NetworkError> {
        let size = network.check_blur(blur)?;
        let still = network.appearance(blur, &mut Pass::plain())?;
        Ok(Self {
            network,
            still,
            previous: None,
            done: 0,
            size,
            ground: ground.copied(),
        })
    }

    /// Works through the next step: `voxel` `[B, bins, H, W]` in -1 to 1, `sparse` `[B, 1, H, W]`
    /// in metres, 0 for no return. A refused input leaves the sequence where it was.
    pub fn step(&mut self, voxel: &Tensor, sparse: &Tensor) -> Result<Step, NetworkError> {
        let config = self.network.config();
        if self.done == config.steps {
            return Err(NetworkError::StepsExhausted {
                steps: config.steps,
            });
        }
        let (b, h, w) = self.size;
        check_shape("voxel", voxel, &[b, config.bins, h, w])?;
        check_shape("sparse", sparse, &[b, 1, h, w])?;
        let mut pass = Pass::plain();
        pass.stand_over(vec![self.ground]);
        let clear = self.network.restore_step(
            &self.still,
            self.previous.as_ref(),
            voxel,
            self.done,
            &mut pass,
        )?;
        let (depth, confidence) = self
            .network
            .complete_step(&clear, voxel, sparse, &mut pass)?;
        self.previous = Some(clear);
        self.done += 1;
        Ok(Step { depth, confidence })
    }

    /// Steps done so far.
    pub fn done_count(&self) -> usize {
        self.done
    }
}

//! A few consecutive steps of an exposure: what training cuts out of it to fit memory and time.

use candle_core::Tensor;

use crate::network::{Network, NetworkError, Outputs, check_shape};
use crate::pass::Pass;

impl Network {
    /// As [`Network::restore`], for steps `first..first + n` alone, of `voxel`
    /// `[B, first + n, bins, H, W]`.
    ///
    /// The steps before the first are run through, so that it sees the feature restored before it
    /// as it will in a whole exposure, but no gradient reaches them.
    pub fn restore_window(
        &self,
        blur: &Tensor,
        voxel: &Tensor,
        first: usize,
        pass: &mut Pass,
    ) -> Result<Vec<Tensor>, NetworkError> {
        let (b, h, w) = self.check_blur(blur)?;
        let steps = voxel.dims().get(1).copied().unwrap_or(0);
        let config = self.config();
        if steps <= first || steps > config.steps {
            return Err(NetworkError::Shape {
                input: "voxel",
                actual: voxel.dims().to_vec(),
                wanted: format!("{} to {} steps", first + 1, config.steps),
            });
        }
        check_shape("voxel", voxel, &[b, steps, config.bins, h, w])?;
        let still = self.appearance(blur, pass)?;
        let mut clear: Vec<Tensor> = Vec::with_capacity(steps - first);
        let mut before = None;
        for t in 0..steps {
            let voxel = voxel.narrow(1, t, 1)?.squeeze(1)?;
            let previous = clear.last().or(before.as_ref());
            let restored = self.restore_step(&still, previous, &voxel, t, pass)?;
            if t < first {
                before = Some(restored.detach());
            } else {
                clear.push(restored);
            }
        }
        Ok(clear)
    }

    /// As [`Network::complete`], for as many steps as `clear` has.
    pub fn complete_window(
        &self,
        clear: &[Tensor],
        voxel: &Tensor,
        sparse: &Tensor,
        pass: &mut Pass,
    ) -> Result<Outputs, NetworkError> {
        let steps = clear.len();
        let Some(first) = clear.first() else {
            return Err(NetworkError::Shape {
                input: "clear",
                actual: vec![0],
                wanted: "one feature or more".into(),
            });
        };
        let (b, c0, h, w) = first.dims4()?;
        check_shape("voxel", voxel, &[b, steps, self.config().bins, h, w])?;
        check_shape("sparse", sparse, &[b, steps, 1, h, w])?;
        let clear = Tensor::stack(clear, 1)?.reshape((b * steps, c0, h, w))?;
        let fold = |x: &Tensor| x.flatten(0, 1)?.contiguous();
        let (depth, confidence) =
            self.complete_step(&clear, &fold(voxel)?, &fold(sparse)?, pass)?;
        let unfold = |x: Tensor| x.reshape((b, steps, 1, h, w));
        Ok(Outputs {
            depth: unfold(depth)?,
            confidence: unfold(confidence)?,
        })
    }
}

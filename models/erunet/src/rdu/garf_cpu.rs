//! The filtering of GARF on the processor as one operation with a backward pass: kernels are
//! built from the coefficients for a few rows at a time and never stored.

use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor, bail};
use noctule_kernels::PlaneFilter;

use crate::conv_cpu::ISA;
use crate::slices::{all_values, in_order};

/// Filters every channel of the first operand, x `[N, d, h, w]`, with kernels that the second
/// combines from the atoms, coefficients `[N, M*K, h, w]` with index m*K + k; result
/// `[N, d*M, h, w]`, index c*M + m.
#[derive(Clone)]
pub(super) struct FilterCpu {
    /// Row and column of each tap in a picture padded by `reach`.
    pub(super) taps: Vec<(usize, usize)>,
    /// Pixels a kernel reaches beyond its centre.
    pub(super) reach: usize,
    /// What each atom holds at each tap, `[J, K]`.
    pub(super) atoms: Vec<f32>,
    /// M.
    pub(super) filters: usize,
}

impl FilterCpu {
    fn filter<'a>(
        &'a self,
        x_shape: &Shape,
        coefficients_shape: &Shape,
        x: &'a [f32],
        coefficients: &'a [f32],
    ) -> Result<PlaneFilter<'a>> {
        let (n, d, h, w) = x_shape.dims4()?;
        let count = self.filters * self.atoms.len() / self.taps.len();
        if coefficients_shape.dims() != [n, count, h, w] {
            bail!("coefficients {coefficients_shape:?} do not fit {x_shape:?}");
        }
        Ok(PlaneFilter {
            batch: n,
            channels: d,
            filters: self.filters,
            height: h,
            width: w,
            taps: &self.taps,
            reach: self.reach,
            atoms: &self.atoms,
            x,
            coefficients,
            isa: *ISA,
        })
    }
}

impl CustomOp2 for FilterCpu {
    fn name(&self) -> &'static str {
        "garf_filter"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        coefficients: &CpuStorage,
        coefficients_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (x, coefficients) = (
            in_order(x, x_layout)?,
            in_order(coefficients, coefficients_layout)?,
        );
        let shapes = (x_layout.shape(), coefficients_layout.shape());
        let filter = self.filter(shapes.0, shapes.1, x, coefficients)?;
        let (n, d, h, w) = x_layout.shape().dims4()?;
        let shape = Shape::from((n, d * self.filters, h, w));
        Ok((CpuStorage::F32(filter.forward()), shape))
    }

    fn bwd(
        &self,
        x: &Tensor,
        coefficients: &Tensor,
        _: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let shapes = (x.shape(), coefficients.shape());
        let (x_grad, grads) = all_values(&[x, coefficients, grad], |values| {
            let filter = self.filter(shapes.0, shapes.1, values[0], values[1])?;
            Ok::<_, candle_core::Error>(filter.backward(values[2]))
        })??;
        let tensor = |values, like: &Tensor| Tensor::from_vec(values, like.shape(), like.device());
        Ok((Some(tensor(x_grad, x)?), Some(tensor(grads, coefficients)?)))
    }
}

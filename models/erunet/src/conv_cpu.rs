//! Convolution on the processor as one operation with a backward pass: concatenated sources,
//! bias, residual and activation included.
//!
//! Candle's own unfolds value by value and goes through the picture once per addition. Candle's
//! operations take three operands at most, so that weight and bias travel as one where there are
//! more.

use std::sync::LazyLock;

use candle_core::{CpuStorage, CustomOp2, CustomOp3, Layout, Result, Shape, Tensor, bail};
use noctule_kernels::{Activation, Geometry, Isa, PlaneConv, Wanted};

use crate::slices::{all_values, in_order};

/// The instructions all operations of this crate use.
pub(crate) static ISA: LazyLock<Isa> = LazyLock::new(Isa::detect);

/// What an operand of [`ConvCpu`] is.
#[derive(Clone, Copy, PartialEq)]
enum Operand {
    /// `[B, channels, H, W]`; the channels of several follow one another.
    Source,
    /// `[O, I, k, k]`.
    Weight,
    /// Weight and then bias, flat.
    WeightAndBias,
    /// `[O]`.
    Bias,
    /// Added before the activation, shaped as the output.
    Residual,
}

/// Side of the window, stride, and what follows the sum; zero padding is half the window.
#[derive(Clone, Copy)]
pub(crate) struct Window {
    pub(crate) kernel: usize,
    pub(crate) stride: usize,
    pub(crate) activation: Activation,
}

/// The operation, and what its operands are in order.
struct ConvCpu {
    window: Window,
    outputs: usize,
    operands: Vec<Operand>,
}

/// `activation(conv(cat(sources)) + bias + residual)`: one or two sources `[B, channels, H, W]`,
/// `weight` `[O, I, k, k]`; returns `[B, O, H/stride, W/stride]`, rounded up. Single precision.
pub(crate) fn conv2d(
    sources: &[&Tensor],
    weight: &Tensor,
    bias: Option<&Tensor>,
    residual: Option<&Tensor>,
    window: Window,
) -> Result<Tensor> {
    let joined;
    let sources = if sources.len() > 2 || (sources.len() == 2 && residual.is_some()) {
        joined = Tensor::cat(sources, 1)?;
        &[&joined][..]
    } else {
        sources
    };
    let mut operands: Vec<(Operand, Tensor)> = Vec::with_capacity(3);
    for source in sources {
        operands.push((Operand::Source, source.contiguous()?));
    }
    match bias {
        None => operands.push((Operand::Weight, weight.contiguous()?)),
        Some(bias) if sources.len() + usize::from(residual.is_some()) == 1 => {
            operands.push((Operand::Weight, weight.contiguous()?));
            operands.push((Operand::Bias, bias.contiguous()?));
        }
        Some(bias) => {
            let both = Tensor::cat(&[&weight.flatten_all()?, bias], 0)?;
            operands.push((Operand::WeightAndBias, both));
        }
    }
    if let Some(residual) = residual {
        operands.push((Operand::Residual, residual.contiguous()?));
    }
    let op = ConvCpu {
        window,
        outputs: weight.dim(0)?,
        operands: operands.iter().map(|(operand, _)| *operand).collect(),
    };
    match operands.as_slice() {
        [(_, a), (_, b)] => a.apply_op2(b, op),
        [(_, a), (_, b), (_, c)] => a.apply_op3(b, c, op),
        _ => unreachable!("between two and three operands are made above"),
    }
}

impl ConvCpu {
    fn geometry(&self, shapes: &[&Shape]) -> Result<Geometry> {
        let (batch, _, height, width) = shapes[0].dims4()?;
        let mut inputs = 0;
        for (operand, shape) in self.operands.iter().zip(shapes) {
            if *operand == Operand::Source {
                let (b, channels, h, w) = shape.dims4()?;
                if (b, h, w) != (batch, height, width) {
                    bail!("sources {:?} and {shape:?} do not go together", shapes[0]);
                }
                inputs += channels;
            }
        }
        let geometry = Geometry {
            batch,
            inputs,
            outputs: self.outputs,
            kernel: self.window.kernel,
            stride: self.window.stride,
            height,
            width,
        };
        let weights = self.outputs * geometry.taps();
        for (operand, shape) in self.operands.iter().zip(shapes) {
            let wanted = match operand {
                Operand::Source => continue,
                Operand::Weight => weights,
                Operand::WeightAndBias => weights + self.outputs,
                Operand::Bias => self.outputs,
                Operand::Residual => batch * geometry.out_len(),
            };
            if shape.elem_count() != wanted {
                bail!("{shape:?} does not fit a convolution of {geometry:?}");
            }
        }
        Ok(geometry)
    }

    /// Calls `work` with the operands as the kernel wants them.
    fn with_conv<R>(
        &self,
        geometry: Geometry,
        operands: &[&[f32]],
        work: impl FnOnce(&PlaneConv<'_>) -> R,
    ) -> R {
        let plane = geometry.batch * geometry.height * geometry.width;
        let weights = self.outputs * geometry.taps();
        let (mut sources, mut weight, mut bias, mut residual) = (Vec::new(), &[][..], None, None);
        for (operand, values) in self.operands.iter().zip(operands) {
            match operand {
                Operand::Source => sources.push((*values, values.len() / plane)),
                Operand::Weight => weight = values,
                Operand::WeightAndBias => {
                    let (first, second) = values.split_at(weights);
                    (weight, bias) = (first, Some(second));
                }
                Operand::Bias => bias = Some(values),
                Operand::Residual => residual = Some(*values),
            }
        }
        work(&PlaneConv {
            geometry,
            sources: &sources,
            weight,
            bias,
            residual,
            activation: self.window.activation,
            isa: *ISA,
        })
    }

    fn forward(&self, operands: &[(&CpuStorage, &Layout)]) -> Result<(CpuStorage, Shape)> {
        let shapes: Vec<&Shape> = operands.iter().map(|(_, layout)| layout.shape()).collect();
        let geometry = self.geometry(&shapes)?;
        let slices: Vec<&[f32]> = operands
            .iter()
            .map(|(storage, layout)| in_order(storage, layout))
            .collect::<Result<_>>()?;
        let out = self.with_conv(geometry, &slices, |conv| conv.forward());
        let shape = Shape::from((
            geometry.batch,
            geometry.outputs,
            geometry.out_height(),
            geometry.out_width(),
        ));
        Ok((CpuStorage::F32(out), shape))
    }

    /// Gradients of the operands, in order.
    fn backward(
        &self,
        operands: &[&Tensor],
        out: &Tensor,
        grad: &Tensor,
    ) -> Result<Vec<Option<Tensor>>> {
        let tracked = |wanted: &[Operand]| {
            let mut pairs = self.operands.iter().zip(operands);
            pairs.any(|(operand, tensor)| wanted.contains(operand) && tensor.track_op())
        };
        // Without an activation the residual's gradient is the output's.
        let passes_on = self.window.activation == Activation::None;
        let wanted = Wanted {
            sources: tracked(&[Operand::Source]),
            weight: tracked(&[Operand::Weight, Operand::WeightAndBias, Operand::Bias]),
            residual: tracked(&[Operand::Residual]) && !passes_on,
        };
        let shapes: Vec<&Shape> = operands.iter().map(|tensor| tensor.shape()).collect();
        let geometry = self.geometry(&shapes)?;
        let mut tensors = operands.to_vec();
        tensors.extend([out, grad]);
        let mut grads = all_values(&tensors, |values| {
            let (operands, results) = values.split_at(operands.len());
            self.with_conv(geometry, operands, |conv| {
                conv.backward(results[0], results[1], wanted)
            })
        })?;
        let mut sources = std::mem::take(&mut grads.sources).into_iter();
        let mut of = |operand: &Operand, tensor: &Tensor| {
            let values = match operand {
                Operand::Source => sources.next().unwrap_or_default(),
                Operand::Weight => std::mem::take(&mut grads.weight),
                Operand::WeightAndBias => {
                    let mut both = std::mem::take(&mut grads.weight);
                    both.append(&mut grads.bias);
                    both
                }
                Operand::Bias => std::mem::take(&mut grads.bias),
                Operand::Residual if passes_on => return Ok(Some(grad.clone())),
                Operand::Residual => std::mem::take(&mut grads.residual),
            };
            if !tensor.track_op() {
                return Ok(None);
            }
            Tensor::from_vec(values, tensor.shape(), tensor.device()).map(Some)
        };
        let pairs = self.operands.iter().zip(operands);
        pairs.map(|(operand, tensor)| of(operand, tensor)).collect()
    }
}

impl CustomOp2 for ConvCpu {
    fn name(&self) -> &'static str {
        "conv"
    }

    fn cpu_fwd(
        &self,
        a: &CpuStorage,
        a_layout: &Layout,
        b: &CpuStorage,
        b_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        self.forward(&[(a, a_layout), (b, b_layout)])
    }

    fn bwd(
        &self,
        a: &Tensor,
        b: &Tensor,
        out: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let mut grads = self.backward(&[a, b], out, grad)?.into_iter();
        Ok((grads.next().flatten(), grads.next().flatten()))
    }
}

impl CustomOp3 for ConvCpu {
    fn name(&self) -> &'static str {
        "conv"
    }

    fn cpu_fwd(
        &self,
        a: &CpuStorage,
        a_layout: &Layout,
        b: &CpuStorage,
        b_layout: &Layout,
        c: &CpuStorage,
        c_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        self.forward(&[(a, a_layout), (b, b_layout), (c, c_layout)])
    }

    fn bwd(
        &self,
        a: &Tensor,
        b: &Tensor,
        c: &Tensor,
        out: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let mut grads = self.backward(&[a, b, c], out, grad)?.into_iter();
        let mut next = || grads.next().flatten();
        Ok((next(), next(), next()))
    }
}

#[cfg(test)]
mod tests {
    use candle_core::{Device, Var};

    use super::*;

    fn pattern(shape: &[usize]) -> Tensor {
        let len: usize = shape.iter().product();
        let values = (0..len)
            .map(|i| ((i * 7919 + 13) % 1009) as f32 / 504.5 - 1.0)
            .collect();
        Tensor::from_vec::<_, f32>(values, shape, &Device::Cpu).unwrap()
    }

    fn assert_close(got: &Tensor, wanted: &Tensor, what: &str) {
        assert_eq!(got.dims(), wanted.dims(), "{what}");
        let read = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        for (g, w) in read(got).iter().zip(read(wanted)) {
            assert!((g - w).abs() <= 2e-4 * w.abs().max(1.0), "{what}: {g} {w}");
        }
    }

    /// Candle's own operations and gradients are the reference, for every arrangement of operands.
    #[test]
    fn every_arrangement_equals_candles_operations() {
        for (sources, has_bias, has_residual) in [
            (1, false, false),
            (1, true, false),
            (1, false, true),
            (1, true, true),
            (2, false, false),
            (2, true, false),
            (2, true, true),
        ] {
            for (kernel, stride) in [(1, 1), (3, 1), (3, 2), (5, 1)] {
                let (h, w) = (10, 14);
                let window = Window {
                    kernel,
                    stride,
                    activation: Activation::Tanh,
                };
                let shapes = [[2, 3, h, w], [2, 2, h, w]];
                let var = |shape: &[usize]| Var::from_tensor(&pattern(shape)).unwrap();
                let vars: Vec<Var> = shapes[..sources].iter().map(|shape| var(shape)).collect();
                let inputs = [3, 5][sources - 1];
                let weight = var(&[4, inputs, kernel, kernel]);
                let bias = var(&[4]);
                let residual = var(&[2, 4, h / stride, w / stride]);
                let refs: Vec<&Tensor> = vars.iter().map(Var::as_tensor).collect();
                let ours = conv2d(
                    &refs,
                    &weight,
                    has_bias.then_some(&*bias),
                    has_residual.then_some(&*residual),
                    window,
                )
                .unwrap();
                let joined = Tensor::cat(&refs, 1).unwrap();
                let mut theirs = joined.conv2d(&weight, kernel / 2, stride, 1, 1).unwrap();
                if has_bias {
                    let bias = bias.reshape((1, 4, 1, 1)).unwrap();
                    theirs = theirs.broadcast_add(&bias).unwrap();
                }
                if has_residual {
                    theirs = (theirs + residual.as_tensor()).unwrap();
                }
                let theirs = theirs.tanh().unwrap();
                assert_close(&ours, &theirs, "value");
                let weigh = |y: &Tensor| (y * pattern(y.dims())).unwrap().sum_all().unwrap();
                let (ours, theirs) = (
                    weigh(&ours).backward().unwrap(),
                    weigh(&theirs).backward().unwrap(),
                );
                let all = vars.iter().chain([&weight, &bias, &residual]);
                for var in all {
                    match (ours.get(var), theirs.get(var)) {
                        (None, None) => {}
                        (Some(ours), Some(theirs)) => assert_close(ours, theirs, "gradient"),
                        _ => panic!("only one of the two has a gradient"),
                    }
                }
            }
        }
    }

    #[test]
    fn operands_that_do_not_fit_are_refused() {
        let window = Window {
            kernel: 3,
            stride: 1,
            activation: Activation::None,
        };
        let (x, weight) = (pattern(&[1, 3, 4, 4]), pattern(&[2, 4, 3, 3]));
        let error = conv2d(&[&x], &weight, None, None, window).unwrap_err();
        assert!(error.to_string().contains("does not fit"), "{error}");
    }
}

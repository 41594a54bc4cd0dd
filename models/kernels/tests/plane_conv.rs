//! Convolutions on planes and their gradients against the definition in double precision, on
//! every instruction set and on awkward sizes.

use noctule_kernels::{Activation, Geometry, Isa, PlaneConv, Wanted};
use proptest::prelude::*;

fn pattern(len: usize, salt: usize) -> Vec<f32> {
    let value = |i: usize| ((i * 7919 + salt * 104_729 + 13) % 2003) as f32 / 1001.0 - 1.0;
    (0..len).map(value).collect()
}

struct Case {
    geometry: Geometry,
    /// Channels of the second source.
    second: usize,
    activation: Activation,
    has_bias: bool,
    has_residual: bool,
}

struct Operands {
    sources: Vec<(Vec<f32>, usize)>,
    weight: Vec<f32>,
    bias: Vec<f32>,
    residual: Vec<f32>,
    /// Gradient of the output.
    grad: Vec<f32>,
}

impl Case {
    fn operands(&self) -> Operands {
        let g = &self.geometry;
        let plane = g.batch * g.height * g.width;
        let counts = [g.inputs - self.second, self.second];
        let counts = counts.iter().filter(|count| **count > 0);
        let source = |(i, count): (usize, &usize)| (pattern(count * plane, i), *count);
        Operands {
            sources: counts.enumerate().map(source).collect(),
            weight: pattern(g.outputs * g.taps(), 3),
            bias: pattern(g.outputs, 4),
            residual: pattern(g.batch * g.out_len(), 5),
            grad: pattern(g.batch * g.out_len(), 6),
        }
    }

    /// Visits output, weight and input index of every product of the convolution.
    fn products(&self, mut visit: impl FnMut(usize, usize, (usize, usize, usize))) {
        let g = &self.geometry;
        let (out_h, out_w, k) = (g.out_height(), g.out_width(), g.kernel);
        for (n, o) in (0..g.batch).flat_map(|n| (0..g.outputs).map(move |o| (n, o))) {
            for (y, x) in (0..out_h).flat_map(|y| (0..out_w).map(move |x| (y, x))) {
                for (i, ky) in (0..g.inputs).flat_map(|i| (0..k).map(move |ky| (i, ky))) {
                    for kx in 0..k {
                        let row = (y * g.stride + ky).wrapping_sub(k / 2);
                        let column = (x * g.stride + kx).wrapping_sub(k / 2);
                        if row < g.height && column < g.width {
                            visit(
                                ((n * g.outputs + o) * out_h + y) * out_w + x,
                                ((o * g.inputs + i) * k + ky) * k + kx,
                                (n, i, row * g.width + column),
                            );
                        }
                    }
                }
            }
        }
    }

    /// Source and index in it of an input value.
    fn place(&self, (n, i, pixel): (usize, usize, usize)) -> (usize, usize) {
        let g = &self.geometry;
        let plane = g.height * g.width;
        let first = g.inputs - self.second;
        if i < first {
            (0, (n * first + i) * plane + pixel)
        } else {
            (1, (n * self.second + i - first) * plane + pixel)
        }
    }

    fn check(&self, isa: Isa) {
        let (g, operands) = (&self.geometry, self.operands());
        let sources: Vec<(&[f32], usize)> = operands
            .sources
            .iter()
            .map(|(values, count)| (values.as_slice(), *count))
            .collect();
        let conv = PlaneConv {
            geometry: *g,
            sources: &sources,
            weight: &operands.weight,
            bias: self.has_bias.then_some(&operands.bias),
            residual: self.has_residual.then_some(&operands.residual),
            activation: self.activation,
            isa,
        };
        let plane = g.out_height() * g.out_width();
        let mut sums: Vec<f64> = (0..g.batch * g.out_len())
            .map(|at| {
                let bias = f64::from(operands.bias[at / plane % g.outputs]);
                let residual = f64::from(operands.residual[at]);
                f64::from(u8::from(self.has_bias)) * bias
                    + f64::from(u8::from(self.has_residual)) * residual
            })
            .collect();
        self.products(|out, weight, input| {
            let (source, at) = self.place(input);
            let x = f64::from(operands.sources[source].0[at]);
            sums[out] += x * f64::from(operands.weight[weight]);
        });
        let wanted: Vec<f64> = sums.iter().map(|x| self.activation.exact(*x)).collect();
        let out = conv.forward();
        // No activation is steeper than one: the sums' rounding bounds that of what it returns.
        self.compare_at(largest(&sums), "forward", isa, &out, &wanted);

        let inner: Vec<f64> = (0..out.len())
            .map(|at| f64::from(operands.grad[at]) * slope(self.activation, f64::from(out[at])))
            .collect();
        let mut source_grads: Vec<Vec<f64>> = operands
            .sources
            .iter()
            .map(|(values, _)| vec![0.0; values.len()])
            .collect();
        let mut weight_grads = vec![0.0; operands.weight.len()];
        self.products(|out, weight, input| {
            let (source, at) = self.place(input);
            source_grads[source][at] += inner[out] * f64::from(operands.weight[weight]);
            weight_grads[weight] += inner[out] * f64::from(operands.sources[source].0[at]);
        });
        let mut bias_grads = vec![0.0; g.outputs];
        for (at, inner) in inner.iter().enumerate() {
            bias_grads[at / plane % g.outputs] += inner;
        }
        let all = Wanted {
            sources: true,
            weight: true,
            residual: true,
        };
        let grads = conv.backward(&out, &operands.grad, all);
        assert_eq!(grads.sources.len(), source_grads.len());
        for (got, wanted) in grads.sources.iter().zip(&source_grads) {
            self.compare("source", isa, got, wanted);
        }
        self.compare("weight", isa, &grads.weight, &weight_grads);
        self.compare("bias", isa, &grads.bias, &bias_grads);
        self.compare("residual", isa, &grads.residual, &inner);
    }

    fn compare(&self, what: &str, isa: Isa, got: &[f32], wanted: &[f64]) {
        self.compare_at(largest(wanted), what, isa, got, wanted);
    }

    fn compare_at(&self, scale: f64, what: &str, isa: Isa, got: &[f32], wanted: &[f64]) {
        assert_eq!(got.len(), wanted.len(), "{what}");
        for (i, (g, w)) in got.iter().zip(wanted).enumerate() {
            assert!(
                (f64::from(*g) - w).abs() <= 1e-5 * scale,
                "{what} on {isa}, {:?} {:?}: value {i} is {g}, wanted {w} of {scale}",
                self.geometry,
                self.activation,
            );
        }
    }
}

fn largest(values: &[f64]) -> f64 {
    values.iter().fold(1f64, |most, x| most.max(x.abs()))
}

/// Slope of an activation from what it returned.
fn slope(activation: Activation, y: f64) -> f64 {
    match activation {
        Activation::None => 1.0,
        Activation::Relu => f64::from(u8::from(y > 0.0)),
        Activation::LeakyRelu => 0.1 + 0.9 * f64::from(u8::from(y > 0.0)),
        Activation::Tanh => 1.0 - y * y,
        Activation::Sigmoid => y * (1.0 - y),
    }
}

const ACTIVATIONS: [Activation; 5] = [
    Activation::None,
    Activation::Relu,
    Activation::LeakyRelu,
    Activation::Tanh,
    Activation::Sigmoid,
];

fn available() -> impl Iterator<Item = Isa> {
    Isa::ALL.into_iter().filter(|isa| isa.is_available())
}

/// Every kernel and stride on pictures of one pixel, narrower than the window, odd, of exactly
/// one vector, and of several stretches.
#[test]
fn sizes_of_every_kind() {
    let sizes = [
        (1, 1),
        (2, 3),
        (5, 1),
        (5, 43),
        (7, 10),
        (8, 8),
        (6, 16),
        (17, 33),
        (37, 130),
    ];
    for (height, width) in sizes {
        for (kernel, stride) in [(1, 1), (1, 2), (3, 1), (3, 2), (5, 1), (5, 2)] {
            for (inputs, outputs) in [(1, 1), (3, 5), (4, 4), (5, 2)] {
                let case = Case {
                    geometry: Geometry {
                        batch: 2,
                        inputs,
                        outputs,
                        kernel,
                        stride,
                        height,
                        width,
                    },
                    second: inputs / 2,
                    activation: Activation::LeakyRelu,
                    has_bias: true,
                    has_residual: false,
                };
                available().for_each(|isa| case.check(isa));
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]

    #[test]
    fn any_convolution_and_its_gradients_are_the_definitions(
        (batch, inputs, outputs) in (1..4usize, 1..14usize, 1..14usize),
        (reach, stride) in (0..3usize, 1..3usize),
        (height, width) in (1..24usize, 1..50usize),
        (second, activation) in (0..14usize, 0..5usize),
        (has_bias, has_residual) in (any::<bool>(), any::<bool>()),
    ) {
        let case = Case {
            geometry: Geometry {
                batch,
                inputs,
                outputs,
                kernel: 2 * reach + 1,
                stride,
                height,
                width,
            },
            second: second % inputs,
            activation: ACTIVATIONS[activation],
            has_bias,
            has_residual,
        };
        available().for_each(|isa| case.check(isa));
    }
}

//! Convolutions of every form against double precision, on every instruction set, over widths
//! that leave every remainder of a tile.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

mod oracle;

use noctule_kernels::{Activation, Builder, Conv, Intake, Options, Size, Store, reference};
use oracle::{assert_close, every_way, noise, size, wide};

/// One convolution with everything that may follow it.
#[derive(Debug, Clone)]
struct Case {
    size: Size,
    inputs: Vec<usize>,
    outputs: usize,
    kernel: usize,
    stride: usize,
    gain: bool,
    residual: bool,
    activation: Activation,
    store: Store,
}

impl Case {
    fn plain(size: Size, inputs: usize, outputs: usize) -> Self {
        Self {
            size,
            inputs: vec![inputs],
            outputs,
            kernel: 3,
            stride: 1,
            gain: false,
            residual: false,
            activation: Activation::None,
            store: Store::Direct,
        }
    }

    fn out_size(&self) -> Size {
        let side = |side: usize| side.div_ceil(self.stride) * self.store.scale();
        size(side(self.size.height), side(self.size.width))
    }

    fn weight_outputs(&self) -> usize {
        self.outputs * if self.store == Store::Shuffle { 4 } else { 1 }
    }

    /// Runs the kernel and its reference on the same noise.
    fn check(&self, options: Options) {
        let total: usize = self.inputs.iter().sum();
        let x = noise(total * self.size.area(), 1);
        let weight = noise(self.weight_outputs() * total * self.kernel * self.kernel, 2);
        let bias = noise(self.weight_outputs(), 3);
        let out = self.out_size();
        let gain = noise(self.outputs * out.area(), 4);
        let residual = noise(self.outputs * out.area(), 5);

        let mut builder = Builder::new();
        let mut features = Vec::new();
        let mut slices: Vec<&[f32]> = Vec::new();
        let mut rest = &x[..];
        for &channels in &self.inputs {
            let (slice, after) = rest.split_at(channels * self.size.area());
            rest = after;
            let input = builder.input(slice.len());
            let feature = builder.feature(channels, self.size);
            builder.take(input, Intake::Planes, feature);
            slices.push(slice);
            features.push(feature);
        }
        let mut other = |values, wanted: bool| {
            wanted.then(|| {
                let input = builder.input(self.outputs * out.area());
                let feature = builder.feature(self.outputs, out);
                builder.take(input, Intake::Planes, feature);
                slices.push(values);
                feature
            })
        };
        let (gain_feature, residual_feature) =
            (other(&gain, self.gain), other(&residual, self.residual));
        let target = builder.feature(self.outputs, out);
        builder.conv(&Conv {
            inputs: &features,
            weight: &weight,
            bias: &bias,
            kernel: self.kernel,
            stride: self.stride,
            gain: gain_feature,
            residual: residual_feature,
            activation: self.activation,
            store: self.store,
            output: target,
        });
        let output = builder.output(self.outputs * out.area());
        builder.give(target, output);
        let mut got = vec![f32::NAN; self.outputs * out.area()];
        let mut program = builder.finish(options).unwrap();
        program.poison();
        program.run(0, 0, &slices, &mut [&mut got]).unwrap();

        let (weight, bias) = (wide(&weight), wide(&bias));
        let mut wanted = reference::conv2d(
            &wide(&x),
            self.size,
            &weight,
            &bias,
            self.kernel,
            self.stride,
        );
        wanted = match self.store {
            Store::Direct => wanted,
            Store::Shuffle => reference::shuffle(&wanted, self.size),
            Store::Nearest => reference::nearest(&wanted, self.size),
        };
        for (index, value) in wanted.iter_mut().enumerate() {
            if self.gain {
                *value *= f64::from(gain[index]);
            }
            if self.residual {
                *value += f64::from(residual[index]);
            }
            *value = self.activation.exact(*value);
        }
        assert_close(&got, &wanted, options, 1.0, &format!("{self:?}"));
    }
}

#[test]
fn every_width_leaves_the_right_remainder() {
    // Output channels of one, two and three blocks, and a group of three beside one of two.
    let outputs = [1, 16, 17, 40, 70];
    for options in every_way() {
        for width in 1..=34 {
            let outputs = outputs[width % outputs.len()];
            let height = 1 + width % 3;
            Case::plain(size(height, width), 1 + width % 5, outputs).check(options);
            let halving = Case {
                stride: 2,
                ..Case::plain(size(height + 1, width), 2, outputs)
            };
            halving.check(options);
        }
    }
}

#[test]
fn every_kernel_and_stride_meets_odd_sizes_and_channels() {
    for options in every_way() {
        for (kernel, stride) in [(1, 1), (1, 2), (3, 1), (3, 2), (5, 1), (5, 2), (7, 1)] {
            for (height, width) in [(1, 1), (2, 9), (7, 5), (6, 20)] {
                for (inputs, outputs) in [(1, 3), (16, 32), (19, 33), (35, 8)] {
                    let case = Case {
                        kernel,
                        stride,
                        ..Case::plain(size(height, width), inputs, outputs)
                    };
                    case.check(options);
                }
            }
        }
    }
}

#[test]
fn several_inputs_read_as_one_concatenation() {
    for options in every_way() {
        for inputs in [vec![24, 5], vec![3, 16, 17], vec![1, 1, 1]] {
            let case = Case {
                inputs,
                ..Case::plain(size(5, 15), 0, 24)
            };
            case.check(options);
        }
    }
}

#[test]
fn gain_residual_activation_and_store_follow_the_sum() {
    use Activation::{LeakyRelu, None, Relu, Sigmoid, Tanh};
    for options in every_way() {
        for activation in [None, Relu, LeakyRelu, Tanh, Sigmoid] {
            for store in [Store::Direct, Store::Shuffle, Store::Nearest] {
                for (gain, residual) in [(false, true), (true, false), (true, true)] {
                    let case = Case {
                        kernel: 1,
                        activation,
                        store,
                        gain,
                        residual,
                        ..Case::plain(size(3, 11), 6, 20)
                    };
                    case.check(options);
                }
            }
        }
    }
}

#[test]
fn few_outputs_share_the_lanes_with_their_inputs() {
    for options in every_way() {
        for outputs in 1..=9 {
            for inputs in [vec![1], vec![2, 3], vec![5], vec![8], vec![16, 7]] {
                for (kernel, stride) in [(3, 1), (3, 2), (1, 1)] {
                    let case = Case {
                        inputs: inputs.clone(),
                        kernel,
                        stride,
                        residual: outputs % 2 == 0,
                        activation: Activation::LeakyRelu,
                        store: if outputs % 3 == 0 && stride == 1 {
                            Store::Nearest
                        } else {
                            Store::Direct
                        },
                        ..Case::plain(size(3, 16 + outputs), 0, outputs)
                    };
                    case.check(options);
                }
            }
        }
    }
}

#[test]
fn wide_layers_keep_the_gate() {
    // 2304 terms per sum, and weights beyond the second-level cache.
    for options in every_way() {
        Case::plain(size(4, 16), 256, 96).check(options);
    }
}

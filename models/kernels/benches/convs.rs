//! GFLOP/s of single layers beside the processor's own peak, measured in the same run.
//!
//! `cargo bench -p noctule-kernels`; one thread, best of several rounds. A layer's rate counts its
//! own multiply-adds, not those spent on padded lanes.
#![allow(clippy::print_stdout, reason = "the program's purpose is to print")]
#![allow(clippy::cast_precision_loss, reason = "operation counts fit a double")]

use std::time::Instant;

use noctule_kernels::{
    Activation, Builder, Conv, Intake, Isa, Options, Passes, Precision, Program, Size, Store, spin,
};

const ROUNDS: usize = 9;

/// One convolution at a square input.
struct Layer {
    inputs: usize,
    outputs: usize,
    side: usize,
    kernel: usize,
    stride: usize,
}

const fn layer(inputs: usize, outputs: usize, side: usize, kernel: usize, stride: usize) -> Layer {
    Layer {
        inputs,
        outputs,
        side,
        kernel,
        stride,
    }
}

const LAYERS: [Layer; 12] = [
    layer(64, 64, 128, 3, 1),
    layer(128, 128, 64, 3, 1),
    layer(256, 256, 32, 3, 1),
    layer(32, 32, 256, 3, 1),
    layer(128, 128, 64, 1, 1),
    layer(64, 128, 128, 3, 2),
    layer(192, 64, 128, 3, 1),
    layer(48, 48, 128, 3, 1),
    layer(384, 384, 16, 3, 1),
    layer(16, 16, 256, 3, 1),
    layer(16, 32, 256, 3, 2),
    layer(2, 16, 256, 5, 1),
];

impl Layer {
    fn flop(&self) -> f64 {
        let side = self.side / self.stride;
        let terms = self.inputs * self.kernel * self.kernel;
        (2 * side * side * self.outputs * terms) as f64
    }

    /// The layer alone is pass 1; its input is state, filled by pass 0.
    fn program(&self, options: Options) -> Program {
        let square = |side| Size {
            height: side,
            width: side,
        };
        let weight: Vec<f32> = (0..self.outputs * self.inputs * self.kernel * self.kernel)
            .map(|i| (i % 17) as f32 / 170.0 - 0.05)
            .collect();
        let mut builder = Builder::new();
        let input = builder.input(self.inputs * self.side * self.side);
        let x = builder.state(self.inputs, square(self.side));
        let y = builder.feature(self.outputs, square(self.side / self.stride));
        builder.take(input, Intake::Planes, x);
        builder.set_passes(Passes::of(&[1]));
        builder.conv(&Conv {
            inputs: &[x],
            weight: &weight,
            bias: &vec![0.0; self.outputs],
            kernel: self.kernel,
            stride: self.stride,
            gain: None,
            residual: None,
            activation: Activation::Relu,
            store: Store::Direct,
            output: y,
        });
        builder
            .finish(options)
            .expect("the layers of the table are well formed")
    }

    /// GFLOP/s.
    fn rate(&self, options: Options) -> f64 {
        let mut program = self.program(options);
        let x = vec![0.25; self.inputs * self.side * self.side];
        program
            .run(0, 0, &[&x], &mut [])
            .expect("the slice has the length of the input");
        let seconds = best(|| {
            program
                .run(1, 0, &[], &mut [])
                .expect("the pass takes no slices");
        });
        self.flop() / seconds / 1e9
    }
}

/// Shortest of several runs, in seconds.
fn best(mut run: impl FnMut()) -> f64 {
    run();
    let rounds = (0..ROUNDS).map(|_| {
        let started = Instant::now();
        run();
        started.elapsed().as_secs_f64()
    });
    rounds.fold(f64::INFINITY, f64::min)
}

/// GFLOP/s of multiply-adds on registers.
fn peak(options: Options) -> f64 {
    let mut flop = 0;
    let seconds = best(|| flop = spin(options.isa, options.precision, 1_000_000).unwrap_or(0));
    flop as f64 / seconds / 1e9
}

fn main() {
    for (isa, precision) in [
        (Isa::Avx512, Precision::Single),
        (Isa::Avx512Bf16, Precision::Brain),
        (Isa::Avx2, Precision::Single),
    ] {
        if !isa.is_available() {
            println!("{isa}: not on this processor");
            continue;
        }
        let options = Options {
            threads: 1,
            precision,
            isa,
        };
        let before = peak(options);
        let rates: Vec<f64> = LAYERS.iter().map(|layer| layer.rate(options)).collect();
        let peak = before.max(peak(options));
        println!("{isa} {precision:?}: peak {peak:.0} GFLOP/s");
        for (layer, rate) in LAYERS.iter().zip(rates) {
            let Layer {
                inputs,
                outputs,
                side,
                kernel,
                stride,
            } = layer;
            println!(
                "  {inputs:>3}-{outputs:<3} {kernel}x{kernel} stride {stride} @{side:<3} \
                 {rate:7.1} GFLOP/s {:5.1} % of peak",
                100.0 * rate / peak
            );
        }
    }
}

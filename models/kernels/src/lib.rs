//! Kernels and compiled programs for small convolutional networks on processors.
//!
//! Features lie in blocks of sixteen channels with a margin of zeros; convolutions run directly on
//! them with bias, residual, activation and store in one pass, in single precision or bfloat16, on
//! AVX-512, AVX2 or plain Rust, chosen at run time. A [`Builder`] collects the operations of a
//! network; the [`Program`] it makes runs them over one arena on one or more threads without
//! allocating. This crate knows no network, no weights file and no tensor library.
//!
//! ```
//! use noctule_kernels::{Activation, Builder, Conv, Intake, Options, Size, Store};
//!
//! let size = Size { height: 4, width: 6 };
//! let mut builder = Builder::new();
//! let (input, output) = (builder.input(24), builder.output(2 * 24));
//! let (x, y) = (builder.feature(1, size), builder.feature(2, size));
//! builder.take(input, Intake::Planes, x);
//! builder.conv(&Conv {
//!     inputs: &[x],
//!     weight: &[2.0, 3.0],
//!     bias: &[0.0, 1.0],
//!     kernel: 1,
//!     stride: 1,
//!     gain: None,
//!     residual: None,
//!     activation: Activation::Relu,
//!     store: Store::Direct,
//!     output: y,
//! });
//! builder.give(y, output);
//! let mut program = builder.finish(Options::default())?;
//! let mut planes = [0.0; 48];
//! program.run(0, 0, &[&[0.5; 24]], &mut [&mut planes])?;
//! assert_eq!((planes[0], planes[47]), (1.0, 2.5));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! `unsafe` is confined to this crate. Its kernels trust three things, all established when a
//! program is built: the processor has the instructions, every offset lies within the arena, and
//! no two threads touch the same rows between two barriers.
//!
//! Training works on plain planes instead ([`PlaneConv`], [`PlaneFilter`], [`adam_update`]): each
//! call checks its operands, runs on rayon's current pool and gives the same bits on any number of
//! threads.

mod activation;
mod conv;
mod element;
mod garf;
mod gate;
mod grad;
mod isa;
mod layout;
mod memory;
mod peak;
mod planar;
mod program;
pub mod reference;
mod simd;
mod spec;

pub use activation::Activation;
pub use conv::Store;
pub use grad::{AdamRates, ConvGrads, Geometry, PlaneConv, PlaneFilter, Wanted, adam_update};
pub use isa::Isa;
pub use layout::Size;
pub use peak::{spin, stream};
pub use planar::Intake;
pub use program::{Builder, OpProfile, Program, RunError};
pub use spec::{
    Between, BuildError, Conv, Emit, Feature, Garf, Gate, Input, Options, Output, Passes, Plane,
    Precision, THREADS_MAX,
};

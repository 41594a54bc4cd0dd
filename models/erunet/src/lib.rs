//! ERU-Net in candle: depth in the dark from one blurred picture, events and sparse returns.
//!
//! The network restores a sharp feature for each of T steps of an exposure (`efr`) and completes
//! the sparse depth of each step under its guidance (`rdu`). Sizes come from a [`Config`], numbers
//! from a [`Weights`] file in safetensors; names and shapes are those of the PyTorch reference, and
//! [`parity`] compares the two feature by feature. This crate knows tensors: no sensors, no clocks.
//!
//! ```
//! use candle_core::{Device, DType, Tensor};
//! use noctule_erunet::{Config, Network, Norms, Weights};
//!
//! let config = Config::tiny();
//! let weights = Weights::initial(&config, 7, &Device::Cpu)?;
//! let network = Network::new(&config, &weights, Norms::Fold)?;
//! let zeros = |c: usize| Tensor::zeros((1, c, 16, 32), DType::F32, &Device::Cpu);
//! let mut sequence = network.begin(&zeros(3)?, None)?;
//! let step = sequence.step(&zeros(5)?, &zeros(1)?)?;
//! assert_eq!(step.depth.dims(), [1, 1, 16, 32]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
#![forbid(unsafe_code)]

mod accounting;
mod activate;
mod adam;
mod blocks;
mod config;
mod conv;
mod conv_cpu;
mod efr;
mod grow;
mod init;
mod mix;
mod network;
mod norm;
mod norm_cpu;
mod params;
mod parity;
mod parts;
mod pass;
mod plan;
mod planes;
mod prefill;
mod rdu;
mod sequence;
mod slices;
mod weights;
mod window;

pub use accounting::{Description, ModuleCost, describe};
pub use adam::{Adam, AdamError, AdamOptions, AdamState};
pub use config::{
    COUNT_MAX, Config, ConfigError, DEPTH_MAX_M, Form, SIDE_MULTIPLE, Variant, WIDTH_MAX,
};
pub use network::{Network, NetworkError, Outputs};
pub use noctule_depth::Ground;
pub use params::{Init, Norms, Role, Slot};
pub use parity::{
    DEPTH_GATE_M, FEATURE_GATE, ParityError, ParityReport, TensorParity, fixture_config, parity,
    parity_on,
};
pub use parts::slots;
pub use pass::{Moments, Pass};
pub use plan::{LayerProfile, Plan, PlanError, PlanOptions};
pub use prefill::{FALLBACK_SHARE, LOG_SPAN};
pub use sequence::{Sequence, Step};
pub use weights::{FILE_BYTES_MAX, Fault, Weights, WeightsError};

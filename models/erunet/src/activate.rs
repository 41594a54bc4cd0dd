//! Activations in tensor operations, with a correct backward pass.

use candle_core::{Result, Tensor};
use noctule_kernels::Activation;

/// Slope of the leaky rectifier left of zero.
pub(crate) const SLOPE: f64 = 0.1;

/// An activation in tensor operations, any shape.
pub(crate) fn activate(x: &Tensor, activation: Activation) -> Result<Tensor> {
    match activation {
        Activation::None => Ok(x.clone()),
        Activation::Relu => relu(x),
        Activation::LeakyRelu => leaky_relu(x),
        Activation::Tanh => x.tanh(),
        Activation::Sigmoid => sigmoid(x),
    }
}

/// `max(x, 0.1 x)`, any shape.
pub(crate) fn leaky_relu(x: &Tensor) -> Result<Tensor> {
    rectify(x, SLOPE)
}

/// `max(x, 0)`, any shape.
pub(crate) fn relu(x: &Tensor) -> Result<Tensor> {
    if x.track_op() {
        rectify(x, 0.0)
    } else {
        x.relu()
    }
}

/// The slope at exactly zero is the left one: sparse inputs put many pixels there, and candle's
/// own rectifier would take the right one.
fn rectify(x: &Tensor, slope: f64) -> Result<Tensor> {
    let left = (x * slope)?;
    if x.track_op() {
        x.gt(0f32)?.where_cond(x, &left)
    } else {
        x.maximum(&left)
    }
}

/// Logistic function through the hyperbolic tangent: neither value nor gradient overflows.
pub(crate) fn sigmoid(x: &Tensor) -> Result<Tensor> {
    (x * 0.5)?.tanh()?.affine(0.5, 0.5)
}

//! Networks as they are named on a command line.

use std::path::Path;

use candle_core::Device;
use noctule::config::SHIPPED;
use noctule::infer::shipped_weights;
use noctule_erunet::Weights;

use super::Failure;

/// The weights of a network that is part of the program, or those in a file.
pub fn weights(name: &str) -> Result<Weights, Failure> {
    if let Some(own) = name.parse().ok().and_then(shipped_weights) {
        return Ok(Weights::from_bytes(own, &Device::Cpu)?);
    }
    let path = Path::new(name);
    if !path.exists() {
        let shipped: Vec<&str> = SHIPPED.iter().map(|model| model.name()).collect();
        let reason = format!("{name}: no such weights file; of the networks, {shipped:?} ship");
        return Err(Failure::Error(reason.into()));
    }
    let read = Weights::read(path, &Device::Cpu);
    read.map_err(|cause| Failure::Error(format!("{name}: {cause}").into()))
}

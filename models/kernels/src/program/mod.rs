//! A fixed sequence of kernels over one arena: built once, then run without allocating.

mod arena;
mod builder;
mod costs;
mod crew;
mod executable;
#[cfg(test)]
mod handshake;
mod lower;
mod profile;
mod run;

pub use builder::Builder;
pub use profile::OpProfile;
pub use run::{Program, RunError};

//! Noctule.
pub mod bus;
pub mod frame;
pub mod lane;
pub mod latency;

//! Depth maps without a network: nearest, fill, metrics, colour.

//! The recording directory: what the sensors delivered, byte for byte.

//! Streams made up here: random, damaged and encoded ones, against a plain model.

mod broken;
mod model;
mod round_trip;

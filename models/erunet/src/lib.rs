//! ERU-Net in candle.

//! Hesai LiDAR packets to returns and sweeps, and back.

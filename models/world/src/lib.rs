//! The synthetic night: sensor bytes with exact truth.

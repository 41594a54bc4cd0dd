//! Whole processes under load and faults.

//! Races against other implementations, in one run.

//! Prophesee EVK4: EVT words to events and trigger edges, and back.

//! Vehicle motion from CAN frames by configurable signals.

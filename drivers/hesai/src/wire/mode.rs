//! Which echoes a packet holds, and in which order.

use super::Model;

/// Return mode, as the tail's byte says.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ReturnMode {
    /// 0x33: the first echo.
    First,
    /// 0x34: the second echo.
    Second,
    /// 0x37: the strongest echo.
    Strongest,
    /// 0x38: the last echo.
    Last,
    /// 0x39: the last and the strongest; where they coincide, the last and the second strongest.
    LastStrongest,
    /// 0x3A: the first and the second.
    FirstSecond,
    /// 0x3B: the first and the last.
    FirstLast,
    /// 0x3C: the first and the strongest.
    FirstStrongest,
    /// 0x3D: three echoes, XT32M only.
    Triple,
    /// 0x3E: the strongest and the second strongest.
    StrongestSecond,
}

/// Which of a firing's echoes a return is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Echo {
    /// The nearest.
    First,
    /// The second nearest.
    Second,
    /// The farthest.
    Last,
    /// The brightest.
    Strongest,
    /// The second brightest.
    SecondStrongest,
}

impl ReturnMode {
    /// The mode of that byte; `None` for a byte no manual lists.
    #[must_use]
    pub const fn from_byte(byte: u8) -> Option<Self> {
        Some(match byte {
            0x33 => Self::First,
            0x34 => Self::Second,
            0x37 => Self::Strongest,
            0x38 => Self::Last,
            0x39 => Self::LastStrongest,
            0x3a => Self::FirstSecond,
            0x3b => Self::FirstLast,
            0x3c => Self::FirstStrongest,
            0x3d => Self::Triple,
            0x3e => Self::StrongestSecond,
            _ => return None,
        })
    }

    /// The byte on the wire.
    #[must_use]
    pub const fn byte(self) -> u8 {
        match self {
            Self::First => 0x33,
            Self::Second => 0x34,
            Self::Strongest => 0x37,
            Self::Last => 0x38,
            Self::LastStrongest => 0x39,
            Self::FirstSecond => 0x3a,
            Self::FirstLast => 0x3b,
            Self::FirstStrongest => 0x3c,
            Self::Triple => 0x3d,
            Self::StrongestSecond => 0x3e,
        }
    }

    /// Blocks that share one firing: 1, 2 or 3.
    #[must_use]
    pub const fn returns(self) -> usize {
        match self {
            Self::First | Self::Second | Self::Strongest | Self::Last => 1,
            Self::Triple => 3,
            _ => 2,
        }
    }

    /// Which echo each block of a firing holds, in the order of the blocks.
    ///
    /// The order is the mode's, not that of header byte 8, which contradicts real QT64 packets.
    /// The XT family stores the last before the first in mode 0x3B, unlike QT and Pandar.
    #[must_use]
    pub const fn echoes(self, model: Model) -> &'static [Echo] {
        use Echo::{First, Last, Second, SecondStrongest, Strongest};
        let xt = matches!(model, Model::Xt16 | Model::Xt32 | Model::Xt32m);
        match self {
            Self::First => &[First],
            Self::Second => &[Second],
            Self::Strongest => &[Strongest],
            Self::Last => &[Last],
            Self::LastStrongest => &[Last, Strongest],
            Self::FirstSecond => &[First, Second],
            Self::FirstLast if xt => &[Last, First],
            Self::FirstLast => &[First, Last],
            Self::FirstStrongest => &[First, Strongest],
            Self::Triple => &[Last, Strongest, First],
            Self::StrongestSecond => &[Strongest, SecondStrongest],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_byte_is_its_own_mode_or_none() {
        let known: Vec<u8> = (0..=255)
            .filter(|&b| ReturnMode::from_byte(b).is_some())
            .collect();
        assert_eq!(
            known,
            [0x33, 0x34, 0x37, 0x38, 0x39, 0x3a, 0x3b, 0x3c, 0x3d, 0x3e]
        );
        for byte in known {
            let mode = ReturnMode::from_byte(byte).unwrap();
            assert_eq!(mode.byte(), byte);
            assert_eq!(mode.echoes(Model::Xt32m).len(), mode.returns());
        }
    }

    #[test]
    fn first_and_last_swap_places_between_the_families() {
        assert_eq!(
            ReturnMode::FirstLast.echoes(Model::Qt64),
            [Echo::First, Echo::Last]
        );
        assert_eq!(
            ReturnMode::FirstLast.echoes(Model::Xt32),
            [Echo::Last, Echo::First]
        );
    }
}

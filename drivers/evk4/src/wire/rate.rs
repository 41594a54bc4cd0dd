//! The event rate controller's own counts: the only in-band signal that events were lost.

/// `OTHERS` subtype: events that entered the rate controller since its last such word.
pub(super) const ENTERED: u16 = 0x014;
/// `OTHERS` subtype: events that left it.
pub(super) const LEFT: u16 = 0x016;
/// The count is the low 22 bits of the 28-bit payload.
const COUNT_MASK: u32 = (1 << 22) - 1;

/// Events the sensor's rate controller let in and out, summed over its reports.
///
/// Each report covers the time since the last one. Both kinds come in pairs, so between pairs
/// [`dropped`](Self::dropped) may lag or lead by one report.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct RateCounts {
    /// Events that entered the controller.
    pub entered: u64,
    /// Events that left it.
    pub left: u64,
    /// Reports of events entering.
    pub entered_reports: u64,
    /// Reports of events leaving.
    pub left_reports: u64,
}

impl RateCounts {
    /// Nothing reported.
    pub const ZERO: Self = Self {
        entered: 0,
        left: 0,
        entered_reports: 0,
        left_reports: 0,
    };

    /// Events the sensor dropped to keep its rate limit.
    #[must_use]
    pub const fn dropped(&self) -> u64 {
        self.entered.saturating_sub(self.left)
    }

    pub(super) fn report(&mut self, subtype: u16, payload: u32) {
        let count = u64::from(payload & COUNT_MASK);
        match subtype {
            ENTERED => {
                self.entered += count;
                self.entered_reports += 1;
            }
            LEFT => {
                self.left += count;
                self.left_reports += 1;
            }
            _ => {}
        }
    }
}

/// Collects an `OTHERS` payload from the `CONTINUED` words that follow, low part first.
///
/// Time words and padding may sit in between (seen in captures), and so may a chunk edge. The
/// count is complete after two `CONTINUED_12`; what a later word holds is above its 22 bits.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Payload {
    subtype: u16,
    value: u32,
    taken: u32,
}

impl Payload {
    /// Starts the payload of an `OTHERS` word.
    pub(super) const fn start(&mut self, subtype: u16) {
        *self = Self {
            subtype,
            value: 0,
            taken: 0,
        };
    }

    /// Takes a `CONTINUED_12`; gives subtype and payload once the count is complete.
    pub(super) fn take_12(&mut self, bits: u16) -> Option<(u16, u32)> {
        let shift = match self.taken {
            0 => 0,
            1 => 12,
            _ => return None,
        };
        self.value |= u32::from(bits) << shift;
        self.taken += 1;
        (self.taken == 2).then_some((self.subtype, self.value))
    }
}

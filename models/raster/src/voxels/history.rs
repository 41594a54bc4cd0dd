//! Events in eight bytes, and the bounded memory of the newest ones.

use noctule_sensor::Event;

use crate::RasterError;

const AXIS_BITS: u32 = 11;
const AXIS_MASK: u32 = (1 << AXIS_BITS) - 1;

/// An event in eight bytes: the low 32 bits of its time, and pixel and polarity in one word.
///
/// Times wrap after 71 minutes; they only mean something against an exposure nearby.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(C)]
pub struct PackedEvent {
    /// Low 32 bits of the event's time, microseconds on the event camera's clock.
    pub t_us: u32,
    /// Column in bits 0..11, row in 11..22, polarity in 22 (set: brighter), 0 above.
    word: u32,
}

impl PackedEvent {
    /// Packs an event; the two coordinates are below 2048.
    ///
    /// # Errors
    /// [`RasterError::Pixel`] for a coordinate of 2048 or more.
    #[inline]
    pub const fn new(t_us: u32, x: u16, y: u16, on: bool) -> Result<Self, RasterError> {
        let (column, row) = (x as u32, y as u32);
        if (column | row) > AXIS_MASK {
            return Err(RasterError::Pixel { x, y });
        }
        Ok(Self {
            t_us,
            word: column | row << AXIS_BITS | (on as u32) << (2 * AXIS_BITS),
        })
    }

    /// Packs a decoded event.
    ///
    /// # Errors
    /// [`RasterError::Pixel`], as [`new`](Self::new).
    #[inline]
    pub const fn from_event(event: &Event) -> Result<Self, RasterError> {
        Self::new(event.t.as_micros() as u32, event.x, event.y, event.on)
    }

    /// Column, below 2048.
    #[inline(always)]
    #[must_use]
    pub const fn x(self) -> u32 {
        self.word & AXIS_MASK
    }

    /// Row, below 2048.
    #[inline(always)]
    #[must_use]
    pub const fn y(self) -> u32 {
        (self.word >> AXIS_BITS) & AXIS_MASK
    }

    /// `true` when the pixel got brighter.
    #[inline(always)]
    #[must_use]
    pub const fn is_on(self) -> bool {
        self.word >> (2 * AXIS_BITS) & 1 != 0
    }

    /// +1 when the pixel got brighter, -1 when darker.
    #[inline(always)]
    pub(super) const fn sign(self) -> i32 {
        ((self.word >> (2 * AXIS_BITS) & 1) << 1).cast_signed() - 1
    }
}

/// The newest events, in the order they came, in memory allocated once.
///
/// Every event has a sequence number, counted from 0 for the first one ever pushed. When full, the
/// oldest events are overwritten; [`oldest`](Self::oldest) counts them.
#[derive(Debug)]
pub struct EventHistory {
    slots: Box<[PackedEvent]>,
    /// Sequence number of the next event; slot of event n is n modulo the capacity.
    next: u64,
}

impl EventHistory {
    /// Room for at least `capacity` events, rounded up to a power of two (8 bytes each).
    ///
    /// # Errors
    /// [`RasterError::Setting`], when that is not 1 to 2^30 events.
    pub fn new(capacity: usize) -> Result<Self, RasterError> {
        let max = 1 << 30;
        if !(1..=max).contains(&capacity) {
            let (value, max) = (capacity as f64, max as f64);
            return Err(RasterError::Setting {
                name: "event history",
                value,
                min: 1.0,
                max,
            });
        }
        let slots = vec![PackedEvent::default(); capacity.next_power_of_two()];
        Ok(Self {
            slots: slots.into_boxed_slice(),
            next: 0,
        })
    }

    /// Events it can hold.
    #[must_use]
    pub const fn capacity(&self) -> usize {
        self.slots.len()
    }

    /// Sequence number the next event will get: how many were ever pushed.
    #[must_use]
    pub const fn next(&self) -> u64 {
        self.next
    }

    /// Sequence number of the oldest event still held: how many were overwritten.
    #[must_use]
    pub const fn oldest(&self) -> u64 {
        self.next.saturating_sub(self.slots.len() as u64)
    }

    /// Appends one event.
    #[inline]
    pub fn push(&mut self, event: PackedEvent) {
        let slot = self.slot(self.next);
        self.slots[slot] = event;
        self.next += 1;
    }

    /// Appends events in order.
    pub fn extend(&mut self, events: &[PackedEvent]) {
        // Of more events than there is room for, only the last ones would survive.
        let skipped = events.len().saturating_sub(self.slots.len());
        self.next += skipped as u64;
        let kept = &events[skipped..];
        let start = self.slot(self.next);
        let (head, tail) = kept.split_at(kept.len().min(self.slots.len() - start));
        self.slots[start..start + head.len()].copy_from_slice(head);
        self.slots[..tail.len()].copy_from_slice(tail);
        self.next += kept.len() as u64;
    }

    /// The events with sequence numbers in `from..to` that are still held, in order, as two slices.
    #[must_use]
    pub fn slices(&self, from: u64, to: u64) -> [&[PackedEvent]; 2] {
        let to = to.min(self.next);
        let from = from.max(self.oldest());
        if from >= to {
            return [&[], &[]];
        }
        let (start, len) = (self.slot(from), (to - from) as usize); // len <= capacity
        let head = len.min(self.slots.len() - start);
        [&self.slots[start..start + head], &self.slots[..len - head]]
    }

    /// Sequence number of the first held event at or after `t_us` (low 32 bits, microseconds),
    /// where held events are in order of time; with stragglers among them, search from earlier.
    #[must_use]
    pub fn first_since(&self, t_us: u32) -> u64 {
        let oldest = self.oldest();
        let [head, tail] = self.slices(oldest, self.next);
        // Signed distance: right as long as the history spans less than 35 minutes.
        let before = |event: &PackedEvent| event.t_us.wrapping_sub(t_us).cast_signed() < 0;
        let first = head.partition_point(before);
        let rest = if first == head.len() {
            tail.partition_point(before)
        } else {
            0
        };
        oldest + (first + rest) as u64
    }

    fn slot(&self, sequence: u64) -> usize {
        sequence as usize & (self.slots.len() - 1) // the capacity is a power of two
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use noctule_sensor::Stamp;
    use proptest::prelude::*;

    fn at(t_us: u32) -> PackedEvent {
        PackedEvent::new(t_us, 0, 0, false).unwrap()
    }

    #[test]
    fn eight_bytes_hold_an_event() {
        assert_eq!(size_of::<PackedEvent>(), 8);
        let event = Event {
            t: Stamp::from_micros((7 << 32) + 42),
            x: 2047,
            y: 1024,
            on: true,
        };
        let packed = PackedEvent::from_event(&event).unwrap();
        assert_eq!(
            (packed.t_us, packed.x(), packed.y(), packed.is_on()),
            (42, 2047, 1024, true)
        );
        assert_eq!(
            (
                packed.sign(),
                PackedEvent::new(0, 3, 4, false).unwrap().sign()
            ),
            (1, -1)
        );
        let error = PackedEvent::new(0, 2048, 1, true).unwrap_err();
        assert_eq!(
            error.to_string(),
            "event at (2048, 1) lies beyond pixel 2047"
        );
    }

    proptest! {
        /// Against a plain vector of everything ever pushed.
        #[test]
        fn the_ring_is_the_tail_of_the_list(chunks in prop::collection::vec(0..40usize, 0..12)) {
            let mut ring = EventHistory::new(13).unwrap();
            let mut list = Vec::new();
            for chunk in chunks {
                let events: Vec<_> = (0..chunk).map(|i| at((list.len() + i) as u32)).collect();
                list.extend_from_slice(&events);
                match events.as_slice() {
                    [one] => ring.push(*one),
                    many => ring.extend(many),
                }
                prop_assert_eq!(ring.next(), list.len() as u64);
                prop_assert_eq!(ring.oldest(), list.len().saturating_sub(16) as u64);
                let held: Vec<_> = ring.slices(0, u64::MAX).concat();
                prop_assert_eq!(&held[..], &list[list.len().saturating_sub(16)..]);
                for t in ring.oldest()..ring.next() {
                    prop_assert_eq!(ring.first_since(t as u32), t);
                }
            }
        }
    }

    #[test]
    fn a_search_works_across_the_wrap_of_time() {
        let mut ring = EventHistory::new(8).unwrap();
        ring.extend(&[u32::MAX - 5, u32::MAX, 3, 9].map(at));
        assert_eq!(
            [u32::MAX - 9, u32::MAX, 0, 4, 10].map(|t| ring.first_since(t)),
            [0, 1, 2, 3, 4]
        );
    }

    #[test]
    fn a_history_without_room_is_refused() {
        let error = EventHistory::new(0).unwrap_err();
        assert_eq!(
            error.to_string(),
            "event history is 0, must be in 1..=1073741824"
        );
    }
}

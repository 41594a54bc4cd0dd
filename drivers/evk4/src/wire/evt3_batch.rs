//! Common EVT 3.0 words without a branch: what is in force is one 64-bit word, and so is an event.
//!
//! Rows, columns and times follow one another in the order of the scene, which no branch
//! predictor learns; a decoder that asks of every word what it is spends its time on wrong
//! guesses. Here every word runs through the same few instructions: tables say which bits of
//! [`InForce`] it sets, the result is always stored, and a table says whether the store counts.
//! Bounds are checked when a batch is handed over.

use noctule_sensor::{Event, Stamp};

use super::word::{
    ADDR_X, ADDR_Y, ADDRESS_MASK, GROUP_PIXELS, ON_BIT, PAYLOAD_MASK, TIME_LOW, kind, make,
};
use super::{EventSink, Geometry};

/// Words taken at once.
pub(super) const BLOCK_LEN: usize = 4;
/// Events that may wait; a power of two.
const BATCH_LEN: usize = 512;

/// First bit of the row; the word itself lies below.
const ROW_BIT: u32 = 16;
/// First bit of the low part of the time; nothing lies above.
const LOW_BIT: u32 = 32;
/// Puts a copy of the word at each of the three places.
const SPREAD: u64 = 1 | 1 << ROW_BIT | 1 << LOW_BIT;
/// Where an event's column and row are.
const PLACE: u64 = (ADDRESS_MASK as u64) | (ADDRESS_MASK as u64) << ROW_BIT;
/// The highest bits beside column and row: free, so that a subtraction can borrow them.
const GUARDS: u64 = 1 << (ROW_BIT - 1) | 1 << (LOW_BIT - 1);

/// Bits that a word of each type sets.
const SETS: [u64; 16] = {
    let mut sets = [0xffff; 16];
    sets[ADDR_Y as usize] |= (ADDRESS_MASK as u64) << ROW_BIT;
    sets[TIME_LOW as usize] |= (PAYLOAD_MASK as u64) << LOW_BIT;
    sets
};
/// Bits that a word of each type leaves as they are.
const KEEPS: [u64; 16] = {
    let mut keeps = [0; 16];
    let mut kind = 0;
    while kind < 16 {
        keeps[kind] = !SETS[kind];
        kind += 1;
    }
    keeps
};
/// Events that a word of each type is.
const EVENTS: [usize; 16] = {
    let mut events = [0; 16];
    events[ADDR_X as usize] = 1;
    events
};

/// The last word with row and time in force: bits 0 to 15 the word, 16 to 26 the row, 32 to 43
/// the low part of the time.
#[derive(Clone, Copy)]
struct InForce(u64);

impl InForce {
    const fn new(word: u16, y: u16, low: u16) -> Self {
        Self(word as u64 | (y as u64) << ROW_BIT | (low as u64) << LOW_BIT)
    }

    #[inline(always)]
    fn after(self, word: u16) -> Self {
        let kind = usize::from(kind(word));
        Self(self.0 & KEEPS[kind] | (u64::from(word) * SPREAD) & SETS[kind])
    }

    #[inline(always)]
    const fn low(self) -> u64 {
        self.0 >> LOW_BIT
    }

    /// The word, the row and the low part of the time.
    #[inline(always)]
    const fn parts(self) -> [u16; 3] {
        let [a, b, c, d, e, f, _, _] = self.0.to_le_bytes();
        [
            u16::from_le_bytes([a, b]),
            u16::from_le_bytes([c, d]),
            u16::from_le_bytes([e, f]),
        ]
    }

    /// The event that the word is, if it is one.
    #[inline(always)]
    const fn event(self, high_ns: u64) -> Event {
        let [word, y, _] = self.parts();
        Event {
            t: Stamp::from_nanos(high_ns + self.low() * 1000),
            x: word & ADDRESS_MASK,
            y,
            on: word & ON_BIT != 0,
        }
    }
}

/// The last column and row of the sensor, in their places, with the guard bits set.
#[derive(Clone, Copy)]
struct Last(u64);

impl Last {
    /// `None` for a sensor without pixels.
    fn of(geometry: Geometry) -> Option<Self> {
        // Addresses have 11 bits; cut off where the guard begins, the larger of two sizes stays so.
        let last = |len: u16| Some(len.checked_sub(1)?.min(0x7fff));
        let place = InForce::new(last(geometry.width)?, last(geometry.height)?, 0);
        Some(Self(place.0 | GUARDS))
    }

    /// [`GUARDS`], less that of a column or row outside the sensor.
    #[inline(always)]
    const fn guards(self, event: InForce) -> u64 {
        (self.0 - (event.0 & PLACE)) & GUARDS
    }
}

/// What goes from one word to the next.
#[derive(Clone, Copy)]
pub(super) struct Running {
    in_force: InForce,
    /// Events in the batch.
    len: usize,
    /// Words that stepped back in time.
    pub(super) backwards: u64,
}

impl Running {
    /// Nothing taken yet; `y` is an address.
    pub(super) const fn new(y: u16, low: u16) -> Self {
        Self {
            in_force: InForce::new(0, y & ADDRESS_MASK, low & PAYLOAD_MASK),
            len: 0,
            backwards: 0,
        }
    }

    /// Says what is in force; `y` is an address.
    pub(super) const fn set(&mut self, y: u16, low: u16) {
        self.in_force = Self::new(y, low).in_force;
    }

    /// Row and low part of the time in force.
    pub(super) const fn in_force(&self) -> [u16; 2] {
        let [_, y, low] = self.in_force.parts();
        [y, low]
    }

    /// Whether there may be no room for a block or a group.
    #[inline(always)]
    pub(super) const fn is_full(&self) -> bool {
        self.len > BATCH_LEN - GROUP_PIXELS as usize - BLOCK_LEN
    }
}

/// Events on their way to a sink, all under one `TIME_HIGH`.
pub(super) struct Batch {
    events: [InForce; BATCH_LEN],
    last: Last,
    /// Events outside the sensor, not delivered.
    pub(super) out_of_bounds: u64,
}

impl Batch {
    /// `None` for a sensor without pixels.
    pub(super) fn new(geometry: Geometry) -> Option<Self> {
        Some(Self {
            events: [InForce(0); BATCH_LEN],
            last: Last::of(geometry)?,
            out_of_bounds: 0,
        })
    }

    /// Takes words of which none but `ADDR_X`, `ADDR_Y` and `TIME_LOW` says anything.
    #[inline(always)]
    pub(super) fn take(&mut self, words: [u16; BLOCK_LEN], running: &mut Running) {
        for word in words {
            let low = running.in_force.low();
            running.in_force = running.in_force.after(word);
            running.backwards += u64::from(running.in_force.low() < low);
            self.events[running.len % BATCH_LEN] = running.in_force;
            running.len += EVENTS[usize::from(kind(word))];
        }
    }

    /// Hands all events over.
    #[inline(always)]
    pub(super) fn flush(&mut self, running: &mut Running, high_ns: u64, sink: &mut impl EventSink) {
        self.hand_over(core::mem::take(&mut running.len), high_ns, sink);
    }

    /// Whether columns `base` to `base + 31` of the row in force are all inside the sensor.
    #[inline(always)]
    pub(super) const fn has_group(&self, base: u16, running: &Running) -> bool {
        let [_, y, low] = running.in_force.parts();
        base <= ADDRESS_MASK + 1 - GROUP_PIXELS
            && self
                .last
                .guards(InForce::new(base + GROUP_PIXELS - 1, y, low))
                == GUARDS
    }

    /// Takes one event for each of the few bits of `mask`, as [`has_group`](Self::has_group) found
    /// possible.
    #[inline(always)]
    pub(super) fn take_group(&mut self, base: u16, on: bool, mask: u32, running: &mut Running) {
        let word = make(ADDR_X, base | if on { ON_BIT } else { 0 });
        let first = running.in_force.0 & !0xffff | u64::from(word);
        let mut rest = mask;
        // A sensor mostly sends vectors from two pixels on.
        for _ in 0..2 {
            self.events[running.len % BATCH_LEN] =
                InForce(first + u64::from(rest.trailing_zeros()));
            running.len += usize::from(rest != 0);
            rest &= rest.wrapping_sub(1);
        }
        while rest != 0 {
            self.events[running.len % BATCH_LEN] =
                InForce(first + u64::from(rest.trailing_zeros()));
            running.len += 1;
            rest &= rest - 1;
        }
    }

    /// Hands the first `len` events over.
    #[inline(never)]
    fn hand_over(&mut self, len: usize, high_ns: u64, sink: &mut impl EventSink) {
        let events = self.events.get(..len).unwrap_or(&self.events);
        let guards = events
            .iter()
            .fold(GUARDS, |guards, event| guards & self.last.guards(*event));
        if guards == GUARDS {
            for event in events {
                sink.event(event.event(high_ns));
            }
            return;
        }
        for &event in events {
            if self.last.guards(event) == GUARDS {
                sink.event(event.event(high_ns));
            } else {
                self.out_of_bounds += 1;
            }
        }
    }
}

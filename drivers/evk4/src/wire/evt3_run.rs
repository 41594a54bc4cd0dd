//! The fast way through EVT 3.0: four words at a time, without a branch for each.
//!
//! Row, column and low time words follow one another in an order no branch predictor can learn,
//! so a `match` on the type costs a misprediction every few words. Here four words are looked at
//! in one register: a mask says how many of them are common and in order, and those are taken by
//! arithmetic alone. A pixel is written to a batch in any case, but only kept if there was an
//! event. Vector groups are recognised by one comparison. Whatever is rare or wrong goes to the
//! word-by-word decoder, which alone decides what counts as which error (but for steps back of
//! `TIME_LOW`, which are counted here too).

use noctule_sensor::{Event, Stamp};

use super::evt3::State;
use super::word::{
    ADDR_X, ADDR_Y, ADDRESS_MASK, GROUP_PIXELS, ON_BIT, PAYLOAD_MASK, TIME_HIGH, TIME_LOW,
    VECT_BASE_X, kind, make,
};
use super::{EventSink, Evt3Decoder};

/// Pixels gathered before they are handed over; a power of two.
const BATCH_LEN: usize = 512;
/// Most pixels one step writes: a vector group, rounded up to [`EXPANDED_AT_ONCE`].
const STEP_LEN_MAX: usize = 32;
/// Pixels of a vector group written without a branch; most groups of real scenes hold fewer.
const EXPANDED_AT_ONCE: usize = 4;
/// Events handed to the sink at once.
const HANDED_AT_ONCE: usize = 64;
const NOTHING: Event = Event {
    t: Stamp::ZERO,
    x: 0,
    y: 0,
    on: false,
};
/// The lowest bit of each lane of 16 bits, a lane for each of four words.
const LANES: u64 = 0x0001_0001_0001_0001;
/// The highest bit of each lane.
const TOPS: u64 = LANES << 15;
/// Where three words have their types, and what these are in a vector group.
const GROUP_KINDS: u64 = 0xf000_f000_f000;
const GROUP: u64 = 0x5000_4000_4000;

/// Events under one `TIME_HIGH` on their way to the sink, in columns.
struct Batch {
    /// `TIME_LOW` words; the type does not matter.
    low: [u16; BATCH_LEN],
    /// Rows.
    y: [u16; BATCH_LEN],
    /// `ADDR_X` words; the type does not matter.
    x: [u16; BATCH_LEN],
    len: usize,
}

impl Batch {
    /// Writes a pixel where the next one goes; adding to `len` keeps it.
    #[inline(always)]
    fn write(&mut self, low: u16, y: u16, x: u16) {
        let at = self.len % BATCH_LEN;
        self.low[at] = low;
        self.y[at] = y;
        self.x[at] = x;
    }

    /// Gives the sink what is there, a few events at a time so that they stay close.
    #[inline]
    fn hand_over(&mut self, high_ns: u64, sink: &mut impl EventSink) {
        let mut events = [NOTHING; HANDED_AT_ONCE];
        let len = self.len.min(BATCH_LEN);
        let columns = self.low[..len].chunks(HANDED_AT_ONCE);
        let columns = columns.zip(self.y[..len].chunks(HANDED_AT_ONCE));
        let columns = columns.zip(self.x[..len].chunks(HANDED_AT_ONCE));
        for ((low, y), x) in columns {
            let pixels = low.iter().zip(y).zip(x);
            for (event, ((&low, &y), &x)) in events.iter_mut().zip(pixels) {
                *event = Event {
                    t: Stamp::from_nanos(high_ns + u64::from(low & PAYLOAD_MASK) * 1000),
                    x: x & ADDRESS_MASK,
                    y,
                    on: x & ON_BIT != 0,
                };
            }
            sink.events(&events[..x.len()]);
        }
        self.len = 0;
    }

    #[inline(always)]
    const fn is_full(&self) -> bool {
        self.len > BATCH_LEN - STEP_LEN_MAX
    }
}

/// What decides whether a word is common; holds until a word is taken by itself.
#[derive(Clone, Copy)]
struct Common {
    /// The `TIME_HIGH` word in force, which changes nothing, in every lane.
    same_high: u64,
    /// First column outside the sensor in every lane, 0 while no event can be inside.
    columns: u64,
    /// First row outside the sensor in every lane.
    rows: u64,
    /// First base column whose group is not wholly inside; 0 while no event can be inside.
    group_bases: u16,
}

impl Common {
    fn of(decoder: &Evt3Decoder) -> Self {
        let all = ADDRESS_MASK + 1;
        let (width, height) = (decoder.geometry.width, decoder.geometry.height);
        let row_is_inside = decoder.state.y < height;
        let columns = if row_is_inside { width.min(all) } else { 0 };
        Self {
            same_high: u64::from(make(TIME_HIGH, decoder.time_high.low_12())) * LANES,
            columns: u64::from(columns) * LANES,
            rows: u64::from(height.min(all)) * LANES,
            group_bases: columns.saturating_sub(GROUP_PIXELS - 1),
        }
    }

    /// Marks, in each lane's highest bit, every word but `ADDR_Y` and `ADDR_X` inside the
    /// sensor, `TIME_LOW`, and the `TIME_HIGH` in force.
    #[inline(always)]
    const fn rare(self, words: u64) -> u64 {
        let (bit_14, bit_13, bit_12) = (words << 1, words << 2, words << 3);
        // All types but 0, 2 and 6.
        let kind = words | bit_12 | (bit_14 & !bit_13);
        let addresses = words & (ADDRESS_MASK as u64 * LANES) | TOPS;
        let outside =
            (addresses - self.columns) & bit_13 & !bit_14 | (addresses - self.rows) & !bit_13;
        let differs = words ^ self.same_high;
        let differs = ((differs & !TOPS) + (TOPS - LANES)) | differs;
        (kind | outside) & differs & TOPS
    }
}

/// `words` with the first rare word and all after it replaced by words without effect.
#[inline(always)]
const fn blanked(words: u64, rare: u64) -> u64 {
    let first = rare & rare.wrapping_neg();
    let keep = (first >> 15).wrapping_sub(1);
    words & keep | TOPS & !keep
}

/// What is taken by arithmetic, until a word is taken by itself.
#[derive(Clone, Copy)]
struct Taken {
    state: State,
    words: u64,
    backwards: u64,
}

impl Evt3Decoder {
    /// Decodes from the start of `bytes` while there are four words, and gives the number of
    /// bytes taken.
    pub(super) fn run(&mut self, bytes: &[u8], sink: &mut impl EventSink) -> usize {
        let mut rest = bytes;
        while !self.time_high.is_known() {
            let Some((word, after)) = rest.split_first_chunk::<2>() else {
                break;
            };
            self.word(u16::from_le_bytes(*word), sink);
            rest = after;
        }
        if rest.len() < 8 {
            return bytes.len() - rest.len();
        }
        let mut batch = Batch {
            low: [0; BATCH_LEN],
            y: [0; BATCH_LEN],
            x: [0; BATCH_LEN],
            len: 0,
        };
        let (mut taken, mut common) = (self.begin(), Common::of(self));
        while let Some(block) = rest.first_chunk::<8>() {
            let words = u64::from_le_bytes(*block);
            let rare = common.rare(words);
            let count = if rare & 0x8000 == 0 {
                let count = rare.trailing_zeros() as usize / 16;
                taken.common(blanked(words, rare), count, &mut batch);
                count
            } else {
                taken.group(words, common, &mut batch)
            };
            if count == 0 {
                batch.hand_over(self.high_ns, sink);
                self.end(taken);
                self.word(u16::from_le_bytes([block[0], block[1]]), sink);
                (taken, common) = (self.begin(), Common::of(self));
                rest = &rest[2..];
                continue;
            }
            rest = &rest[2 * count..];
            if batch.is_full() {
                batch.hand_over(self.high_ns, sink);
            }
        }
        batch.hand_over(self.high_ns, sink);
        self.end(taken);
        bytes.len() - rest.len()
    }

    const fn begin(&self) -> Taken {
        Taken {
            state: self.state,
            words: 0,
            backwards: 0,
        }
    }

    const fn end(&mut self, taken: Taken) {
        self.state = taken.state;
        self.tally.words += taken.words;
        self.tally.decoded += taken.words - taken.backwards;
        self.errors.time_backwards += taken.backwards;
    }
}

impl Taken {
    /// Takes the first `count` of four words; those after have no effect.
    #[inline(always)]
    fn common(&mut self, words: u64, count: usize, batch: &mut Batch) {
        let (mut y, mut low) = (self.state.y, make(TIME_LOW, self.state.low));
        for lane in 0..4 {
            let [a, b, ..] = (words >> (16 * lane)).to_le_bytes();
            let word = u16::from_le_bytes([a, b]);
            let kind = kind(word);
            y = if kind == ADDR_Y {
                word & ADDRESS_MASK
            } else {
                y
            };
            let low_before = low;
            low = if kind == TIME_LOW { word } else { low };
            self.backwards += u64::from(low < low_before);
            batch.write(low, y, word);
            batch.len += usize::from(kind == ADDR_X);
        }
        self.state.y = y;
        self.state.low = low & PAYLOAD_MASK;
        self.words += count as u64;
    }

    /// Takes a vector group from the start of `words`, with or without its base column, or a
    /// base column alone; gives the number of words taken, 0 when there is none of these or the
    /// group is not wholly inside the sensor.
    #[inline(always)]
    fn group(&mut self, words: u64, common: Common, batch: &mut Batch) -> usize {
        let (mut group, mut count) = (words, 0);
        if words & 0xf000 == u64::from(make(VECT_BASE_X, 0)) {
            let [a, b, ..] = words.to_le_bytes();
            let base = u16::from_le_bytes([a, b]);
            self.state.base_x = base & ADDRESS_MASK;
            self.state.base_on = base & ON_BIT != 0;
            group = words >> 16;
            count = 1;
        }
        if group & GROUP_KINDS == GROUP && self.state.base_x < common.group_bases {
            let mask = group & 0xfff | group >> 4 & 0xfff_000 | group >> 8 & 0xff00_0000;
            self.expand(mask, batch);
            self.state.base_x += GROUP_PIXELS;
            count += 3;
        }
        self.words += count as u64;
        count
    }

    /// One pixel for each of the low 32 bits of `mask`.
    #[inline(always)]
    fn expand(&self, mask: u64, batch: &mut Batch) {
        let State { low, y, .. } = self.state;
        let on = if self.state.base_on { ON_BIT } else { 0 };
        let end = batch.len + mask.count_ones() as usize;
        let mut rest = mask;
        loop {
            for _ in 0..EXPANDED_AT_ONCE {
                let index = u16::from(rest.trailing_zeros().to_le_bytes()[0]);
                batch.write(low, y, (self.state.base_x + index) | on);
                batch.len += 1;
                rest &= rest.wrapping_sub(1);
            }
            if rest == 0 {
                break;
            }
        }
        batch.len = end;
    }
}

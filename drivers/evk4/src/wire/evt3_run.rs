//! The fast way through EVT 3.0: blocks of common words at once, rare ones in between.
//!
//! A block of words is compared as a whole with the types that are common; those up to the first
//! rare word go through a [`Batch`]. A vector group is recognised, checked and expanded whole.
//! Whatever else is rare or wrong goes to the word-by-word decoder, which alone decides what
//! counts as which error, but for events outside the sensor and steps back in time.

use super::evt3_batch::{BLOCK_LEN, Batch, Running};
use super::word::{
    ADDRESS_MASK, CONTINUED_4, CONTINUED_12, GROUP_PIXELS, ON_BIT, OTHERS, PAYLOAD_MASK, TIME_HIGH,
    VECT_8, VECT_12, VECT_BASE_X, kind, make,
};
use super::{EventSink, Evt3Decoder};

/// Fewer words than this are taken one by one, rather than set up a batch for them.
const RUN_LEN_MIN: usize = 32;

/// Most pixels of a vector group that wait in the batch.
const GROUP_PIXELS_FEW: u32 = 4;
/// Puts a copy of a word in every place of a block.
const EVERY: u64 = 0x0001_0001_0001_0001;
/// The highest bit of every word of a block.
const TOPS: u64 = 0x8000 * EVERY;

/// The next block of `words`, and how many of them are common. The others are replaced by
/// `same_high`, the `TIME_HIGH` that changes nothing.
#[inline(always)]
fn next_block(words: &[[u8; 2]], same_high: u16) -> ([u16; BLOCK_LEN], usize) {
    let same_high = u64::from(same_high) * EVERY;
    let (mut block, mut len) = (same_high, BLOCK_LEN);
    if let Some(bytes) = words.as_flattened().first_chunk::<8>() {
        block = u64::from_le_bytes(*bytes);
    } else {
        for word in words.iter().rev() {
            block = block << 16 | u64::from(u16::from_le_bytes(*word));
        }
        len = words.len();
    }
    // Of the types, 0, 2 and 6 are common: no bit 0, no bit 3, no bit 2 without bit 1.
    let rare = block | block << 3 | block << 1 & !(block << 2);
    let differs = block ^ same_high;
    let rare = rare & (((differs & !TOPS) + !TOPS) | differs) & TOPS;
    if rare != 0 {
        let bit = rare.trailing_zeros();
        len = bit as usize / 16;
        let common = (1 << (bit - 15)) - 1;
        block = block & common | same_high & !common;
    }
    let [a, b, c, d, e, f, g, h] = block.to_le_bytes();
    (
        [[a, b], [c, d], [e, f], [g, h]].map(u16::from_le_bytes),
        len,
    )
}

/// The pixels of the vector group at the start of `words`, if there is one.
#[inline(always)]
fn group(words: &[[u8; 2]]) -> Option<u32> {
    let [a, b, c] = words.first_chunk::<3>()?.map(u16::from_le_bytes);
    ((kind(a) == VECT_12) & (kind(b) == VECT_12) & (kind(c) == VECT_8)).then(|| {
        u32::from(a & PAYLOAD_MASK) | u32::from(b & PAYLOAD_MASK) << 12 | u32::from(c & 0xff) << 24
    })
}

/// Whether the pixels are so many that they are worth a way of their own to the sink.
#[inline(always)]
const fn is_dense(mask: u32) -> bool {
    let mut rest = mask;
    let mut pixels = 0;
    while pixels < GROUP_PIXELS_FEW {
        rest &= rest.wrapping_sub(1);
        pixels += 1;
    }
    rest != 0
}

impl Evt3Decoder {
    /// Decodes `words`, the common ones in batches and the others one by one.
    pub(super) fn run(&mut self, words: &[[u8; 2]], sink: &mut impl EventSink) {
        let mut rest = words;
        while let [word, after @ ..] = rest {
            if self.is_ready()
                && rest.len() >= RUN_LEN_MIN
                && let Some(mut batch) = Batch::new(self.geometry)
            {
                return self.run_batch(rest, &mut batch, sink);
            }
            self.word(u16::from_le_bytes(*word), sink);
            rest = after;
        }
    }

    fn run_batch(&mut self, words: &[[u8; 2]], batch: &mut Batch, sink: &mut impl EventSink) {
        let (mut rest, mut one_by_one) = (words, 0);
        let mut same_high = make(TIME_HIGH, self.time_high.low_12());
        let mut running = Running::new(self.state.y, self.state.low);
        while !rest.is_empty() {
            let (block, len) = next_block(rest, same_high);
            batch.take(block, &mut running);
            if running.is_full() {
                batch.flush(&mut running, self.high_ns, sink);
            }
            rest = &rest[len..];
            let [bytes, after @ ..] = rest else { break };
            if len == BLOCK_LEN {
                continue;
            }
            let word = u16::from_le_bytes(*bytes);
            if kind(word) == VECT_BASE_X {
                self.state.base_x = word & ADDRESS_MASK;
                self.state.base_on = word & ON_BIT != 0;
                rest = self.groups(after, batch, &mut running, sink);
            } else if matches!(kind(word), OTHERS | CONTINUED_12 | CONTINUED_4) {
                self.take_payload(word);
                rest = after;
                while let [bytes, after @ ..] = rest
                    && matches!(bytes[1] >> 4, 0x7 | 0xf)
                {
                    self.take_payload(u16::from_le_bytes(*bytes));
                    rest = after;
                }
            } else {
                rest = self.groups(rest, batch, &mut running, sink);
                if rest.len() > after.len() {
                    batch.flush(&mut running, self.high_ns, sink);
                    [self.state.y, self.state.low] = running.in_force();
                    self.word(word, sink);
                    one_by_one += 1;
                    rest = after;
                    same_high = make(TIME_HIGH, self.time_high.low_12());
                    running.set(self.state.y, self.state.low);
                }
            }
        }
        batch.flush(&mut running, self.high_ns, sink);
        [self.state.y, self.state.low] = running.in_force();
        let taken = (words.len() - one_by_one) as u64;
        self.tally.words += taken;
        self.tally.decoded += taken - batch.out_of_bounds - running.backwards;
        self.tally.out_of_bounds += batch.out_of_bounds;
        self.errors.out_of_bounds += batch.out_of_bounds;
        self.errors.time_backwards += running.backwards;
    }

    /// Takes the vector groups at the start of `words` that lie inside the sensor; what follows.
    #[inline(always)]
    fn groups<'a>(
        &mut self,
        words: &'a [[u8; 2]],
        batch: &mut Batch,
        running: &mut Running,
        sink: &mut impl EventSink,
    ) -> &'a [[u8; 2]] {
        let mut rest = words;
        while let Some(mask) = group(rest)
            && batch.has_group(self.state.base_x, running)
        {
            let (base_x, base_on) = (self.state.base_x, self.state.base_on);
            if is_dense(mask) {
                batch.flush(running, self.high_ns, sink);
                [self.state.y, self.state.low] = running.in_force();
                self.deliver(base_x, base_on, mask, sink);
            } else {
                batch.take_group(base_x, base_on, mask, running);
                if running.is_full() {
                    batch.flush(running, self.high_ns, sink);
                }
            }
            self.state.base_x += GROUP_PIXELS;
            rest = &rest[3..];
        }
        rest
    }
}

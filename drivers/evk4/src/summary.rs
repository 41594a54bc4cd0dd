//! A decoded stream in a few numbers, for inspection and for comparing decoders.

use noctule_sensor::{Event, TriggerEdge};
use sha2::{Digest, Sha256};

use crate::EventSink;

/// Bytes of one event in the digest: t in microseconds (8), x (2), y (2), polarity (1).
const RECORD_LEN: usize = 13;
/// Records hashed at once.
const RECORDS: usize = 256;
/// Trigger inputs told apart: EVT 2 words carry 5 bits of channel.
const CHANNELS: usize = 32;

/// Edges seen on one trigger input.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct TriggerSummary {
    /// Rising edges.
    pub rising: u64,
    /// Falling edges.
    pub falling: u64,
    /// Time of the first edge, microseconds.
    pub first_us: u64,
    /// Time of the last edge, microseconds.
    pub last_us: u64,
    /// Sum of all times, microseconds, modulo 2^64.
    pub sum_us: u64,
}

/// Counts, sums and a digest of everything decoded.
///
/// Sums are modulo 2^64; "first" and "last" are in stream order. The digest is SHA-256 over one
/// 13-byte little-endian record for each event: t in microseconds as u64, x u16, y u16, p u8.
#[derive(Debug, Clone)]
pub struct Summary {
    /// Events.
    pub events: u64,
    /// Events that got brighter.
    pub on: u64,
    /// Time of the first event, microseconds.
    pub first_us: Option<u64>,
    /// Time of the last event, microseconds.
    pub last_us: Option<u64>,
    /// Sum of times, microseconds.
    pub sum_us: u64,
    /// Sum of columns.
    pub sum_x: u64,
    /// Sum of rows.
    pub sum_y: u64,
    /// Events stamped earlier than the one before.
    pub nonmonotonic: u64,
    channels: [TriggerSummary; CHANNELS],
    hash: Sha256,
    records: Box<[u8; RECORD_LEN * RECORDS]>,
    filled: usize,
}

impl Default for Summary {
    fn default() -> Self {
        Self {
            events: 0,
            on: 0,
            first_us: None,
            last_us: None,
            sum_us: 0,
            sum_x: 0,
            sum_y: 0,
            nonmonotonic: 0,
            channels: [TriggerSummary::default(); CHANNELS],
            hash: Sha256::new(),
            records: Box::new([0; RECORD_LEN * RECORDS]),
            filled: 0,
        }
    }
}

impl Summary {
    /// A summary of nothing yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Events that got darker.
    #[must_use]
    pub const fn off(&self) -> u64 {
        self.events - self.on
    }

    /// SHA-256 of the events so far.
    #[must_use]
    pub fn sha256(&self) -> [u8; 32] {
        let mut hash = self.hash.clone();
        hash.update(&self.records[..self.filled]);
        hash.finalize().into()
    }

    /// [`sha256`](Self::sha256) in lower-case hexadecimal.
    #[must_use]
    pub fn sha256_hex(&self) -> String {
        self.sha256().iter().map(|b| format!("{b:02x}")).collect()
    }

    /// Trigger inputs that saw an edge, by channel.
    pub fn triggers(&self) -> impl Iterator<Item = (u8, &TriggerSummary)> {
        let seen = (0_u8..).zip(&self.channels);
        seen.filter(|(_, channel)| channel.rising + channel.falling > 0)
    }
}

impl EventSink for Summary {
    fn event(&mut self, event: Event) {
        let t_us = event.t.as_micros();
        self.events += 1;
        self.on += u64::from(event.on);
        self.first_us.get_or_insert(t_us);
        self.nonmonotonic += u64::from(self.last_us.is_some_and(|last| t_us < last));
        self.last_us = Some(t_us);
        self.sum_us = self.sum_us.wrapping_add(t_us);
        self.sum_x += u64::from(event.x);
        self.sum_y += u64::from(event.y);

        let record = &mut self.records[self.filled..self.filled + RECORD_LEN];
        record[0..8].copy_from_slice(&t_us.to_le_bytes());
        record[8..10].copy_from_slice(&event.x.to_le_bytes());
        record[10..12].copy_from_slice(&event.y.to_le_bytes());
        record[12] = u8::from(event.on);
        self.filled += RECORD_LEN;
        if self.filled == self.records.len() {
            self.hash.update(&self.records[..]);
            self.filled = 0;
        }
    }

    fn trigger(&mut self, edge: TriggerEdge) {
        let t_us = edge.t.as_micros();
        let channel = &mut self.channels[usize::from(edge.channel) % CHANNELS];
        if channel.rising + channel.falling == 0 {
            channel.first_us = t_us;
        }
        channel.last_us = t_us;
        channel.sum_us = channel.sum_us.wrapping_add(t_us);
        if edge.rising {
            channel.rising += 1;
        } else {
            channel.falling += 1;
        }
    }
}

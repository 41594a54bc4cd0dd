//! The event camera's thread: USB transfers -> events and edges, packed.

use noctule_evk4::{Decoder, EventSink};
use noctule_raster::PackedEvent;
use noctule_recording::EventTransfers;
use noctule_sensor::{Event, Evk4, Realtime, Stamp, TriggerEdge};

use super::{Flow, IngestError, Ingested, file_faults};
use crate::host::{EdgeMark, EventBlock};
use crate::lane::{Producer, WhenFull};
use crate::latency::StreamRow;

/// Decodes all transfers of a recording.
///
/// # Errors
/// When the recording cannot be read on.
pub fn run(
    mut transfers: EventTransfers,
    mut lane: Producer<EventBlock>,
    flow: Flow<'_>,
) -> Result<Ingested, IngestError> {
    let header = transfers.header();
    let mut decoder = Decoder::new(header.format, header.geometry);
    let mut packer = Packer {
        lane: &mut lane,
        when_full: flow.when_full,
        block: None,
        arrival: Stamp::ZERO,
        received_ns: 0,
        newest: None,
        shed: 0,
        events: 0,
        unpackable: 0,
    };
    let (mut transfer_count, mut bytes) = (0, 0);
    while let Some(transfer) = transfers.next_transfer()? {
        // Transfers come in order; a clock that was set back must not break the promise.
        packer.arrival = packer.arrival.max(transfer.arrival);
        packer.lane.promise(packer.arrival);
        let Some(received_ns) = flow.pacer.hold(packer.arrival, flow.stop) else {
            break;
        };
        packer.received_ns = received_ns;
        packer.newest = None;
        transfer_count += 1;
        bytes += transfer.bytes.len() as u64;
        let piece = flow.piece_bytes.unwrap_or(usize::MAX).max(1);
        let mut rest = transfer.bytes;
        while !rest.is_empty() {
            let (now, later) = rest.split_at(piece.min(rest.len()));
            rest = later;
            decoder.decode(now, &mut packer);
            packer.flush(decoder.watermark(), rest.is_empty());
        }
        if packer.lane.is_abandoned() {
            break;
        }
    }
    decoder.finish();
    let (shed, events, unpackable) = (packer.shed, packer.events, packer.unpackable);
    let errors = decoder.errors();
    let mut details = vec![
        ("transfers", transfer_count),
        ("bytes", bytes),
        ("unpackable", unpackable),
    ];
    details.extend(errors.by_kind());
    details.push(("dropped_by_sensor", decoder.rate().dropped()));
    details.extend(file_faults(transfers.faults()));
    Ok(Ingested {
        row: StreamRow {
            stream: "events",
            unit: "events",
            offered: events + shed + unpackable,
            received: events,
            lost: decoder.rate().dropped(),
            shed,
            rejected: unpackable + errors.by_kind().iter().map(|(_, count)| count).sum::<u64>(),
        },
        details,
    })
}

/// Packs what the decoder finds into leased blocks.
struct Packer<'a> {
    lane: &'a mut Producer<EventBlock>,
    when_full: WhenFull,
    block: Option<Box<EventBlock>>,
    arrival: Stamp<Realtime>,
    received_ns: u64,
    /// The latest event or edge of the transfer.
    newest: Option<Stamp<Evk4>>,
    shed: u64,
    events: u64,
    unpackable: u64,
}

impl Packer<'_> {
    /// A block with room, if there is one.
    fn room(&mut self) -> Option<&mut EventBlock> {
        if self.block.as_ref().is_some_and(|b| b.is_full()) {
            self.flush(None, false);
        }
        if self.block.is_none() {
            let mut block = self.lane.lease(self.when_full)?;
            block.clear();
            self.block = Some(block);
        }
        self.block.as_deref_mut()
    }

    /// Hands over what there is. An empty block still carries the watermark.
    fn flush(&mut self, watermark: Option<Stamp<Evk4>>, ends_transfer: bool) {
        let block = match self.block.take() {
            Some(block) => Some(block),
            None => self.lane.lease(self.when_full).map(|mut block| {
                block.clear();
                block
            }),
        };
        let Some(mut block) = block else { return };
        block.arrival = self.arrival;
        block.received_ns = self.received_ns;
        block.watermark = watermark;
        block.newest = self.newest.max(watermark);
        block.ends_transfer = ends_transfer;
        self.lane.push(block);
    }
}

impl EventSink for Packer<'_> {
    #[inline]
    fn event(&mut self, event: Event) {
        self.newest = self.newest.max(Some(event.t));
        let Ok(packed) = PackedEvent::from_event(&event) else {
            self.unpackable += 1;
            return;
        };
        match self.room() {
            Some(block) => {
                block.events.push(packed);
                self.events += 1;
            }
            None => {
                self.shed += 1;
                self.lane.count_lost(1);
            }
        }
    }

    fn events(&mut self, events: &[Event]) {
        // In stream order: none is later than the last by more than a sensor steps back.
        self.newest = self.newest.max(events.last().map(|event| event.t));
        let mut rest = events;
        while !rest.is_empty() {
            let Some(block) = self.room() else {
                self.shed += rest.len() as u64;
                self.lane.count_lost(rest.len() as u64);
                return;
            };
            let free = EventBlock::EVENTS_MAX - block.events.len();
            let (now, later) = rest.split_at(free.min(rest.len()));
            let before = block.events.len();
            block
                .events
                .extend(now.iter().filter_map(|e| PackedEvent::from_event(e).ok()));
            let packed = (block.events.len() - before) as u64;
            self.events += packed;
            self.unpackable += now.len() as u64 - packed;
            rest = later;
        }
    }

    fn trigger(&mut self, edge: TriggerEdge) {
        self.newest = self.newest.max(Some(edge.t));
        if let Some(block) = self.room() {
            let events_before = block.events.len();
            block.edges.push(EdgeMark {
                events_before,
                edge,
            });
        } else {
            self.lane.count_lost(1);
        }
    }
}

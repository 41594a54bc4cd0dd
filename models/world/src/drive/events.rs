//! The event camera's byte stream: events and strobe edges as EVT 3.0, cut into USB transfers.

use noctule_evk4::{Evt3Encoder, Format, Geometry, RawHeader};
use noctule_recording::RecordingWriter;
use noctule_sensor::{ClockMap, Event, Evk4, Stamp, Tai, TriggerEdge};

use super::DriveOptions;
use crate::error::WorldError;
use crate::events::{EventSimulator, PixelModel};
use crate::rig::SENSOR;
use crate::timeline::{TimedTransfer, Timeline, tai};

/// Turns luminance frames into USB transfers.
pub(super) struct EventStream<'a> {
    pixels: EventSimulator,
    /// TAI to the camera's counter.
    counter: ClockMap<Tai, Evk4>,
    /// Where the region of interest begins.
    corner: (u16, u16),
    /// Events not yet written, in order.
    waiting: Vec<Event>,
    edges: &'a [TriggerEdge],
    transfers: &'a [TimedTransfer],
    encoder: Evt3Encoder,
    bytes: Vec<u8>,
    count: u64,
}

impl<'a> EventStream<'a> {
    pub(super) fn new(
        options: &DriveOptions,
        timeline: &'a Timeline,
        recording: &mut RecordingWriter,
    ) -> Result<Self, WorldError> {
        let rig = &options.rig;
        let geometry = Geometry {
            width: SENSOR.0 as u16,
            height: SENSOR.1 as u16,
        };
        let mut header = RawHeader::new(Format::Evt3, geometry);
        let field = |key: &str, value: String| (key.to_owned(), value);
        header.fields = vec![
            field("camera_integrator_name", "Prophesee".to_owned()),
            field("generation", "4.2".to_owned()),
            field("serial_number", format!("world-{}", options.seed)),
        ];
        recording.events_header(&header.to_bytes())?;
        let roi = rig.calibration.events.roi;
        let start = timeline
            .transfers
            .first()
            .map_or(Stamp::ZERO, |transfer| transfer.from);
        Ok(Self {
            pixels: EventSimulator::new(
                rig.size,
                rig.size,
                PixelModel::of_seed(options.seed),
                options.seed,
            ),
            counter: rig.clocks.evk4.inverse(),
            corner: (roi.x as u16, roi.y as u16),
            waiting: Vec::new(),
            edges: &timeline.edges,
            transfers: &timeline.transfers,
            encoder: Evt3Encoder::starting_at(start),
            bytes: Vec::new(),
            count: 0,
        })
    }

    /// Shows the pixels the frame at `t_s` and writes the transfers that are now complete.
    pub(super) fn step(
        &mut self,
        luma: &[f32],
        t_s: f64,
        recording: &mut RecordingWriter,
    ) -> Result<(), WorldError> {
        let t = self
            .counter
            .apply(tai(0).offset_nanos((t_s * 1e9).round() as i64));
        let from = self.waiting.len();
        self.pixels
            .step(luma, t.as_nanos() as f64 * 1e-3, &mut self.waiting);
        for event in &mut self.waiting[from..] {
            event.x += self.corner.0;
            event.y += self.corner.1;
        }
        self.write_until(t, recording)
    }

    /// Writes what ends by `t`; later events may still come before that only.
    fn write_until(
        &mut self,
        t: Stamp<Evk4>,
        recording: &mut RecordingWriter,
    ) -> Result<(), WorldError> {
        let mut done = 0;
        while let Some((transfer, rest)) = self.transfers.split_first()
            && transfer.to <= t
        {
            done += self.encode(done, transfer)?;
            self.transfers = rest;
            if !transfer.lost {
                recording.event_transfer(&self.bytes, transfer.arrival)?;
            }
            self.bytes.clear();
        }
        self.waiting.drain(..done);
        Ok(())
    }

    /// Encodes the events from `self.waiting[first..]` and the edges of one transfer; returns how
    /// many events that were.
    fn encode(&mut self, first: usize, transfer: &TimedTransfer) -> Result<usize, WorldError> {
        let waiting = &self.waiting[first..];
        let count = waiting.partition_point(|event| event.t < transfer.to);
        for &event in &waiting[..count] {
            if event.t < transfer.from {
                continue; // from before the recording
            }
            while let Some((&edge, rest)) = self.edges.split_first()
                && edge.t <= event.t
            {
                self.encoder.trigger(edge, &mut self.bytes)?;
                self.edges = rest;
            }
            self.encoder.event(event, &mut self.bytes)?;
            self.count += u64::from(!transfer.lost);
        }
        while let Some((&edge, rest)) = self.edges.split_first()
            && edge.t < transfer.to
        {
            self.encoder.trigger(edge, &mut self.bytes)?;
            self.edges = rest;
        }
        // The sensor sends time words whether or not anything happens.
        let last = Stamp::from_micros(transfer.to.as_micros().saturating_sub(1));
        self.encoder.flush(&mut self.bytes);
        self.encoder.advance(last, &mut self.bytes)?;
        Ok(count)
    }

    /// Writes the rest; returns how many events were written in all.
    pub(super) fn finish(mut self, recording: &mut RecordingWriter) -> Result<u64, WorldError> {
        self.write_until(Stamp::MAX, recording)?;
        Ok(self.count)
    }
}

//! An event stream in numbers.

use std::cell::Cell;
use std::path::Path;

use noctule_evk4::{Decoder, EventSink, Format, Geometry, RawFile, Summary};
use noctule_sensor::{Event, TriggerEdge};
use serde::Serialize;

use super::pulses::Pulses;
use super::{InspectError, Options, Watched, by_name};

/// Counts, sums and digest of an event stream; `first` and `last` are in stream order.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct RawReport {
    /// `EVT2`, `EVT2.1` (either word order) or `EVT3`.
    pub format: &'static str,
    /// Sensor columns.
    pub width: u16,
    /// Sensor rows.
    pub height: u16,
    /// Events decoded.
    pub events: u64,
    /// Events that got brighter.
    pub on: u64,
    /// Events that got darker.
    pub off: u64,
    /// Time of the first event, microseconds of the sensor's clock; null without events.
    pub first_us: Option<u64>,
    /// Time of the last event, microseconds of the sensor's clock; null without events.
    pub last_us: Option<u64>,
    /// Sum of columns.
    pub sum_x: u64,
    /// Sum of rows.
    pub sum_y: u64,
    /// SHA-256 over one 13-byte little-endian record per event: t in microseconds (u64), x (u16),
    /// y (u16), p (u8).
    pub events_sha256: String,
    /// Trigger inputs that saw an edge, by channel.
    pub triggers: Vec<TriggerReport>,
    /// Errors by kind, every kind listed.
    #[serde(serialize_with = "by_name")]
    pub errors: Vec<(&'static str, u64)>,
    /// Sum of times, microseconds, modulo 2^64.
    pub sum_us: u64,
    /// Events stamped earlier than the one before.
    pub nonmonotonic: u64,
}

/// Edges on one trigger input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct TriggerReport {
    /// Trigger input, as the sensor numbers it.
    pub channel: u8,
    /// Rising edges.
    pub rising: u64,
    /// Falling edges.
    pub falling: u64,
    /// Time of the first edge, microseconds of the sensor's clock.
    pub first_us: u64,
    /// Time of the last edge, microseconds of the sensor's clock.
    pub last_us: u64,
    /// Sum of all edges' times, microseconds, modulo 2^64.
    pub sum_us: u64,
}

/// Takes a stream's events and edges.
#[derive(Debug, Default)]
pub(super) struct Tap {
    summary: Summary,
    pub(super) pulses: Option<Pulses>,
}

impl Tap {
    pub(super) fn new(pulses: Option<Pulses>) -> Self {
        let summary = Summary::new();
        Self { summary, pulses }
    }

    pub(super) fn report(
        &self,
        format: Format,
        geometry: Geometry,
        decoder: &Decoder,
    ) -> RawReport {
        let summary = &self.summary;
        let triggers = summary.triggers().map(|(channel, edges)| TriggerReport {
            channel,
            rising: edges.rising,
            falling: edges.falling,
            first_us: edges.first_us,
            last_us: edges.last_us,
            sum_us: edges.sum_us,
        });
        RawReport {
            format: format_name(format),
            width: geometry.width,
            height: geometry.height,
            events: summary.events,
            on: summary.on,
            off: summary.off(),
            first_us: summary.first_us,
            last_us: summary.last_us,
            sum_x: summary.sum_x,
            sum_y: summary.sum_y,
            events_sha256: summary.sha256_hex(),
            triggers: triggers.collect(),
            errors: decoder.errors().by_kind().to_vec(),
            sum_us: summary.sum_us,
            nonmonotonic: summary.nonmonotonic,
        }
    }
}

impl EventSink for Tap {
    #[inline]
    fn event(&mut self, event: Event) {
        self.summary.event(event);
    }

    fn trigger(&mut self, edge: TriggerEdge) {
        self.summary.trigger(edge);
        if let Some(pulses) = &mut self.pulses {
            pulses.edge(edge);
        }
    }
}

pub(super) fn inspect(
    path: &Path,
    options: &Options,
    progress: &dyn Fn(u64),
    faults: &mut Vec<InspectError>,
) -> Result<RawReport, InspectError> {
    let position = Cell::new(0);
    let watch = |len| {
        position.set(position.get() + len);
        progress(len);
    };
    let mut file = RawFile::from_reader(Watched::open(path, &watch)?, options.geometry)
        .map_err(InspectError::open_raw(path))?;
    let (format, geometry) = (file.header().format, file.header().geometry);
    let (mut tap, mut decoder) = (Tap::default(), file.decoder());
    loop {
        match file.next_chunk() {
            Ok([]) => break,
            Ok(chunk) => decoder.decode(chunk, &mut tap),
            Err(error) => {
                faults.push(InspectError::io(path, position.get())(error));
                break;
            }
        }
    }
    decoder.finish();
    let bytes = decoder.errors().trailing_bytes;
    if bytes > 0 {
        faults.push(InspectError::RawTrailing {
            path: path.to_owned(),
            offset: position.get() - bytes,
            bytes,
        });
    }
    Ok(tap.report(format, geometry, &decoder))
}

/// The name of an encoding in reports. Both word orders of EVT 2.1 carry the same events.
const fn format_name(format: Format) -> &'static str {
    match format {
        Format::Evt2 => "EVT2",
        Format::Evt21 | Format::Evt21Legacy => "EVT2.1",
        Format::Evt3 => "EVT3",
    }
}

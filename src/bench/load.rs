//! A recording of events at a chosen rate, with the strobe of a camera that is not there.

use std::path::Path;

use noctule_evk4::{EncodeError, Evt3Encoder, Format, Geometry, OpenError, RawFile, RawHeader};
use noctule_recording::{
    Calibration, EventsMeta, GridSize, Meta, RecordingWriter, Rectangle, StrobeMeta,
    StrobePolarity, WriteError,
};
use noctule_sensor::{Event, Realtime, Stamp, TriggerEdge};

/// Length of a USB transfer.
const TRANSFER_US: u64 = 1_000;
/// From opening to opening, as a 5 Hz camera's.
const PERIOD_US: u64 = 200_000;
/// First opening.
const FIRST_US: u64 = 50_000;
/// Nominal width.
const WIDTH_US: u64 = 100_000;
/// Arrival of the first transfer: any instant will do.
const EPOCH_NS: u64 = 1_800_000_000_000_000_000;
/// Events of the source that are repeated.
const TILE_EVENTS_MAX: usize = 2_000_000;

/// What to make.
#[derive(Debug, Clone, Copy)]
pub struct EventLoad {
    /// Events per microsecond, that is Mev/s.
    pub rate_mev_s: u32,
    /// Length.
    pub seconds: u32,
}

/// Why a load could not be made.
#[derive(Debug, thiserror::Error)]
pub enum LoadError {
    /// The source.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// The source, read.
    #[error("{path}: {cause}")]
    Read {
        /// Which.
        path: String,
        /// Why.
        cause: std::io::Error,
    },
    /// The source has nothing to repeat.
    #[error("{0}: no events")]
    Empty(String),
    /// The stream.
    #[error(transparent)]
    Encode(#[from] EncodeError),
    /// The recording.
    #[error(transparent)]
    Write(#[from] WriteError),
}

/// Writes a recording to `dir` in which the events of `source` repeat at the load's rate; without
/// a source, a drifting pattern stands in.
///
/// # Errors
/// When the source cannot be read or the recording not be written.
pub fn write_load(load: EventLoad, source: Option<&Path>, dir: &Path) -> Result<(), LoadError> {
    let (tile, geometry) = match source {
        Some(path) => tile_of(path)?,
        None => (
            pattern(),
            Geometry {
                width: 1280,
                height: 720,
            },
        ),
    };
    let header = RawHeader::new(Format::Evt3, geometry);
    let mut writer = RecordingWriter::create(dir, meta(geometry), &Calibration::default_rig())?;
    writer.events_header(&header.to_bytes())?;
    let mut encoder = Evt3Encoder::new();
    let (mut bytes, mut next) = (Vec::new(), 0);
    let end_us = u64::from(load.seconds) * 1_000_000;
    for t_us in 0..end_us {
        if let Some(edge) = edge_at(t_us) {
            encoder.trigger(edge, &mut bytes)?;
        }
        for _ in 0..load.rate_mev_s {
            let (x, y, on) = tile[next];
            next = (next + 1) % tile.len();
            encoder.event(
                Event {
                    t: Stamp::from_micros(t_us),
                    x,
                    y,
                    on,
                },
                &mut bytes,
            )?;
        }
        if (t_us + 1) % TRANSFER_US == 0 {
            encoder.advance(Stamp::from_micros(t_us), &mut bytes)?;
            encoder.flush(&mut bytes);
            let arrival = Stamp::<Realtime>::from_nanos(EPOCH_NS + (t_us + 1) * 1000);
            writer.event_transfer(&bytes, arrival)?;
            bytes.clear();
        }
    }
    writer.finish()?;
    Ok(())
}

/// The strobe's edge at this microsecond, if there is one. Every fourth exposure is a tick longer,
/// as those of a camera whose exposure is no whole number of ticks.
fn edge_at(t_us: u64) -> Option<TriggerEdge> {
    let since = t_us.checked_sub(FIRST_US)?;
    let (index, phase) = (since / PERIOD_US, since % PERIOD_US);
    let width = WIDTH_US + u64::from(index % 4 == 3);
    let rising = match phase {
        0 => true,
        phase if phase == width => false,
        _ => return None,
    };
    Some(TriggerEdge {
        t: Stamp::from_micros(t_us),
        channel: 0,
        rising,
    })
}

type Pixel = (u16, u16, bool);

fn tile_of(path: &Path) -> Result<(Vec<Pixel>, Geometry), LoadError> {
    let file = RawFile::open(path, None)?;
    let geometry = file.header().geometry;
    let mut events: Vec<Event> = Vec::new();
    file.decode_all(&mut events)
        .map_err(|cause| LoadError::Read {
            path: path.display().to_string(),
            cause,
        })?;
    if events.is_empty() {
        return Err(LoadError::Empty(path.display().to_string()));
    }
    let tile = events
        .iter()
        .take(TILE_EVENTS_MAX)
        .map(|e| (e.x, e.y, e.on))
        .collect();
    Ok((tile, geometry))
}

/// Scattered events over the middle of an HD sensor, from a linear congruence.
fn pattern() -> Vec<Pixel> {
    let mut state = 1_u32;
    let mut next = |below: u16| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        // The high half of a linear congruence is the random one.
        u16::try_from((state >> 16) % u32::from(below)).unwrap_or(0)
    };
    (0..1 << 20)
        .map(|i| (384 + next(512), 104 + next(512), i % 3 != 0))
        .collect()
}

fn meta(geometry: Geometry) -> Meta {
    Meta {
        name: "event load".to_owned(),
        generator: None,
        split: None,
        steps: 8,
        crop: Rectangle {
            x: 0,
            y: 0,
            width: 512,
            height: 512,
        },
        network: GridSize {
            width: 256,
            height: 256,
        },
        events: Some(EventsMeta {
            serial: "load".to_owned(),
            width: geometry.width.into(),
            height: geometry.height.into(),
            strobe: Some(StrobeMeta {
                channel: 0,
                polarity: StrobePolarity::ActiveHigh,
                open_delay_ns: 0,
                close_delay_ns: 0,
            }),
        }),
        camera: None,
        lidar: None,
        can: None,
    }
}

//! The thread of everything slow: CAN frames -> motion, and readings of the host's clocks.

use noctule_can::{MotionConfig, MotionDecoder};
use noctule_recording::Recording;
use noctule_sensor::{Realtime, Stamp};

use super::{Flow, IngestError, Ingested, file_faults};
use crate::host::MotionBlock;
use crate::lane::Producer;
use crate::latency::StreamRow;
use crate::sync::ClockReading;

/// Delivers all CAN frames and clock readings of a recording, in order of arrival.
///
/// # Errors
/// When the recording cannot be read on or the signals make no sense.
pub fn run(
    recording: &Recording,
    signals: &MotionConfig,
    mut lane: Producer<MotionBlock>,
    flow: Flow<'_>,
) -> Result<Ingested, IngestError> {
    let mut decoder = MotionDecoder::new(signals)?;
    let mut frames = recording
        .meta()
        .can
        .is_some()
        .then(|| recording.can_frames())
        .transpose()?;
    let mut readings = recording.clock_readings().ok();
    let mut next_frame = next(&mut frames)?;
    let mut next_reading = next(&mut readings)?;
    let mut arrival = Stamp::<Realtime>::ZERO;
    let (mut frame_count, mut reading_count, mut samples, mut shed) = (0, 0, 0, 0);
    loop {
        let frame_first = match (&next_frame, &next_reading) {
            (Some(frame), Some(reading)) => frame.arrival < reading.realtime,
            (Some(_), None) => true,
            (None, Some(_)) => false,
            (None, None) => break,
        };
        let block = if frame_first {
            let Some(frame) = next_frame.take() else {
                break;
            };
            next_frame = next(&mut frames)?;
            frame_count += 1;
            arrival = arrival.max(frame.arrival);
            decoder
                .push(&frame.frame, arrival)
                .map(|motion| MotionBlock::Motion { motion })
        } else {
            let Some(reading) = next_reading.take() else {
                break;
            };
            next_reading = next(&mut readings)?;
            reading_count += 1;
            arrival = arrival.max(reading.realtime);
            let reading = ClockReading {
                realtime: reading.realtime,
                monotonic: reading.monotonic,
                tai_offset_ns: i64::from(reading.tai_offset_s) * 1_000_000_000,
            };
            Some(MotionBlock::Clocks { reading })
        };
        lane.promise(arrival);
        let Some(block) = block else { continue };
        if flow.pacer.hold(arrival, flow.stop).is_none() {
            break;
        }
        match lane.lease(flow.when_full) {
            Some(mut lease) => {
                *lease = block;
                samples += 1;
                lane.push(lease);
            }
            None if lane.is_abandoned() => break,
            None => {
                shed += 1;
                lane.count_lost(1);
            }
        }
    }
    let counts = decoder.counts();
    let faults = frames.map(|f| f.faults()).unwrap_or_default();
    let mut details = vec![
        ("samples", samples),
        ("clock_readings", reading_count),
        ("unknown", counts.unknown),
    ];
    details.extend(file_faults(faults));
    Ok(Ingested {
        row: StreamRow {
            stream: "motion",
            unit: "frames",
            offered: frame_count + faults.absent_rows,
            received: frame_count,
            lost: faults.absent_rows,
            shed,
            rejected: counts.short + counts.error,
        },
        details,
    })
}

/// The next item of a stream that may be absent.
fn next<T, E>(stream: &mut Option<impl Iterator<Item = Result<T, E>>>) -> Result<Option<T>, E> {
    stream.as_mut().and_then(Iterator::next).transpose()
}

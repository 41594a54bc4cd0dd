//! The frame camera's thread: images and their stamps.

use noctule_camera::SequenceMonitor;
use noctule_recording::Recording;
use noctule_sensor::{Realtime, Stamp};

use super::{Flow, IngestError, Ingested, file_faults};
use crate::host::ImageBlock;
use crate::lane::Producer;
use crate::latency::StreamRow;

/// Delivers all images of a recording.
///
/// # Errors
/// When the recording cannot be read on.
pub fn run(
    recording: &Recording,
    mut lane: Producer<ImageBlock>,
    flow: Flow<'_>,
) -> Result<Ingested, IngestError> {
    let mut monitor = SequenceMonitor::new();
    let mut arrival = Stamp::<Realtime>::ZERO;
    let (mut received, mut shed, mut unreadable) = (0, 0, 0);
    let mut rows = recording.images()?;
    for row in rows.by_ref() {
        let row = row?;
        arrival = arrival.max(row.stamp.arrival);
        lane.promise(arrival);
        let lost_before = monitor.push(row.stamp.sequence);
        let Some(mut block) = lane.lease(flow.when_full) else {
            shed += 1;
            lane.count_lost(1);
            if lane.is_abandoned() {
                break;
            }
            continue;
        };
        // The camera's own work: the pixels are there before the image is due.
        if let Err(error) = recording.read_image(row.index, &mut block.rgb) {
            tracing::warn!("{error}");
            unreadable += 1;
            lane.give_back(block);
            continue;
        }
        let Some(received_ns) = flow.pacer.hold(arrival, flow.stop) else {
            lane.give_back(block);
            break;
        };
        block.stamp = row.stamp;
        block.stamp.arrival = arrival;
        block.received_ns = received_ns;
        block.lost_before = lost_before;
        received += 1;
        lane.push(block);
    }
    let counts = monitor.counts();
    let faults = rows.faults();
    // Those at the end leave no gap in the camera's own numbers.
    let lost = counts.lost + faults.absent_rows;
    let mut details = vec![("late", counts.late), ("duplicate", counts.duplicate)];
    details.extend(file_faults(faults));
    Ok(Ingested {
        row: StreamRow {
            stream: "images",
            unit: "images",
            offered: received + shed + unreadable + lost,
            received,
            lost,
            shed,
            rejected: unreadable,
        },
        details,
    })
}

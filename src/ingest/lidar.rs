//! The LiDAR's thread: datagrams -> returns.

use noctule_hesai::{Arrival, Decoder, Options};
use noctule_recording::Datagrams;
use noctule_sensor::{Realtime, Stamp};

use super::{Flow, IngestError, Ingested, file_faults};
use crate::host::ReturnBlock;
use crate::lane::Producer;
use crate::latency::StreamRow;

/// Decodes all datagrams of a recording.
///
/// # Errors
/// When the recording cannot be read on or the options contradict each other.
pub fn run(
    mut datagrams: Datagrams,
    options: Options,
    mut lane: Producer<ReturnBlock>,
    flow: Flow<'_>,
) -> Result<Ingested, IngestError> {
    let mut decoder = Decoder::new(options)?;
    let mut arrival = Stamp::<Realtime>::ZERO;
    let (mut epoch, mut lost_known, mut sweep, mut shed) = (None, 0, 0, 0);
    while let Some(datagram) = datagrams.next_datagram()? {
        arrival = arrival.max(datagram.t);
        lane.promise(arrival);
        let Some(received_ns) = flow.pacer.hold(arrival, flow.stop) else {
            break;
        };
        let Some(mut block) = lane.lease(flow.when_full) else {
            shed += 1;
            lane.count_lost(1);
            if lane.is_abandoned() {
                break;
            }
            continue;
        };
        block.returns.clear();
        let decoded = decoder.decode(datagram.payload, &mut |echo, number: u32| {
            if block.returns.len() < ReturnBlock::RETURNS_MAX {
                block.returns.push(echo);
            }
            sweep = sweep.max(number);
        });
        let Ok(info) = decoded else {
            lane.give_back(block);
            continue;
        };
        block.arrival = arrival;
        block.received_ns = received_ns;
        block.azimuth_cdeg = info.azimuth_cdeg.into();
        block.start = info.first;
        block.end = info.last;
        block.watermark = decoder.watermark();
        block.sweep = sweep;
        block.clock_jumped = epoch.is_some_and(|known| known != info.epoch);
        epoch = Some(info.epoch);
        let lost = decoder.counts().lost;
        block.lost_before = u32::try_from(lost.saturating_sub(lost_known)).unwrap_or(u32::MAX);
        lost_known = lost_known.max(lost);
        if info.arrival == Arrival::Duplicate {
            lane.give_back(block);
        } else {
            lane.push(block);
        }
    }
    let counts = decoder.counts();
    let skipped = datagrams.skipped();
    let mut details = vec![
        ("returns", counts.returns),
        ("points", counts.points),
        ("sweeps", counts.sweeps),
        ("sweeps_complete", counts.sweeps_complete),
        ("late", counts.late),
        ("duplicate", counts.duplicate),
        ("clock_steps", counts.clock_steps),
        ("not_for_us", skipped.total()),
    ];
    details.extend(counts.rejected.iter());
    let faults = datagrams.faults();
    details.extend(file_faults(faults));
    // Those at the end leave no gap in the sensor's own numbers.
    let lost = counts.lost + faults.absent_rows;
    Ok(Ingested {
        row: StreamRow {
            stream: "lidar",
            unit: "packets",
            offered: counts.packets + lost + shed + counts.rejected.total(),
            received: counts.packets,
            lost,
            shed,
            rejected: counts.rejected.total(),
        },
        details,
    })
}

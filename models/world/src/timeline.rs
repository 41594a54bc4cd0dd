//! When everything happens and arrives in a drive, without rendering anything.
//!
//! The recorder takes its stamps from here, and tests of synchronisation score against it, so
//! both see the same delays and faults.

use noctule_camera::{FrameStamp, StampedAt};
use noctule_recording::{ClockReading, EdgeTruth, ExposureTruth};
use noctule_sensor::{Evk4, Lidar, Realtime, Stamp, Tai, TriggerEdge};

use crate::chance::{Dice, Purpose};
use crate::faults::Faults;
use crate::lidar::{self, FIRINGS_PER_PACKET};
use crate::rig::{DRIVE_START_TAI, Rig, TAI_OFFSET_S, reading};
use crate::shutter::Opening;

/// Vehicle motion is measured every 10 ms.
pub(crate) const MOTION_PERIOD_NS: u64 = 10_000_000;
/// Trigger input of the strobe.
pub(crate) const STROBE_CHANNEL: u8 = 0;

/// One exposure: when, and what became of its edges and image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TimedExposure {
    /// True time since the drive's start.
    pub opening: Opening,
    /// The truth as a recording has it.
    pub truth: ExposureTruth,
}

/// One image that reached the host.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TimedImage {
    /// Number of its exposure.
    pub exposure: u32,
    /// Sequence, stamps and settings; gain 0 dB.
    pub stamp: FrameStamp,
}

/// One LiDAR datagram that reached the host.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TimedPacket {
    /// Counts the packets since the drive's start, lost ones too; also the UDP sequence.
    pub index: u64,
    /// The packet's own time stamp.
    pub start: Stamp<Lidar>,
    /// When its last laser fired.
    pub last_fire: Stamp<Lidar>,
    /// When the host had it.
    pub arrival: Stamp<Realtime>,
}

/// One USB transfer of the event camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TimedTransfer {
    /// It holds what happened from here on...
    pub from: Stamp<Evk4>,
    /// ...until before here.
    pub to: Stamp<Evk4>,
    /// When the host had it; meaningless for a lost one.
    pub arrival: Stamp<Realtime>,
    /// It never arrived.
    pub lost: bool,
}

/// One measurement of the vehicle's motion.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TimedMotion {
    /// When it was true.
    pub measured: Stamp<Tai>,
    /// When the host had it.
    pub arrival: Stamp<Realtime>,
}

/// All instants of a drive; each list in order of arrival.
#[derive(Debug, Clone, PartialEq)]
pub struct Timeline {
    /// Exposures that were complete before the end.
    pub exposures: Vec<TimedExposure>,
    /// Strobe edges as the event camera reported them, lost transfers left out.
    pub edges: Vec<TriggerEdge>,
    /// Images that reached the host.
    pub images: Vec<TimedImage>,
    /// LiDAR datagrams that reached the host.
    pub packets: Vec<TimedPacket>,
    /// USB transfers, lost ones too.
    pub transfers: Vec<TimedTransfer>,
    /// Vehicle motion.
    pub motion: Vec<TimedMotion>,
    /// Readings of the host's clocks, one a second.
    pub readings: Vec<ClockReading>,
    /// The LiDAR's clock at the drive's first packet: zero of its packet clock.
    pub lidar_start: Stamp<Lidar>,
}

/// TAI at `ns` after the drive's start.
pub(crate) fn tai(ns: u64) -> Stamp<Tai> {
    DRIVE_START_TAI.offset_nanos(ns as i64)
}

impl Timeline {
    /// The first `seconds` of the drive of `seed`.
    #[must_use]
    pub fn simulate(rig: &Rig, faults: &Faults, seed: u64, seconds: f64) -> Self {
        let end_ns = (seconds * 1e9) as u64;
        // Packet times are whole microseconds.
        let first = reading(&rig.clocks.lidar, DRIVE_START_TAI).as_micros() + 1;
        let mut timeline = Self {
            exposures: Vec::new(),
            edges: Vec::new(),
            images: Vec::new(),
            packets: Vec::new(),
            transfers: transfers(rig, faults, seed, end_ns),
            motion: motion(rig, seed, end_ns),
            readings: readings(rig, end_ns),
            lidar_start: Stamp::from_micros(first),
        };
        timeline.expose(rig, faults, seed, end_ns);
        timeline.send_packets(rig, faults, seed, end_ns);
        timeline
    }

    /// Strobe edges and images of all exposures; of one cut off by the end only its opening.
    fn expose(&mut self, rig: &Rig, faults: &Faults, seed: u64, end_ns: u64) {
        let mut index = 0;
        loop {
            let opening = rig.shutter.opening(index);
            if opening.open_ns >= end_ns {
                break;
            }
            let mut dice = Dice::numbered(seed, Purpose::Strobe, index);
            let open_edge = self.strobe(rig, faults, opening.open_ns, true, &mut dice);
            if opening.close_ns > end_ns {
                break;
            }
            let close_edge = self.strobe(rig, faults, opening.close_ns, false, &mut dice);
            let image_dropped = self.send_image(rig, faults, &opening, seed);
            let (open_tai, close_tai) = (tai(opening.open_ns), tai(opening.close_ns));
            let truth = ExposureTruth {
                index: index as u32,
                open_tai,
                close_tai,
                open_evk4: reading(&rig.clocks.evk4, open_tai),
                close_evk4: reading(&rig.clocks.evk4, close_tai),
                image_sequence: Some(index as u32),
                image_dropped,
                open_edge,
                close_edge,
            };
            self.exposures.push(TimedExposure { opening, truth });
            index += 1;
        }
        self.edges.sort_by_key(|edge| edge.t);
    }

    fn strobe(
        &mut self,
        rig: &Rig,
        faults: &Faults,
        ns: u64,
        rising: bool,
        dice: &mut Dice,
    ) -> EdgeTruth {
        let (missed, doubled) = (
            dice.chance(faults.edge_missed),
            dice.chance(faults.edge_doubled),
        );
        let bounce_us = dice.range(2.0, 40.0) as u64;
        if missed {
            return EdgeTruth::Missed;
        }
        let at = Stamp::<Evk4>::from_micros(reading(&rig.clocks.evk4, tai(ns)).as_micros());
        let again = doubled.then(|| Stamp::from_micros(at.as_micros() + bounce_us));
        let mut reported = 0;
        for t in [Some(at), again].into_iter().flatten() {
            if !self.is_lost(t) {
                self.edges.push(TriggerEdge {
                    t,
                    channel: STROBE_CHANNEL,
                    rising,
                });
                reported += 1;
            }
        }
        [EdgeTruth::Missed, EdgeTruth::Once, EdgeTruth::Doubled][reported]
    }

    /// Whether `t` was in a transfer that never arrived.
    fn is_lost(&self, t: Stamp<Evk4>) -> bool {
        let after = self.transfers.partition_point(|transfer| transfer.to <= t);
        self.transfers
            .get(after)
            .is_some_and(|transfer| transfer.lost)
    }

    /// Returns whether the image was dropped.
    fn send_image(&mut self, rig: &Rig, faults: &Faults, opening: &Opening, seed: u64) -> bool {
        let mut dice = Dice::numbered(seed, Purpose::Images, opening.index);
        let stamp_ns = opening.close_ns + dice.exponential(rig.jitter.frame_stamp_ns) as u64;
        let delay_ns =
            rig.calibration.delays_ns.camera + dice.exponential(rig.jitter.frame_ns) as u64;
        if dice.chance(faults.image_dropped) {
            return true;
        }
        // The frame cannot be there before the driver stamped it.
        let arrival_ns = (opening.close_ns + delay_ns).max(stamp_ns);
        let stamp = FrameStamp {
            sequence: opening.index as u32,
            driver: reading(&rig.clocks.monotonic, tai(stamp_ns)),
            at: StampedAt::EndOfExposure,
            arrival: reading(&rig.clocks.realtime, tai(arrival_ns)),
            exposure_set_ns: opening.close_ns - opening.open_ns,
            gain_db: 0.0,
        };
        self.images.push(TimedImage {
            exposure: opening.index as u32,
            stamp,
        });
        false
    }

    fn send_packets(&mut self, rig: &Rig, faults: &Faults, seed: u64, end_ns: u64) {
        let end = tai(end_ns);
        let mut line = Fifo::default();
        for index in 0.. {
            let column = index * FIRINGS_PER_PACKET;
            let on_clock = |ns: u64| self.lidar_start.offset_nanos(ns as i64);
            let start = on_clock(lidar::packet_start_ns(column));
            let last_fire = on_clock(lidar::fire_ns(
                column + FIRINGS_PER_PACKET - 1,
                lidar::CHANNELS - 1,
            ));
            let fired = rig.clocks.lidar.apply(last_fire);
            if fired >= end {
                break;
            }
            let mut dice = Dice::numbered(seed, Purpose::Packets, index);
            let (lost, doubled) = (
                dice.chance(faults.packet_lost),
                dice.chance(faults.packet_duplicated),
            );
            let overtaken = dice.chance(faults.packet_reordered);
            let delay = |dice: &mut Dice| {
                rig.calibration.delays_ns.lidar + dice.exponential(rig.jitter.udp_ns) as u64
            };
            let arrival = line.arrive(fired.as_nanos() + delay(&mut dice));
            // An overtaken packet comes behind the next one, 333 us later.
            let arrival = arrival + if overtaken { 360_000 } else { 0 };
            if lost {
                continue;
            }
            let again = doubled.then(|| arrival + 5_000 + delay(&mut dice));
            for arrival in [Some(arrival), again].into_iter().flatten() {
                let arrival = reading(&rig.clocks.realtime, Stamp::from_nanos(arrival));
                self.packets.push(TimedPacket {
                    index,
                    start,
                    last_fire,
                    arrival,
                });
            }
        }
        self.packets
            .sort_by_key(|packet| (packet.arrival, packet.index));
    }
}

/// A line on which nothing overtakes.
#[derive(Default)]
struct Fifo {
    last_ns: u64,
}

impl Fifo {
    fn arrive(&mut self, ns: u64) -> u64 {
        self.last_ns = self.last_ns.max(ns);
        self.last_ns
    }
}

fn transfers(rig: &Rig, faults: &Faults, seed: u64, end_ns: u64) -> Vec<TimedTransfer> {
    let clock = &rig.clocks.evk4;
    let end = reading(clock, tai(end_ns)).as_micros();
    let mut from = reading(clock, tai(0)).as_micros() + 1;
    let mut line = Fifo::default();
    let mut transfers = Vec::new();
    for index in 0.. {
        if from >= end {
            break;
        }
        let to = (from + rig.transfer_us).min(end);
        let mut dice = Dice::numbered(seed, Purpose::Transfers, index);
        let full = clock.apply(Stamp::from_micros(to)).as_nanos();
        let delay = rig.calibration.delays_ns.events + dice.exponential(rig.jitter.usb_ns) as u64;
        let arrival = Stamp::from_nanos(line.arrive(full + delay));
        transfers.push(TimedTransfer {
            from: Stamp::from_micros(from),
            to: Stamp::from_micros(to),
            arrival: reading(&rig.clocks.realtime, arrival),
            lost: dice.chance(faults.transfer_lost),
        });
        from = to;
    }
    transfers
}

fn motion(rig: &Rig, seed: u64, end_ns: u64) -> Vec<TimedMotion> {
    let mut line = Fifo::default();
    (0..)
        .map(|i| (i, i * MOTION_PERIOD_NS))
        .take_while(|&(_, ns)| ns < end_ns)
        .map(|(i, ns)| {
            let mut dice = Dice::numbered(seed, Purpose::Motion, i);
            let measured = tai(ns);
            let delay = rig.calibration.delays_ns.can + dice.exponential(rig.jitter.can_ns) as u64;
            let arrival = Stamp::from_nanos(line.arrive(measured.as_nanos() + delay));
            TimedMotion {
                measured,
                arrival: reading(&rig.clocks.realtime, arrival),
            }
        })
        .collect()
}

fn readings(rig: &Rig, end_ns: u64) -> Vec<ClockReading> {
    (0..=end_ns / 1_000_000_000)
        .map(|second| {
            let now = tai(second * 1_000_000_000);
            ClockReading {
                realtime: reading(&rig.clocks.realtime, now),
                monotonic: reading(&rig.clocks.monotonic, now),
                tai_offset_s: TAI_OFFSET_S,
                phc: None,
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shutter::Tier;

    #[test]
    fn without_faults_everything_arrives_once_and_in_order() {
        let rig = Rig::new(3, Tier::B);
        let timeline = Timeline::simulate(&rig, &Faults::default(), 3, 10.0);
        let packets: Vec<u64> = timeline.packets.iter().map(|p| p.index).collect();
        assert!(packets.iter().copied().eq(0..packets.len() as u64));
        assert!(
            (29_990..=30_000).contains(&packets.len()),
            "{}",
            packets.len()
        );
        assert_eq!(timeline.images.len(), timeline.exposures.len());
        assert!(timeline.edges.len() >= 2 * timeline.exposures.len());
        assert!(timeline.packets.is_sorted_by_key(|p| p.arrival));
        assert!(timeline.transfers.is_sorted_by_key(|t| t.arrival));
        assert!(timeline.transfers.windows(2).all(|w| w[0].to == w[1].from));
        assert_eq!((timeline.motion.len(), timeline.readings.len()), (1000, 11));
        assert!(
            timeline
                .edges
                .windows(2)
                .all(|w| w[0].t <= w[1].t && w[0].rising != w[1].rising)
        );
    }

    #[test]
    fn delays_have_their_fixed_part_and_their_mean() {
        let rig = Rig::new(5, Tier::A);
        let timeline = Timeline::simulate(&rig, &Faults::default(), 5, 20.0);
        let delays: Vec<i64> = timeline
            .packets
            .iter()
            .map(|p| {
                rig.clocks
                    .realtime
                    .apply(p.arrival)
                    .diff_nanos(rig.clocks.lidar.apply(p.last_fire))
            })
            .collect();
        let least = delays.iter().copied().min().expect("there are packets");
        let mean = delays.iter().sum::<i64>() as f64 / delays.len() as f64;
        assert!((60_000..60_100).contains(&least), "{least}");
        assert!((mean - 90_000.0).abs() < 1_500.0, "{mean}");
        for image in &timeline.images {
            let close = timeline.exposures[image.exposure as usize].truth.close_tai;
            assert!(rig.clocks.monotonic.apply(image.stamp.driver) >= close);
            assert!(
                rig.clocks
                    .realtime
                    .apply(image.stamp.arrival)
                    .diff_nanos(close)
                    >= 400_000
            );
        }
    }

    #[test]
    fn faults_come_at_their_rates_and_are_told_in_the_truth() {
        let rig = Rig::new(9, Tier::A);
        let faults = Faults {
            transfer_lost: 0.003,
            ..Faults::rough()
        };
        let timeline = Timeline::simulate(&rig, &faults, 9, 200.0);
        let sent = 200.0 * 3000.0;
        let mut seen: Vec<u64> = timeline.packets.iter().map(|p| p.index).collect();
        let swaps = seen.windows(2).filter(|w| w[1] < w[0]).count() as f64;
        seen.sort_unstable();
        let total = seen.len() as f64;
        seen.dedup();
        let rate = |count: f64| count / sent;
        assert!((rate(sent - seen.len() as f64) - 0.01).abs() < 0.001);
        assert!((rate(total - seen.len() as f64) - 0.002).abs() < 0.0005);
        assert!(swaps / sent > 0.001 && swaps / sent < 0.004, "{swaps}");
        let dropped = timeline
            .exposures
            .iter()
            .filter(|e| e.truth.image_dropped)
            .count();
        assert_eq!(dropped + timeline.images.len(), timeline.exposures.len());
        let reported: usize = timeline
            .exposures
            .iter()
            .flat_map(|e| [e.truth.open_edge, e.truth.close_edge])
            .map(|edge| match edge {
                EdgeTruth::Missed => 0,
                EdgeTruth::Once => 1,
                EdgeTruth::Doubled => 2,
            })
            .sum();
        assert!(
            timeline.edges.len().abs_diff(reported) <= 2,
            "but for an exposure cut off"
        );
        let missed = 2 * timeline.exposures.len() - reported.min(2 * timeline.exposures.len());
        assert!(missed > 5, "{missed}");
    }

    #[test]
    fn a_longer_drive_begins_with_the_shorter_one() {
        let rig = Rig::new(2, Tier::B);
        let faults = Faults::rough();
        let short = Timeline::simulate(&rig, &faults, 2, 2.0);
        let long = Timeline::simulate(&rig, &faults, 2, 5.0);
        let n = short.exposures.len();
        assert_eq!(short.exposures[..], long.exposures[..n]);
        let last = short.packets.len() - 3;
        assert_eq!(short.packets[..last], long.packets[..last]);
    }
}

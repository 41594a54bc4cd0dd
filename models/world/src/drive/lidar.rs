//! The LiDAR's datagrams, scanned in blocks of a turn and sent in order of arrival.

use std::collections::VecDeque;

use noctule_hesai::{QT64_PACKET_LEN, Qt64Encoder, ReturnMode};
use noctule_raster::SparseRaster;
use noctule_recording::RecordingWriter;
use noctule_sensor::{Return, Stamp, Tai};

use super::{DriveOptions, measured_motion};
use crate::error::WorldError;
use crate::lidar::{COLUMNS, Column, FIRINGS_PER_PACKET, Scanner, fire_ns};
use crate::optics::Optics;
use crate::rig::DRIVE_START_TAI;
use crate::scene::Scene;
use crate::sparse;
use crate::timeline::{MOTION_PERIOD_NS, TimedPacket, Timeline, tai};

/// Packets scanned together: one turn.
const BLOCK: u64 = COLUMNS / FIRINGS_PER_PACKET;

/// Scans, encodes and sends; keeps the sparse depth that a perfectly synchronised host would see.
pub(super) struct LidarStream<'a> {
    options: &'a DriveOptions,
    timeline: &'a Timeline,
    scanner: Scanner,
    encoder: Qt64Encoder,
    raster: SparseRaster,
    /// Encoded packets, the first of which is number `first`.
    encoded: VecDeque<[u8; QT64_PACKET_LEN]>,
    first: u64,
    /// What is still to be sent.
    unsent: &'a [TimedPacket],
    /// Packets whose returns the raster has.
    drawn: u64,
    motion: u64,
}

impl<'a> LidarStream<'a> {
    pub(super) fn new(
        options: &'a DriveOptions,
        timeline: &'a Timeline,
    ) -> Result<Self, WorldError> {
        let calibration = &options.rig.calibration;
        Ok(Self {
            options,
            timeline,
            scanner: Scanner::new(options.seed, calibration.camera_from_lidar),
            encoder: Qt64Encoder::new(ReturnMode::FirstLast, 600, 0)?,
            raster: sparse::drawer(calibration, &Optics::new(options.rig.grid))?,
            encoded: VecDeque::new(),
            first: 0,
            unsent: &timeline.packets,
            drawn: 0,
            motion: 0,
        })
    }

    /// True time of an instant on the packet clock.
    fn tai(&self, on_clock_ns: u64) -> Stamp<Tai> {
        self.options
            .rig
            .clocks
            .lidar
            .apply(self.timeline.lidar_start.offset_nanos(on_clock_ns as i64))
    }

    /// Scans and sends everything fired before `end_ns` of the drive.
    pub(super) fn send_until(
        &mut self,
        scene: &Scene,
        end_ns: u64,
        recording: &mut RecordingWriter,
    ) -> Result<(), WorldError> {
        let end = if end_ns == u64::MAX {
            Stamp::MAX
        } else {
            tai(end_ns)
        };
        let lidar = self.options.rig.clocks.lidar;
        while let Some(next) = self.unsent.first() {
            if lidar.apply(next.start) >= end {
                break;
            }
            self.scan_until(scene, next.index)?;
            let at = (next.index - self.first) as usize;
            recording.datagram(&self.encoded[at], next.arrival)?;
            self.unsent = &self.unsent[1..];
        }
        Ok(())
    }

    /// Makes sure that packet `index` is encoded.
    fn scan_until(&mut self, scene: &Scene, index: u64) -> Result<(), WorldError> {
        while index >= self.first + self.encoded.len() as u64 {
            let begin = self.first + self.encoded.len() as u64;
            let columns = begin * FIRINGS_PER_PACKET..(begin + BLOCK) * FIRINGS_PER_PACKET;
            let indices: Vec<u64> = columns.collect();
            let seconds = |ns: u64| self.tai(ns).diff_nanos(DRIVE_START_TAI) as f64 * 1e-9;
            let columns = self.scanner.scan(scene, &indices, seconds);
            for pair in columns.chunks_exact(FIRINGS_PER_PACKET as usize) {
                let start = self
                    .timeline
                    .lidar_start
                    .offset_nanos(crate::lidar::packet_start_ns(pair[0].index) as i64);
                let firings =
                    [&pair[0], &pair[1]].map(|column| (column.azimuth_cdeg, column.to_wire()));
                self.encoded.push_back(self.encoder.dual(start, &firings)?);
            }
            self.watch(scene, &columns)?;
            // A packet overtaken or doubled belongs to the block before at most.
            while self.encoded.len() as u64 > 3 * BLOCK {
                self.encoded.pop_front();
                self.first += 1;
            }
        }
        Ok(())
    }

    /// Feeds the sparse raster with what arrives of these columns, at their true times.
    fn watch(&mut self, scene: &Scene, columns: &[Column]) -> Result<(), WorldError> {
        let last = columns
            .last()
            .map_or(0, |column| column.index / FIRINGS_PER_PACKET);
        let mut arrives = vec![false; (last + 1 - self.drawn) as usize];
        for packet in self.unsent.iter().take(2 * arrives.len() + 64) {
            if let Some(flag) = packet
                .index
                .checked_sub(self.drawn)
                .and_then(|i| arrives.get_mut(i as usize))
            {
                *flag = true;
            }
        }
        let horizon_ns = self
            .tai(fire_ns(last * FIRINGS_PER_PACKET + 1, 0))
            .diff_nanos(DRIVE_START_TAI) as u64;
        while self.motion * MOTION_PERIOD_NS <= horizon_ns + 100_000_000 {
            let t_ns = self.motion * MOTION_PERIOD_NS;
            let (speed, yaw_rate) =
                measured_motion(scene, self.options.seed, self.motion, t_ns as f64 * 1e-9);
            self.raster
                .push_motion(tai(t_ns), speed as f32, yaw_rate as f32)?;
            self.motion += 1;
        }
        let mut returns: Vec<Return> = Vec::new();
        for column in columns {
            if !arrives[(column.index / FIRINGS_PER_PACKET - self.drawn) as usize] {
                continue;
            }
            self.raster.note_block(
                self.tai(fire_ns(column.index, 0)),
                u32::from(column.azimuth_cdeg),
            );
            returns.clear();
            column.append_returns(0, &mut returns);
            for echo in &returns {
                self.raster.push_return(self.tai(echo.t.as_nanos()), echo);
            }
        }
        self.drawn = last + 1;
        Ok(())
    }

    /// Sparse depth at the given instants, `[T, H, W]`.
    pub(super) fn sparse(
        &mut self,
        centres: impl Iterator<Item = Stamp<Tai>>,
    ) -> Result<Vec<f32>, WorldError> {
        Ok(sparse::draw(&mut self.raster, centres)?)
    }
}

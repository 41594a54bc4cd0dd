//! From packets to returns: order, clock and sweeps first, then the arithmetic.

use noctule_sensor::{Lidar, Stamp};
use pulp::Arch;

use super::firing::{Job, Scratch};
use super::geometry::{Circle, Geometry};
use super::stream::{Arrival, Observed, Stream};
use super::sweep::Sweeps;
use super::{Counts, Options, OptionsError, Packet, PacketError, ReturnMode, ReturnSink};

/// What a valid packet said about itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PacketInfo {
    /// UDP sequence number, where the sensor sends one.
    pub sequence: Option<u32>,
    /// How it follows those before it.
    pub arrival: Arrival,
    /// Counts clock steps and restarts: times of different epochs must not be compared.
    pub epoch: u32,
    /// When its first laser fired.
    pub first: Stamp<Lidar>,
    /// When its last laser fired; what an arrival time lies shortly after.
    pub last: Stamp<Lidar>,
    /// Which echoes it holds.
    pub return_mode: ReturnMode,
    /// Motor speed, turns per minute.
    pub rpm: u16,
    /// Azimuth of its first block, hundredths of a degree.
    pub azimuth_cdeg: u16,
    /// Non-zero returns in it; 0 for a duplicate.
    pub returns: u32,
    /// Non-zero returns with equal ones of the same firing counted once; 0 for a duplicate.
    pub points: u32,
}

/// Packets of one sensor in, returns out. Allocates nothing after `new`.
#[derive(Debug, Clone)]
pub struct Decoder {
    options: Options,
    geometry: Box<Geometry>,
    circle: Box<Circle>,
    scratch: Box<Scratch>,
    arch: Arch,
    /// Speed the geometry is turned on for.
    turning_rpm: u16,
    stream: Stream,
    sweeps: Sweeps,
    counts: Counts,
    epoch: u32,
    watermark: Watermark,
}

impl Decoder {
    /// A decoder that has seen nothing yet.
    ///
    /// # Errors
    /// When a table is for another model, or the cut is not on the circle.
    pub fn new(options: Options) -> Result<Self, OptionsError> {
        let model = options.model;
        if options.correction.model() != model {
            return Err(OptionsError::Correction {
                table: options.correction.model(),
                model,
            });
        }
        if options.fire_times.model() != model {
            return Err(OptionsError::FireTimes {
                table: options.fire_times.model(),
                model,
            });
        }
        if options.cut_azimuth_cdeg >= 36_000 {
            return Err(OptionsError::Cut(options.cut_azimuth_cdeg));
        }
        Ok(Self {
            geometry: Box::new(geometry(&options, 0)),
            circle: Box::new(Circle::new()),
            scratch: Box::new(Scratch::new()),
            arch: Arch::new(),
            turning_rpm: 0,
            options,
            stream: Stream::new(),
            sweeps: Sweeps::new(),
            counts: Counts::default(),
            epoch: 0,
            watermark: Watermark::default(),
        })
    }

    /// The settings it was made with.
    #[must_use]
    pub fn options(&self) -> &Options {
        &self.options
    }

    /// Totals so far.
    #[must_use]
    pub fn counts(&self) -> &Counts {
        &self.counts
    }

    /// No return fired earlier than this will follow in this epoch; `None` before the first packet.
    ///
    /// Held back while up to 16 packets could still fill a gap; a packet that comes even later is
    /// decoded all the same, and told by its [`Arrival::Late`].
    #[must_use]
    pub fn watermark(&self) -> Option<Stamp<Lidar>> {
        self.watermark.value()
    }

    /// Decodes one datagram and hands its returns to `sink`, firing by firing, channel 0 upwards,
    /// the echoes of a channel in the order of their blocks.
    ///
    /// # Errors
    /// Why the datagram is no packet of the model. It is counted and leaves the rest untouched.
    pub fn decode(
        &mut self,
        payload: &[u8],
        sink: &mut impl ReturnSink,
    ) -> Result<PacketInfo, PacketError> {
        let packet = match Packet::new(self.options.model, payload) {
            Ok(packet) => packet,
            Err(error) => {
                self.counts.rejected.add(&error);
                return Err(error);
            }
        };
        self.counts.packets += 1;
        let observed = self.observe(&packet);
        let mut info = self.info(&packet, observed.arrival);
        if observed.arrival != Arrival::Duplicate {
            self.turn_to(packet.rpm());
            self.fire(&packet, observed, &mut info, sink);
        }
        self.counts.returns += u64::from(info.returns);
        self.counts.points += u64::from(info.points);
        Ok(info)
    }

    fn observe(&mut self, packet: &Packet<'_>) -> Observed {
        let firings = self.options.model.blocks() / packet.return_mode().returns();
        let firing_ns = i64::from(self.options.model.firing_interval_ns());
        let interval_ns = firing_ns * i64::try_from(firings).unwrap_or(1);
        let observed = self
            .stream
            .observe(packet.sequence(), packet.time_ns(), interval_ns);
        let counts = &mut self.counts;
        match observed.arrival {
            Arrival::Gap(missing) => counts.lost += u64::from(missing),
            Arrival::Late => {
                counts.late += 1;
                counts.lost -= u64::from(observed.fills);
            }
            Arrival::Duplicate => counts.duplicate += 1,
            Arrival::Restart => counts.restarts += 1,
            Arrival::First | Arrival::Next | Arrival::Hole => {}
        }
        if observed.clock_step {
            counts.clock_steps += 1;
            self.epoch += 1;
        }
        observed
    }

    fn info(&self, packet: &Packet<'_>, arrival: Arrival) -> PacketInfo {
        let blocks = self.options.model.blocks();
        let (least, most) = self.geometry.fire_range_ns;
        let stamp = |block, fire_ns| {
            let ns = self.block_ns(packet, block) + i64::from(fire_ns);
            Stamp::from_nanos(packet.time_ns()).offset_nanos(ns)
        };
        PacketInfo {
            sequence: packet.sequence(),
            arrival,
            epoch: self.epoch,
            first: stamp(0, least),
            last: stamp(blocks - 1, most),
            return_mode: packet.return_mode(),
            rpm: packet.rpm(),
            azimuth_cdeg: packet.azimuth_cdeg(0),
            returns: 0,
            points: 0,
        }
    }

    /// From the packet's time to the block's.
    fn block_ns(&self, packet: &Packet<'_>, block: usize) -> i64 {
        if !self.options.fire_times.has_blocks() {
            return 0;
        }
        let spec = self.options.model.spec();
        spec.block_time
            .nanos(block, spec.blocks, packet.return_mode().returns())
    }

    /// Keeps the directions true to the motor's speed, if so configured.
    fn turn_to(&mut self, rpm: u16) {
        if self.options.turn_while_firing && rpm != self.turning_rpm {
            self.turning_rpm = rpm;
            *self.geometry = geometry(&self.options, rpm);
        }
    }

    fn fire(
        &mut self,
        packet: &Packet<'_>,
        observed: Observed,
        info: &mut PacketInfo,
        sink: &mut impl ReturnSink,
    ) {
        let returns = packet.return_mode().returns();
        let firings = self.options.model.blocks() / returns;
        let first = self
            .sweeps
            .unwind(info.azimuth_cdeg, observed.elapsed_ns, info.rpm);
        let mut angle = first;
        for index in 1..firings {
            angle = Sweeps::unwind_next(packet.azimuth_cdeg(index * returns), angle);
        }
        self.follow(observed, info, (first, angle));

        angle = first;
        for index in 0..firings {
            let block = index * returns;
            angle = Sweeps::unwind_next(packet.azimuth_cdeg(block), angle);
            let t = packet
                .time_ns()
                .wrapping_add_signed(self.block_ns(packet, block));
            let job = Job {
                packet,
                block,
                t_ns: t,
                angle,
                geometry: &self.geometry,
                circle: &self.circle,
                sweeps: &self.sweeps,
                options: &self.options,
                arch: self.arch,
            };
            let (found, unique) = job.run(&mut self.scratch, sink);
            info.returns += found;
            info.points += unique;
        }
    }

    /// Tells sweeps and watermark of a packet whose blocks span `angles`.
    fn follow(&mut self, observed: Observed, info: &PacketInfo, angles: (i64, i64)) {
        let seam = self.geometry.seam;
        let number = info.sequence.unwrap_or(0);
        let gap = match observed.arrival {
            Arrival::Late => {
                self.sweeps.fill(number);
                self.watermark.late(observed.fills);
                return;
            }
            Arrival::Gap(missing) => Some((number.wrapping_sub(missing), missing)),
            _ => None,
        };
        if observed.clock_step {
            self.sweeps.interrupt(angles.0);
            self.watermark = Watermark::default();
        }
        if observed.arrival == Arrival::Hole {
            self.sweeps.hole(angles.0, seam);
        }
        self.sweeps.advance(angles.0, angles.1, gap, seam);
        self.watermark
            .advance(info.last, gap.map_or(0, |(_, missing)| missing));
        let sweeps = self.sweeps.counts();
        self.counts.sweeps = sweeps.touched;
        self.counts.sweeps_complete = sweeps.complete;
    }
}

fn geometry(options: &Options, turning_rpm: u16) -> Geometry {
    let Options {
        correction,
        fire_times,
        cut_azimuth_cdeg,
        ..
    } = options;
    Geometry::new(correction, fire_times, *cut_azimuth_cdeg, turning_rpm)
}

/// Packets for which a gap holds the watermark back.
const PATIENCE: u32 = 16;

#[derive(Debug, Clone, Copy, Default)]
struct Watermark {
    newest: Option<Stamp<Lidar>>,
    /// Where it stood before the gap, the packets still missing, and the packets left to wait for.
    held: Option<(Stamp<Lidar>, u32, u32)>,
}

impl Watermark {
    fn value(&self) -> Option<Stamp<Lidar>> {
        self.held.map(|(stamp, _, _)| stamp).or(self.newest)
    }

    fn advance(&mut self, last: Stamp<Lidar>, missing: u32) {
        self.held = match (self.held, self.newest) {
            (Some((at, lost, left)), _) => left
                .checked_sub(1)
                .map(|left| (at, lost.saturating_add(missing), left)),
            (None, Some(at)) if missing > 0 => Some((at, missing, PATIENCE)),
            _ => None,
        };
        self.newest = self.newest.max(Some(last));
    }

    fn late(&mut self, fills: bool) {
        if let Some((_, lost, _)) = &mut self.held {
            *lost -= u32::from(fills && *lost > 0);
            if *lost == 0 {
                self.held = None;
            }
        }
    }
}

//! Cutting the stream into sweeps, per channel, on the corrected azimuth.
//!
//! The block azimuth is unwound into one growing angle, from time and motor speed where packets
//! are missing. A channel's sweep is then a division, whatever the order of arrival: no seam has
//! to be seen for a sweep to end.

/// Hundredths of a degree in a turn.
pub(crate) const TURN: i64 = 36_000;

/// Sweeps whose fate is still open; late packets reach no further back.
const OPEN: usize = 8;
/// Gaps remembered for late packets to fill; older ones stay gaps.
const GAPS: usize = 32;

/// The least and greatest block angle at which a channel crosses the cut: `ceil(cut - offset)`,
/// hundredths of a degree.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Seam {
    pub first: i64,
    pub last: i64,
}

impl Seam {
    /// The sweeps that the channels of a block at `angle` belong to, least and greatest.
    pub fn sweeps(self, angle: i64) -> (i64, i64) {
        (
            (angle - self.last).div_euclid(TURN),
            (angle - self.first).div_euclid(TURN),
        )
    }
}

/// What the sweeps seen so far add up to.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct SweepCounts {
    /// Sweeps of which at least one block arrived.
    pub touched: u64,
    /// Sweeps of which every block arrived.
    pub complete: u64,
}

#[derive(Debug, Clone, Copy, Default)]
struct Sweep {
    index: i64,
    /// Seen from its first block on.
    from_start: bool,
    /// Gaps that touch it and are not filled.
    gaps: u32,
    /// A clock step, a restart or an unnumbered hole lies in it.
    broken: bool,
    ended: bool,
}

#[derive(Debug, Clone, Copy, Default)]
struct Gap {
    first: u32,
    len: u32,
    missing: u32,
    sweeps: (i64, i64),
}

/// The turning sensor, unwound.
#[derive(Debug, Clone)]
pub(crate) struct Sweeps {
    /// Angle of the newest block; `None` before the first.
    newest: Option<i64>,
    /// Angle from which on the stream has been watched.
    watched_from: i64,
    /// Index of the sweep called 0.
    origin: i64,
    /// Greatest index touched.
    top: i64,
    open: [Sweep; OPEN],
    gaps: [Gap; GAPS],
    next_gap: usize,
    counts: SweepCounts,
}

impl Sweeps {
    pub fn new() -> Self {
        let none = Sweep {
            index: i64::MIN,
            ended: true,
            ..Sweep::default()
        };
        Self {
            newest: None,
            watched_from: 0,
            origin: 0,
            top: i64::MIN,
            open: [none; OPEN],
            gaps: [Gap::default(); GAPS],
            next_gap: 0,
            counts: SweepCounts::default(),
        }
    }

    pub fn counts(&self) -> SweepCounts {
        self.counts
    }

    /// Sweep number, from 0 on, of the sweep with that index.
    pub fn number(&self, index: i64) -> u32 {
        // What arrives from before the first packet joins sweep 0.
        u32::try_from((index - self.origin).max(0)).unwrap_or(u32::MAX)
    }

    /// Unwinds the azimuth of a packet's first block, `elapsed_ns` after the newest.
    pub fn unwind(&self, azimuth_cdeg: u16, elapsed_ns: i64, rpm: u16) -> i64 {
        let azimuth = i64::from(azimuth_cdeg);
        let Some(newest) = self.newest else {
            return azimuth;
        };
        // Turns per minute to hundredths of a degree per nanosecond: 36,000 / 60e9.
        let advance = elapsed_ns.saturating_mul(i64::from(rpm) * 6) / 10_000_000;
        let predicted = newest.saturating_add(advance);
        nearest(azimuth, predicted)
    }

    /// Unwinds the azimuth of a packet's next firing after one at `angle`.
    pub fn unwind_next(azimuth_cdeg: u16, angle: i64) -> i64 {
        nearest(i64::from(azimuth_cdeg), angle)
    }

    /// Takes note of a packet in order that covers `first..=last`, after `gap` (first missing
    /// number and their count) if there was one.
    pub fn advance(&mut self, first: i64, last: i64, gap: Option<(u32, u32)>, seam: Seam) {
        let before = self.newest;
        if before.is_none() {
            self.watched_from = first;
            self.origin = seam.sweeps(first).0;
        }
        self.touch(seam.sweeps(first).0, seam.sweeps(last).1, seam);
        if let (Some((number, len)), Some(before)) = (gap, before) {
            // The missing firings lie strictly between; packets are evenly spaced.
            let step = (first - before).max(0) / (i64::from(len) + 1).max(1) / 4;
            let sweeps = (seam.sweeps(before + step).0, seam.sweeps(first - step).1);
            self.open_gap(Gap {
                first: number,
                len,
                missing: len,
                sweeps,
            });
        }
        self.newest = Some(before.map_or(last, |b| b.max(last)));
        self.end_before(seam.sweeps(last).0);
    }

    /// What comes from `first` on does not continue what came before: the sweeps in progress
    /// cannot become whole any more.
    pub fn interrupt(&mut self, first: i64) {
        self.watched_from = first;
        for sweep in &mut self.open {
            sweep.broken |= !sweep.ended;
        }
    }

    /// A hole without numbers ends at `first`.
    pub fn hole(&mut self, first: i64, seam: Seam) {
        let Some(before) = self.newest else { return };
        let (low, high) = (seam.sweeps(before + 1).0, seam.sweeps(first - 1).1);
        self.touch(low.max(self.top), high, seam);
        for sweep in &mut self.open {
            sweep.broken |= !sweep.ended && (low..=high).contains(&sweep.index);
        }
    }

    /// The late packet of that number has come.
    pub fn fill(&mut self, number: u32) {
        let of = |gap: &&mut Gap| number.wrapping_sub(gap.first) < gap.len && gap.missing > 0;
        let Some(gap) = self.gaps.iter_mut().find(of) else {
            return;
        };
        gap.missing -= 1;
        if gap.missing > 0 {
            return;
        }
        let (low, high) = gap.sweeps;
        for sweep in &mut self.open {
            if (low..=high).contains(&sweep.index) && sweep.gaps > 0 {
                sweep.gaps -= 1;
                self.counts.complete += u64::from(sweep.ended && sweep.is_complete());
            }
        }
    }

    /// Opens the sweeps `low..=high` that are new.
    fn touch(&mut self, low: i64, high: i64, seam: Seam) {
        let from = low.max(self.top.saturating_add(1));
        for index in from..=high {
            let oldest = (0..OPEN).min_by_key(|&i| self.open[i].index).unwrap_or(0);
            self.open[oldest] = Sweep {
                index,
                from_start: self.watched_from <= index * TURN + seam.first,
                ..Sweep::default()
            };
            self.counts.touched += 1;
        }
        self.top = self.top.max(high);
    }

    fn open_gap(&mut self, gap: Gap) {
        for sweep in &mut self.open {
            sweep.gaps += u32::from((gap.sweeps.0..=gap.sweeps.1).contains(&sweep.index));
        }
        self.gaps[self.next_gap % GAPS] = gap;
        self.next_gap += 1;
    }

    /// Every channel has passed the cut into sweep `index`.
    fn end_before(&mut self, index: i64) {
        for sweep in &mut self.open {
            if !sweep.ended && sweep.index < index {
                sweep.ended = true;
                self.counts.complete += u64::from(sweep.is_complete());
            }
        }
    }
}

impl Sweep {
    fn is_complete(&self) -> bool {
        self.from_start && self.gaps == 0 && !self.broken
    }
}

/// The angle congruent to `azimuth` that lies nearest to `predicted`.
fn nearest(azimuth: i64, predicted: i64) -> i64 {
    let ahead = (azimuth - predicted).rem_euclid(TURN);
    let ahead = if ahead > TURN / 2 {
        ahead - TURN
    } else {
        ahead
    };
    predicted.saturating_add(ahead)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SEAM: Seam = Seam {
        first: -870,
        last: 789,
    };
    const STEP: i64 = 120;
    const PACKET_NS: i64 = 333_333;

    /// A sensor at 600 rpm, one packet per 1.2 degrees with firings at 0 and 0.6.
    struct Rig {
        sweeps: Sweeps,
        sent: i64,
        lost: u32,
    }

    impl Rig {
        fn new() -> Self {
            Self {
                sweeps: Sweeps::new(),
                sent: -1,
                lost: 0,
            }
        }

        fn azimuth(number: i64) -> u16 {
            u16::try_from((number * STEP).rem_euclid(TURN)).unwrap()
        }

        fn packet(&mut self) {
            self.sent += 1;
            let elapsed = PACKET_NS * i64::from(self.lost + 1);
            let first = self.sweeps.unwind(Self::azimuth(self.sent), elapsed, 600);
            assert_eq!(first, self.sent * STEP, "unwound");
            let missing = u32::try_from(self.sent).unwrap() - self.lost;
            let gap = (self.lost > 0).then_some((missing, self.lost));
            self.sweeps.advance(first, first + 60, gap, SEAM);
            self.lost = 0;
        }

        fn run(&mut self, packets: i64) {
            (0..packets).for_each(|_| self.packet());
        }

        fn lose(&mut self, packets: u32) {
            self.sent += i64::from(packets);
            self.lost += packets;
        }

        fn counts(&self) -> (u64, u64) {
            let SweepCounts { touched, complete } = self.sweeps.counts();
            (touched, complete)
        }
    }

    #[test]
    fn the_first_and_the_last_sweep_are_partial() {
        let mut rig = Rig::new();
        rig.run(930);
        // Channels ahead of the cut at the start are in sweep 1 already, and have missed its start.
        assert_eq!(rig.counts(), (5, 2));
    }

    #[test]
    fn a_lost_packet_costs_one_sweep_and_no_more() {
        let mut rig = Rig::new();
        rig.run(1_000);
        rig.lose(1);
        rig.run(1_000);
        let (touched, complete) = rig.counts();
        assert_eq!((touched, complete), (8, 4));
    }

    #[test]
    fn a_lost_seam_costs_two_and_several_lost_turns_keep_the_count() {
        let mut rig = Rig::new();
        rig.run(590);
        rig.lose(20);
        rig.run(390 + 300);
        // Sweeps 0 and 1 start before the first packet, 2 and 3 touch the gap... 2 ends there.
        assert_eq!(rig.counts(), (6, 1));
        let mut rig = Rig::new();
        rig.run(450);
        rig.lose(5 * 300);
        rig.run(300);
        let top = rig.sweeps.number(rig.sweeps.top);
        assert_eq!(top, 8, "sweeps are numbered by turns, seen or not");
    }

    #[test]
    fn late_packets_make_a_sweep_whole_again() {
        let mut rig = Rig::new();
        rig.run(700);
        rig.lose(2);
        rig.run(3);
        rig.sweeps.fill(701);
        rig.run(400);
        let before = rig.counts().1;
        rig.sweeps.fill(700);
        assert_eq!(rig.counts().1, before + 1);
    }

    #[test]
    fn interrupted_sweeps_stay_partial() {
        let mut rig = Rig::new();
        rig.run(700);
        rig.sweeps.interrupt(700 * STEP);
        rig.run(600);
        assert_eq!(rig.counts(), (6, 2));
    }

    #[test]
    fn behind_the_newest_is_unwound_backwards() {
        let mut rig = Rig::new();
        rig.run(301);
        // Packet 299, of the turn before, arrives after packet 300.
        assert_eq!(rig.sweeps.unwind(35_880, -PACKET_NS, 600), 35_880);
        assert_eq!(rig.sweeps.unwind(120, PACKET_NS, 600), 36_120);
    }
}

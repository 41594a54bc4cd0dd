//! Which packets are missing, late or doubled, and whether the sensor's clock stepped.
//!
//! Judged from sequence numbers and packet times alone: no clock is read here.

/// How a packet follows those before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Arrival {
    /// The first of the stream.
    First,
    /// The next in order.
    Next,
    /// Later than the next: this many before it are missing so far.
    Gap(u32),
    /// As `Gap`, in a stream without sequence numbers: time passed without packets.
    Hole,
    /// Older than the newest, and new. It fills a gap if one was counted.
    Late,
    /// Seen before; its returns are not handed out again.
    Duplicate,
    /// The numbering jumped in a way loss does not explain: the sensor started anew.
    Restart,
}

/// What [`Stream::observe`] found out about one packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Observed {
    pub arrival: Arrival,
    /// Whether the sensor's clock jumped between the newest packet and this one.
    pub clock_step: bool,
    /// Whether a late packet was among those counted missing.
    pub fills: bool,
    /// Time from the newest packet to this one, nanoseconds; from the numbering where the clock
    /// stepped.
    pub elapsed_ns: i64,
}

/// Packets back from the newest of which each is known to be seen or not.
const WINDOW: u32 = 1024;
const WORDS: usize = 16;
/// Without sequence numbers: the longest silence that is a hole and no clock step.
const HOLE_MAX_NS: i64 = 1_000_000_000;
/// Without sequence numbers: the packets back at which a time is late and no clock step.
const LATE_MAX: i64 = 32;

/// The order of one sensor's packets.
#[derive(Debug, Clone)]
pub(crate) struct Stream {
    newest: Option<Newest>,
    /// A ring of bits, one per packet: seen or not.
    seen: [u64; WORDS],
    /// Where in the ring the newest is.
    head: usize,
    /// Packets back from the newest that `seen` speaks of.
    known: u32,
}

#[derive(Debug, Clone, Copy)]
struct Newest {
    sequence: Option<u32>,
    time_ns: u64,
}

impl Stream {
    pub const fn new() -> Self {
        Self {
            newest: None,
            seen: [0; WORDS],
            head: 0,
            known: 0,
        }
    }

    /// Takes note of a packet; `interval_ns` is the time between packets.
    pub fn observe(&mut self, sequence: Option<u32>, time_ns: u64, interval_ns: i64) -> Observed {
        let Some(newest) = self.newest else {
            self.restart(sequence, time_ns);
            return Observed {
                arrival: Arrival::First,
                clock_step: false,
                fills: false,
                elapsed_ns: interval_ns,
            };
        };
        // Times lie in 1970..2156: their difference fits.
        let dt = time_ns
            .cast_signed()
            .wrapping_sub(newest.time_ns.cast_signed());
        let steps = match (sequence, newest.sequence) {
            (Some(now), Some(before)) => now.wrapping_sub(before).cast_signed(),
            _ => 0,
        };
        // A number that stands still while time passes says nothing.
        let observed = match steps {
            0 => self.by_time(dt, interval_ns),
            1.. => self.ahead(steps.unsigned_abs(), dt, interval_ns),
            _ => self.behind(steps.unsigned_abs(), dt, interval_ns),
        };
        match observed.arrival {
            Arrival::Restart => self.restart(sequence, time_ns),
            Arrival::Late | Arrival::Duplicate => {}
            _ => self.newest = Some(Newest { sequence, time_ns }),
        }
        observed
    }

    fn restart(&mut self, sequence: Option<u32>, time_ns: u64) {
        self.newest = Some(Newest { sequence, time_ns });
        self.seen = [0; WORDS];
        self.known = 1;
        self.mark(0);
    }

    /// `steps` numbers after the newest.
    fn ahead(&mut self, steps: u32, dt: i64, interval_ns: i64) -> Observed {
        let expected = i64::from(steps).saturating_mul(interval_ns);
        if steps > WINDOW && dt < expected / 2 {
            return Observed::restart(interval_ns);
        }
        self.shift(steps);
        // Intervals jitter and the motor drifts: allow two packets, and 2 % over long gaps.
        let tolerance = 2 * interval_ns + expected / 50;
        let clock_step = dt < 0 || (dt - expected).abs() > tolerance;
        Observed {
            arrival: if steps == 1 {
                Arrival::Next
            } else {
                Arrival::Gap(steps - 1)
            },
            clock_step,
            fills: false,
            elapsed_ns: if clock_step { expected } else { dt },
        }
    }

    /// `back` numbers before the newest.
    fn behind(&mut self, back: u32, dt: i64, interval_ns: i64) -> Observed {
        let expected = -i64::from(back).saturating_mul(interval_ns);
        if back >= WINDOW {
            return Observed::restart(interval_ns);
        }
        let tolerance = 2 * interval_ns - expected / 50;
        let clock_step = (dt - expected).abs() > tolerance;
        let inside = back < self.known;
        let seen = inside && self.is_seen(back);
        if clock_step && (seen || !inside) {
            // Other times under numbers seen before: the sensor counts anew.
            return Observed::restart(interval_ns);
        }
        if inside {
            self.mark(back);
        }
        Observed {
            arrival: if seen {
                Arrival::Duplicate
            } else {
                Arrival::Late
            },
            clock_step: false,
            fills: inside && !seen,
            elapsed_ns: if clock_step { expected } else { dt },
        }
    }

    /// Without numbers that tell.
    fn by_time(&mut self, dt: i64, interval_ns: i64) -> Observed {
        let plain = |arrival, clock_step| Observed {
            arrival,
            clock_step,
            fills: false,
            elapsed_ns: if clock_step { interval_ns } else { dt },
        };
        if dt == 0 {
            return plain(Arrival::Duplicate, false);
        }
        if dt < 0 {
            let late = dt > -LATE_MAX * interval_ns;
            return if late {
                plain(Arrival::Late, false)
            } else {
                plain(Arrival::Next, true)
            };
        }
        self.shift(1);
        if dt <= 2 * interval_ns {
            plain(Arrival::Next, false)
        } else if dt <= HOLE_MAX_NS {
            plain(Arrival::Hole, false)
        } else {
            plain(Arrival::Next, true)
        }
    }

    fn bit(&self, back: u32) -> (usize, u64) {
        let at = self.head.wrapping_sub(back as usize) % (WINDOW as usize);
        (at / 64, 1 << (at % 64))
    }

    fn is_seen(&self, back: u32) -> bool {
        let (word, bit) = self.bit(back);
        self.seen[word] & bit != 0
    }

    fn mark(&mut self, back: u32) {
        let (word, bit) = self.bit(back);
        self.seen[word] |= bit;
    }

    /// The newest is now `steps` later, and seen.
    fn shift(&mut self, steps: u32) {
        if steps >= WINDOW {
            self.seen = [0; WORDS];
        }
        // Bits of a turn of the ring ago.
        for _ in 0..steps.min(WINDOW) {
            self.head = self.head.wrapping_add(1);
            let (word, bit) = self.bit(0);
            self.seen[word] &= !bit;
        }
        self.mark(0);
        self.known = self.known.saturating_add(steps).min(WINDOW);
    }
}

impl Observed {
    const fn restart(interval_ns: i64) -> Self {
        Self {
            arrival: Arrival::Restart,
            clock_step: true,
            fills: false,
            elapsed_ns: interval_ns,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const INTERVAL: i64 = 333_333;

    fn at(n: u64) -> u64 {
        1_500_000_000_000_000_000 + n * 333_333
    }

    fn feed(numbers: &[u32]) -> Vec<Arrival> {
        let mut stream = Stream::new();
        let first = numbers[0];
        let time = |n: u32| {
            let steps = i64::from(n.wrapping_sub(first).cast_signed());
            at(1_000).wrapping_add_signed(steps * INTERVAL)
        };
        numbers
            .iter()
            .map(|&n| stream.observe(Some(n), time(n), INTERVAL).arrival)
            .collect()
    }

    #[test]
    fn a_swap_is_one_gap_filled_late_even_across_the_wrap() {
        use Arrival::{Duplicate, First, Gap, Late, Next};
        let base = u32::MAX - 2;
        let numbers = [0, 1, 4, 2, 3, 3, 4, 5].map(|n: u32| base.wrapping_add(n));
        assert_eq!(
            feed(&numbers),
            [First, Next, Gap(2), Late, Late, Duplicate, Duplicate, Next]
        );
    }

    #[test]
    fn what_came_before_the_first_packet_is_late_and_fills_nothing() {
        let mut stream = Stream::new();
        stream.observe(Some(10), at(10), INTERVAL);
        let observed = stream.observe(Some(9), at(9), INTERVAL);
        assert_eq!((observed.arrival, observed.fills), (Arrival::Late, false));
    }

    #[test]
    fn long_loss_is_counted_and_a_jump_in_no_time_is_a_restart() {
        let mut stream = Stream::new();
        stream.observe(Some(0), at(0), INTERVAL);
        let long = stream.observe(Some(30_001), at(30_001), INTERVAL);
        assert_eq!(
            (long.arrival, long.clock_step),
            (Arrival::Gap(30_000), false)
        );
        let jump = stream.observe(Some(1 << 30), at(30_002), INTERVAL);
        assert_eq!((jump.arrival, jump.clock_step), (Arrival::Restart, true));
        let back = stream.observe(Some(30_003), at(30_003), INTERVAL);
        assert_eq!(back.arrival, Arrival::Restart);
    }

    #[test]
    fn the_clock_steps_when_time_disagrees_with_the_numbers() {
        let step = |t: u64, number: u32| {
            let mut stream = Stream::new();
            stream.observe(Some(0), at(10), INTERVAL);
            stream.observe(Some(number), t, INTERVAL).clock_step
        };
        assert!(!step(at(11) + 600_000, 1), "jitter below two intervals");
        assert!(step(at(14), 1));
        assert!(step(at(9), 1), "backwards");
        assert!(!step(at(14), 4), "explained by the gap");
        assert!(step(at(10) + 37_000_000_000, 1), "UTC to TAI");
    }

    #[test]
    fn without_numbers_time_alone_decides() {
        use Arrival::{Duplicate, First, Hole, Late, Next};
        let mut stream = Stream::new();
        let times = [
            at(10),
            at(11),
            at(11),
            at(20),
            at(19),
            at(21),
            at(40_000),
            at(3),
        ];
        let observed = times.map(|t| stream.observe(None, t, INTERVAL));
        assert_eq!(
            observed.map(|o| o.arrival),
            [First, Next, Duplicate, Hole, Late, Next, Next, Next]
        );
        assert_eq!(
            observed.map(|o| o.clock_step),
            [false, false, false, false, false, false, true, true]
        );
    }

    #[test]
    fn the_window_remembers_across_its_words() {
        let mut stream = Stream::new();
        let mut check = |n: u32| stream.observe(Some(n), at(u64::from(n)), INTERVAL);
        check(0);
        for n in 1..1_000 {
            if n % 7 != 0 {
                check(n);
            }
        }
        for n in 1..999 {
            let observed = check(n);
            assert_eq!(observed.fills, n % 7 == 0, "{n}");
            assert_eq!(observed.arrival == Arrival::Duplicate, n % 7 != 0, "{n}");
        }
    }
}

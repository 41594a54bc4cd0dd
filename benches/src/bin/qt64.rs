//! PandarQT64 packets to x, y, z, intensity, ring and time, one thread: Noctule's decoder against
//! a plain per-point implementation of the vendor's formula, interleaved, into the same consumer.
//!
//! `cargo run --release -p noctule-benches --bin qt64`; with `NOCTULE_DATA` set, the packets are
//! those of `hesai/qt64.pcap` there, else they are generated.
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::print_stdout,
    reason = "table indices in range, and figures to print"
)]

use std::error::Error;
use std::fs::File;
use std::hint::black_box;
use std::io::BufReader;
use std::path::PathBuf;
use std::time::Instant;

use noctule_hesai::pcap::Reader;
use noctule_hesai::{
    Block, Correction, Decoder, FireTimes, Model, Options, Qt64Echoes, Qt64Encoder, ReturnMode,
    ReturnSink, Returns,
};
use noctule_sensor::{Return, Stamp};

const ROUNDS: usize = 401;
/// Times the packets are decoded per round: some milliseconds, less than a scheduler's slice, so
/// that the median round is one that nobody interrupted.
const LAPS: usize = 8;
/// One turn of the head: as in a driver, packets are still in the cache when they are decoded.
const PACKETS: usize = 300;

fn main() -> Result<(), Box<dyn Error>> {
    let mut packets = packets()?;
    packets.truncate(PACKETS);
    let fresh = Decoder::new(Options {
        returns: Returns::All,
        ..Options::new(Model::Qt64)
    })?;
    let plain = Plain::new();
    let mut cloud = Vec::new();
    let mut seconds: [Vec<f64>; 4] = Default::default();
    let mut folds = [Fold::default(); 4];
    for _ in 0..ROUNDS {
        let contestants: [&mut dyn FnMut() -> Fold; 4] = [
            &mut || ours::<Fold>(&fresh, &packets),
            &mut || ours::<OneByOne>(&fresh, &packets).0,
            &mut || plain.fold(&packets),
            &mut || plain.through_a_cloud(&packets, &mut cloud),
        ];
        for ((run, seconds), fold) in contestants.into_iter().zip(&mut seconds).zip(&mut folds) {
            let start = Instant::now();
            *fold = black_box(run());
            seconds.push(start.elapsed().as_secs_f64());
        }
    }
    folds.iter().try_for_each(|other| folds[0].compare(other))?;
    report(&packets, &folds[0], seconds)
}

/// What all contestants hand their returns to.
#[derive(Debug, Clone, Copy, Default)]
struct Fold {
    n: u64,
    xyz: [f64; 3],
    intensity: u64,
    ring: u64,
    t: u64,
}

impl Fold {
    #[inline]
    fn take(&mut self, xyz: [f32; 3], intensity: u8, ring: u8, t_ns: u64) {
        self.n += 1;
        for (sum, value) in self.xyz.iter_mut().zip(xyz) {
            *sum += f64::from(value);
        }
        self.intensity += u64::from(intensity);
        self.ring += u64::from(ring);
        self.t = self.t.wrapping_add(t_ns);
    }

    /// Integers alike; coordinates within what a table of hundredths of a degree loses.
    fn compare(&self, other: &Self) -> Result<(), String> {
        let integers = |f: &Self| (f.n, f.intensity, f.ring, f.t);
        if integers(self) != integers(other) {
            return Err(format!("results differ: {self:?} and {other:?}"));
        }
        let mean = |sum: f64| sum / self.n as f64;
        for (a, b) in self.xyz.into_iter().zip(other.xyz) {
            if (mean(a) - mean(b)).abs() > 1e-3 {
                return Err(format!(
                    "mean coordinates differ: {} and {} m",
                    mean(a),
                    mean(b)
                ));
            }
        }
        Ok(())
    }
}

impl ReturnSink for Fold {
    #[inline]
    fn on_return(&mut self, r: Return, _sweep: u32) {
        self.take(
            [r.x_m, r.y_m, r.z_m],
            r.intensity,
            r.channel,
            r.t.as_nanos(),
        );
    }

    #[inline(always)]
    fn on_firing<const R: usize>(&mut self, blocks: &[Block<'_>; R]) {
        for block in blocks {
            let (mut n, mut intensity, mut ring) = (0, 0, 0);
            for (&echo, c) in block.echo.iter().zip(0u32..) {
                n += u32::from(echo != 0);
                intensity += echo >> 16;
                ring += if echo != 0 { c } else { 0 };
            }
            self.n += u64::from(n);
            self.intensity += u64::from(intensity);
            self.ring += u64::from(ring);
            // The sum of the returns' times, whose common part is the block's.
            let mut fire = 0;
            for (&echo, &fire_ns) in block.echo.iter().zip(block.fire_ns) {
                fire += if echo != 0 { fire_ns } else { 0 };
            }
            let t = block.t.as_nanos().wrapping_mul(u64::from(n));
            self.t = self.t.wrapping_add(t.wrapping_add_signed(i64::from(fire)));
            let xyz = [block.x_m, block.y_m, block.z_m];
            for (sum, values) in self.xyz.iter_mut().zip(xyz) {
                *sum += f64::from(sum_f32(values));
            }
        }
    }
}

/// Sum in eight lanes, as vector registers add, then across them by halves.
#[inline(always)]
fn sum_f32(values: &[f32]) -> f32 {
    let mut l = [0.0f32; 8];
    for some in values.as_chunks::<8>().0 {
        for (lane, value) in l.iter_mut().zip(some) {
            *lane += value;
        }
    }
    ((l[0] + l[4]) + (l[2] + l[6])) + ((l[1] + l[5]) + (l[3] + l[7]))
}

/// The same consumer, which gets its returns one by one.
#[derive(Default)]
struct OneByOne(Fold);

impl ReturnSink for OneByOne {
    #[inline]
    fn on_return(&mut self, r: Return, sweep: u32) {
        self.0.on_return(r, sweep);
    }
}

fn ours<S: ReturnSink + Default>(fresh: &Decoder, packets: &[Vec<u8>]) -> S {
    let mut fold = S::default();
    for _ in 0..LAPS {
        let mut decoder = fresh.clone();
        for packet in packets {
            decoder
                .decode(packet, &mut fold)
                .expect("packets are valid");
        }
    }
    fold
}

/// The vendor's way: sines and cosines of every hundredth of a degree, looked up per point.
struct Plain {
    sin: Vec<f32>,
    cos: Vec<f32>,
    /// Hundredths of a degree, `0..36_000`.
    elevation: [usize; 64],
    azimuth: [usize; 64],
    fire_ns: [u64; 64],
}

#[derive(Clone, Copy)]
struct Point {
    xyz: [f32; 3],
    intensity: u8,
    ring: u8,
    t_ns: u64,
}

impl Plain {
    fn new() -> Self {
        let radians = (0..36_000).map(|cdeg| (f64::from(cdeg) / 100.0).to_radians());
        let correction = Correction::nominal(Model::Qt64);
        let fire = FireTimes::nominal(Model::Qt64);
        let cdeg = |deg: f64| ((deg * 100.0).round() as i32).rem_euclid(36_000) as usize;
        let laser = |c: usize| correction.lasers()[c];
        Self {
            sin: radians.clone().map(|a| a.sin() as f32).collect(),
            cos: radians.map(|a| a.cos() as f32).collect(),
            elevation: std::array::from_fn(|c| cdeg(laser(c).elevation_deg)),
            azimuth: std::array::from_fn(|c| cdeg(laser(c).azimuth_deg)),
            fire_ns: std::array::from_fn(|c| fire.channel_ns()[c] as u64),
        }
    }

    #[inline]
    fn decode(&self, packet: &[u8], mut each: impl FnMut(Point)) {
        let u16_at = |at: usize| u16::from_le_bytes([packet[at], packet[at + 1]]);
        let info = noctule_hesai::Packet::new(Model::Qt64, packet).expect("packets are valid");
        let returns = info.return_mode().returns();
        for b in 0..4 {
            let start = 12 + b * 258;
            let block_azimuth = usize::from(u16_at(start));
            let block_ns = info.time_ns() + 35_710 + 166_666 * (b / returns) as u64;
            for c in 0..64 {
                let at = start + 2 + c * 4;
                let raw = u16_at(at);
                if raw == 0 {
                    continue;
                }
                let distance = f32::from(raw) * 0.004;
                let azimuth = (block_azimuth + self.azimuth[c]) % 36_000;
                let flat = distance * self.cos[self.elevation[c]];
                let xyz = [
                    flat * self.sin[azimuth],
                    flat * self.cos[azimuth],
                    distance * self.sin[self.elevation[c]],
                ];
                let (intensity, ring) = (packet[at + 2], c as u8);
                each(Point {
                    xyz,
                    intensity,
                    ring,
                    t_ns: block_ns + self.fire_ns[c],
                });
            }
        }
    }

    fn fold(&self, packets: &[Vec<u8>]) -> Fold {
        let mut fold = Fold::default();
        for _ in 0..LAPS {
            for packet in packets {
                self.decode(packet, |p| fold.take(p.xyz, p.intensity, p.ring, p.t_ns));
            }
        }
        fold
    }

    /// As drivers do: a cloud of points first, which the consumer then reads.
    fn through_a_cloud(&self, packets: &[Vec<u8>], cloud: &mut Vec<Point>) -> Fold {
        let mut fold = Fold::default();
        for _ in 0..LAPS {
            cloud.clear();
            for packet in packets {
                self.decode(packet, |p| cloud.push(p));
            }
            for p in cloud.iter() {
                fold.take(p.xyz, p.intensity, p.ring, p.t_ns);
            }
        }
        fold
    }
}

fn packets() -> Result<Vec<Vec<u8>>, Box<dyn Error>> {
    let Some(data) = std::env::var_os("NOCTULE_DATA") else {
        return generated();
    };
    let file = File::open(PathBuf::from(data).join("hesai/qt64.pcap"))?;
    let mut reader = Reader::new(BufReader::new(file))?;
    let mut packets = Vec::new();
    while let Some(datagram) = reader.next_datagram()? {
        packets.push(datagram.payload.to_vec());
    }
    Ok(packets)
}

/// Three turns in a room, every 30th laser unanswered.
fn generated() -> Result<Vec<Vec<u8>>, Box<dyn Error>> {
    let mut encoder = Qt64Encoder::new(ReturnMode::FirstLast, 600, 0)?;
    let firing = |n: u16| {
        let mut echoes = Qt64Echoes::NONE;
        for c in (0..64u8).filter(|c| !(u16::from(*c) + n).is_multiple_of(30)) {
            echoes.set(usize::from(c), 2.0 + f32::from(n % 300) * 0.02, c);
        }
        (n % 600 * 60, [echoes; 2])
    };
    let packet = |n: u16| {
        let t = Stamp::from_nanos(1_700_000_000_000_000_000 + u64::from(n) * 333_332);
        Ok(encoder
            .dual(t, &[firing(2 * n), firing(2 * n + 1)])?
            .to_vec())
    };
    (0..900).map(packet).collect()
}

fn report(packets: &[Vec<u8>], fold: &Fold, seconds: [Vec<f64>; 4]) -> Result<(), Box<dyn Error>> {
    let names = [
        "noctule, by firing",
        "noctule, one by one",
        "plain, folding",
        "plain, through a cloud",
    ];
    println!(
        "{} packets, {} returns a round, {ROUNDS} rounds; M returns/s",
        packets.len(),
        fold.n
    );
    println!(
        "{:24} {:>8} {:>8}   noctule by firing is faster by, median round",
        "", "median", "best"
    );
    let ours = seconds[0].clone();
    for (name, theirs) in names.iter().zip(seconds) {
        let ratios = theirs.iter().zip(&ours).map(|(theirs, ours)| theirs / ours);
        let ratio = median(ratios.collect());
        let rate = |seconds: f64| fold.n as f64 / seconds / 1e6;
        let best = theirs.iter().copied().fold(f64::INFINITY, f64::min);
        let (best, median) = (rate(best), rate(median(theirs)));
        println!("{name:24} {median:8.1} {best:8.1}   {ratio:5.2} x");
    }
    Ok(())
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

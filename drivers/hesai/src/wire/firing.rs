//! The arithmetic of one firing: all channels, all echoes, in lanes the compiler vectorises.

use noctule_sensor::Stamp;
use pulp::{Arch, Simd, WithSimd};

use super::geometry::{Circle, Geometry, MAX_CHANNELS};
use super::sweep::{Sweeps, TURN};
use super::{Block, Model, Options, Packet, ReturnSink, Returns};

/// One firing of all lasers, in a packet that has been checked.
#[derive(Clone, Copy)]
pub(crate) struct Job<'a, 'b> {
    pub packet: &'a Packet<'b>,
    /// Its first block.
    pub block: usize,
    /// Start of the block, nanoseconds since 1970 on the LiDAR's clock.
    pub t_ns: u64,
    /// Unwound angle of the block, hundredths of a degree.
    pub angle: i64,
    pub geometry: &'a Geometry,
    pub circle: &'a Circle,
    pub sweeps: &'a Sweeps,
    pub options: &'a Options,
    /// Instructions this machine has: the same code is compiled for each set.
    pub arch: Arch,
}

/// Most blocks that share a firing.
const MAX_ECHOES: usize = 3;

/// Where one firing's numbers are worked out.
#[derive(Debug, Clone)]
pub(crate) struct Scratch {
    echo: [[u32; MAX_CHANNELS]; MAX_ECHOES],
    lanes: [Lanes; MAX_ECHOES],
    /// Where the channels look, level: x and y of unit vectors.
    look: [[f32; MAX_CHANNELS]; 2],
}

/// Coordinates of one block's channels, metres.
#[derive(Debug, Clone)]
struct Lanes {
    x: [f32; MAX_CHANNELS],
    y: [f32; MAX_CHANNELS],
    z: [f32; MAX_CHANNELS],
}

impl Scratch {
    pub const fn new() -> Self {
        const NONE: [f32; MAX_CHANNELS] = [0.0; MAX_CHANNELS];
        const LANES: Lanes = Lanes {
            x: NONE,
            y: NONE,
            z: NONE,
        };
        Self {
            echo: [[0; MAX_CHANNELS]; MAX_ECHOES],
            lanes: [LANES; MAX_ECHOES],
            look: [NONE; 2],
        }
    }
}

/// Distance and intensity of one channel as on the wire: 16 and 8 bits; distance 0 is no return.
const DISTANCE: u32 = 0xffff;
const ECHO: u32 = 0xff_ffff;

impl Job<'_, '_> {
    /// Hands the firing to `sink`; gives the number of its returns, and that of unique ones.
    pub fn run<S: ReturnSink>(&self, scratch: &mut Scratch, sink: &mut S) -> (u32, u32) {
        match (self.packet.model(), self.packet.stride()) {
            (Model::Qt64, _) => self.echoes::<64, 4, S>(scratch, sink),
            (Model::Qt128, 3) => self.echoes::<128, 3, S>(scratch, sink),
            (Model::Qt128, _) => self.echoes::<128, 4, S>(scratch, sink),
            (Model::Xt32m, _) if self.packet.return_mode().returns() == 3 => {
                self.blocks::<32, 4, 3, S>(scratch, sink)
            }
            (Model::Xt32 | Model::Xt32m, _) => self.echoes::<32, 4, S>(scratch, sink),
            (Model::Xt16, _) => self.echoes::<16, 4, S>(scratch, sink),
            (Model::Pandar64, _) => self.echoes::<64, 3, S>(scratch, sink),
            (Model::Pandar40p, _) => self.echoes::<40, 3, S>(scratch, sink),
        }
    }

    fn echoes<const C: usize, const STRIDE: usize, S: ReturnSink>(
        &self,
        scratch: &mut Scratch,
        sink: &mut S,
    ) -> (u32, u32) {
        match self.packet.return_mode().returns() {
            1 => self.blocks::<C, STRIDE, 1, S>(scratch, sink),
            _ => self.blocks::<C, STRIDE, 2, S>(scratch, sink),
        }
    }

    fn blocks<const C: usize, const STRIDE: usize, const R: usize, S: ReturnSink>(
        &self,
        scratch: &mut Scratch,
        sink: &mut S,
    ) -> (u32, u32) {
        let job = self;
        self.arch
            .dispatch(Blocks::<C, STRIDE, R, S> { job, scratch, sink })
    }
}

/// `C` channels of `STRIDE` bytes in `R` blocks: one [`Job`], compiled for its sizes.
struct Blocks<'a, 'b, 'c, const C: usize, const STRIDE: usize, const R: usize, S> {
    job: &'a Job<'b, 'c>,
    scratch: &'a mut Scratch,
    sink: &'a mut S,
}

impl<const C: usize, const STRIDE: usize, const R: usize, S: ReturnSink> WithSimd
    for Blocks<'_, '_, '_, C, STRIDE, R, S>
{
    type Output = (u32, u32);

    #[inline(always)]
    fn with_simd<V: Simd>(self, _: V) -> (u32, u32) {
        let Self { job, scratch, sink } = self;
        let Scratch { echo, lanes, look } = scratch;
        let echo = echo
            .first_chunk_mut::<R>()
            .expect("a firing has at most three echoes");
        let mut echoes = echo.each_mut().map(lanes_of::<_, C>);
        let mut found = 0;
        for (r, echoes) in echoes.iter_mut().enumerate() {
            found += read::<C, STRIDE>(job.packet, job.block + r, echoes);
        }
        let repeated = repeated(&echoes);
        if job.options.returns == Returns::Unique && repeated > 0 {
            drop_repeated(&mut echoes);
        }
        let mut azimuth_cdeg = None;
        for (r, lanes) in lanes.iter_mut().take(R).enumerate() {
            // Echoes share their firing's azimuth; in a damaged packet they need not.
            let own_cdeg = job.packet.azimuth_cdeg(job.block + r);
            if azimuth_cdeg != Some(own_cdeg) {
                azimuth_cdeg = Some(own_cdeg);
                turn::<C>(look, job.circle.sin_cos(own_cdeg), job.geometry);
            }
            lanes.place(echoes[r], look, &job.geometry.up, job.packet.unit_mm());
            if let Some(centre) = job.options.optical_centre_m {
                recentre::<C>(lanes, centre);
            }
        }
        let (low, high) = job.geometry.seam.sweeps(job.angle);
        let seam = low != high;
        let mut blocks = [job.view(0, echoes[0], &lanes[0], low, seam); R];
        for r in 1..R {
            blocks[r] = job.view(r, echoes[r], &lanes[r], low, seam);
        }
        sink.on_firing::<R>(&blocks);
        (found, found - repeated)
    }
}

/// The `C` lanes in use.
#[inline(always)]
fn lanes_of<T, const C: usize>(all: &mut [T; MAX_CHANNELS]) -> &mut [T; C] {
    all.first_chunk_mut().expect("no model has more channels")
}

impl Job<'_, '_> {
    #[inline(always)]
    fn view<'c, const C: usize>(
        &'c self,
        r: usize,
        echo: &'c [u32; C],
        lanes: &'c Lanes,
        low: i64,
        seam: bool,
    ) -> Block<'c> {
        let Geometry {
            zero, cut, fire_ns, ..
        } = self.geometry;
        // Offsets are half a turn at most: less than three turns from the sweep's start.
        let past = i32::try_from(self.angle - low * TURN).unwrap_or(0);
        Block {
            x_m: &lanes.x[..C],
            y_m: &lanes.y[..C],
            z_m: &lanes.z[..C],
            echo,
            fire_ns: &fire_ns[..C],
            t: Stamp::from_nanos(self.t_ns),
            azimuth_cdeg: self.packet.azimuth_cdeg(self.block + r),
            block: u8::try_from(self.block + r).unwrap_or(u8::MAX),
            zero: &zero[..C],
            cut: &cut[..C],
            sweep: (self.sweeps.number(low), past),
            seam,
        }
    }
}

/// Turns all channels to a block's azimuth.
#[inline(always)]
fn turn<const C: usize>(
    look: &mut [[f32; MAX_CHANNELS]; 2],
    (sin, cos): (f32, f32),
    geometry: &Geometry,
) {
    let Geometry { ahead, aside, .. } = geometry;
    let [x, y] = look;
    for c in 0..C {
        x[c] = ahead[c] * sin + aside[c] * cos;
        y[c] = ahead[c] * cos - aside[c] * sin;
    }
}

impl Lanes {
    #[inline(always)]
    fn place<const C: usize>(
        &mut self,
        echoes: &[u32; C],
        look: &[[f32; MAX_CHANNELS]; 2],
        up: &[f32; MAX_CHANNELS],
        unit_mm: u8,
    ) {
        let unit_m = f32::from(unit_mm) * 1e-3;
        let [x, y] = look;
        for c in 0..C {
            let bytes = echoes[c].to_le_bytes();
            let d = f32::from(u16::from_le_bytes([bytes[0], bytes[1]])) * unit_m;
            self.x[c] = d * x[c];
            self.y[c] = d * y[c];
            self.z[c] = d * up[c];
        }
    }
}

/// Distance and intensity of all channels of a block, 0 where the distance is; gives how many are
/// returns.
#[inline(always)]
fn read<const C: usize, const STRIDE: usize>(
    packet: &Packet<'_>,
    block: usize,
    echoes: &mut [u32; C],
) -> u32 {
    let (units, _) = packet.channels(block).as_chunks::<STRIDE>();
    let units = units
        .first_chunk::<C>()
        .expect("a checked packet has all its channels");
    let mut found = 0;
    for c in 0..C {
        let unit = &units[c];
        let word = match unit.first_chunk::<4>() {
            // The fourth byte is no part of the echo.
            Some(word) => u32::from_le_bytes(*word) & ECHO,
            None => u32::from_le_bytes([unit[0], unit[1], unit[2], 0]),
        };
        let is_return = word & DISTANCE != 0;
        echoes[c] = if is_return { word } else { 0 };
        found += u32::from(is_return);
    }
    found
}

/// Returns that a later block of the firing repeats.
#[inline(always)]
fn repeated<const C: usize, const R: usize>(echoes: &[&mut [u32; C]; R]) -> u32 {
    let mut repeated = 0;
    for r in 0..R {
        for (c, &echo) in echoes[r].iter().enumerate() {
            let mut again = false;
            for later in &echoes[r + 1..] {
                again |= echo == later[c];
            }
            repeated += u32::from(again & (echo != 0));
        }
    }
    repeated
}

/// Leaves of equal returns the last.
#[inline(always)]
fn drop_repeated<const C: usize, const R: usize>(echoes: &mut [&mut [u32; C]; R]) {
    for r in 0..R {
        let (earlier, later) = echoes.split_at_mut(r + 1);
        for later in later {
            for (echo, again) in earlier[r].iter_mut().zip(later.iter()) {
                *echo = if echo == again { 0 } else { *echo };
            }
        }
    }
}

/// Moves points onto beams that start at `centre`, keeping their distance from the origin.
///
/// With u the direction and d the distance: p = s u + o, |p| = d, so that
/// s = sqrt((u.o)^2 - |o|^2 + d^2) - u.o. Nearer than the centre itself, points stay.
#[inline(always)]
fn recentre<const C: usize>(lanes: &mut Lanes, centre: [f32; 3]) {
    let [ox, oy, oz] = centre;
    for c in 0..C {
        let (x, y, z) = (lanes.x[c], lanes.y[c], lanes.z[c]);
        let d = (x * x + y * y + z * z).sqrt();
        let (ux, uy, uz) = (x / d, y / d, z / d);
        let along = ux * ox + uy * oy + uz * oz;
        let square = along * along - (ox * ox + oy * oy + oz * oz) + d * d;
        let s = square.sqrt() - along;
        if s > 0.0 {
            lanes.x[c] = s * ux + ox;
            lanes.y[c] = s * uy + oy;
            lanes.z[c] = s * uz + oz;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_echoes_keep_the_last_block() {
        let mut echoes = [[5, 6, 0, 7], [5, 9, 0, 0], [5, 6, 0, 7]];
        assert_eq!(repeated(&echoes.each_mut()), 4);
        drop_repeated(&mut echoes.each_mut());
        assert_eq!(echoes, [[0, 0, 0, 0], [0, 9, 0, 0], [5, 6, 0, 7]]);
        assert_eq!(repeated(&[&mut [5, 0x01_0005]]), 0);
    }

    #[test]
    fn recentred_points_keep_their_distance_and_lie_on_the_beam() {
        let centre = Options::QT64_CENTRE_M;
        let [mut lanes, ..] = Scratch::new().lanes;
        (lanes.x[0], lanes.y[0], lanes.z[0], lanes.x[2]) = (3.0, 4.0, 1.0, 0.01);
        recentre::<3>(&mut lanes, centre);
        let d = (lanes.x[0].powi(2) + lanes.y[0].powi(2) + lanes.z[0].powi(2)).sqrt();
        assert!((d - 26f32.sqrt()).abs() < 1e-6);
        let beam = [
            lanes.x[0] - centre[0],
            lanes.y[0] - centre[1],
            lanes.z[0] - centre[2],
        ];
        assert!((beam[0] / beam[2] - 3.0).abs() < 1e-5 && (beam[1] / beam[2] - 4.0).abs() < 1e-5);
        // No return, and one inside the optics: left alone, and no NaN.
        assert_eq!((lanes.x[1], lanes.y[1], lanes.z[1]), (0.0, 0.0, 0.0));
        assert_eq!((lanes.x[2], lanes.y[2]), (0.01, 0.0));
    }
}

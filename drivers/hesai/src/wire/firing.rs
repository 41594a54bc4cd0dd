//! The arithmetic of one firing: all channels, all echoes, in lanes the compiler vectorises.

use noctule_sensor::{Return, Stamp};

use super::decoder::{Options, ReturnSink, Returns};
use super::geometry::{self, Geometry};
use super::sweep::{Sweeps, TURN};
use super::{Model, Packet};

/// One firing of all lasers, in a packet that has been checked.
#[derive(Clone, Copy)]
pub(crate) struct Firing<'a, 'b> {
    pub packet: &'a Packet<'b>,
    /// Its first block.
    pub block: usize,
    /// Start of the block, nanoseconds since 1970 on the LiDAR's clock.
    pub t_ns: u64,
    /// Unwound angle of the block, hundredths of a degree.
    pub angle: i64,
}

/// Distance and intensity of one channel as on the wire: 16 and 8 bits; distance 0 is no return.
const DISTANCE: u32 = 0xffff;
const ECHO: u32 = 0xff_ffff;

/// Hands the returns of one firing to `sink`; gives their number, and that of unique ones.
pub(crate) fn decode<S: ReturnSink>(
    firing: &Firing<'_, '_>,
    geometry: &Geometry,
    sweeps: &Sweeps,
    options: &Options,
    sink: &mut S,
) -> (u32, u32) {
    let packet = firing.packet;
    let job = Job {
        firing,
        geometry,
        sweeps,
        options,
    };
    match (packet.model(), packet.stride()) {
        (Model::Qt64, _) => job.echoes::<64, 4, S>(sink),
        (Model::Qt128, 3) => job.echoes::<128, 3, S>(sink),
        (Model::Qt128, _) => job.echoes::<128, 4, S>(sink),
        (Model::Xt32 | Model::Xt32m, _) => job.echoes::<32, 4, S>(sink),
        (Model::Xt16, _) => job.echoes::<16, 4, S>(sink),
        (Model::Pandar64, _) => job.echoes::<64, 3, S>(sink),
        (Model::Pandar40p, _) => job.echoes::<40, 3, S>(sink),
    }
}

struct Job<'a, 'b, 'c> {
    firing: &'a Firing<'b, 'c>,
    geometry: &'a Geometry,
    sweeps: &'a Sweeps,
    options: &'a Options,
}

/// Coordinates of one block's channels, metres.
struct Lanes<const C: usize> {
    x: [f32; C],
    y: [f32; C],
    z: [f32; C],
}

impl Job<'_, '_, '_> {
    fn echoes<const C: usize, const STRIDE: usize, S: ReturnSink>(
        &self,
        sink: &mut S,
    ) -> (u32, u32) {
        match self.firing.packet.return_mode().returns() {
            1 => self.run::<C, STRIDE, 1, S>(sink),
            2 => self.run::<C, STRIDE, 2, S>(sink),
            _ => self.run::<C, STRIDE, 3, S>(sink),
        }
    }

    fn run<const C: usize, const STRIDE: usize, const R: usize, S: ReturnSink>(
        &self,
        sink: &mut S,
    ) -> (u32, u32) {
        let echoes: [[u32; C]; R] =
            core::array::from_fn(|r| read::<C, STRIDE>(self.firing.packet, self.firing.block + r));
        let unique = unique(&echoes);
        let lanes: [Lanes<C>; R] = core::array::from_fn(|r| self.place(&echoes[r], r));
        let found = echoes.iter().map(|block| count(block)).sum();
        let points = unique.iter().map(|block| count(block)).sum();
        let kept = match self.options.returns {
            Returns::All => &echoes,
            Returns::Unique => &unique,
        };
        let (low, high) = self.geometry.seam.sweeps(self.firing.angle);
        if low == high {
            let number = self.sweeps.number(low);
            self.emit(kept, &lanes, |_| number, sink);
        } else {
            let base = self.firing.angle - low * TURN;
            let sweep = |c: usize| {
                let turns = (base - i64::from(self.geometry.cut[c])).div_euclid(TURN);
                self.sweeps.number(low + turns)
            };
            self.emit(kept, &lanes, sweep, sink);
        }
        (found, points)
    }

    /// Coordinates of one block. A dual pair shares its azimuth; damaged ones need not.
    fn place<const C: usize>(&self, echoes: &[u32; C], r: usize) -> Lanes<C> {
        let azimuth = self.firing.packet.azimuth_cdeg(self.firing.block + r);
        let (sin, cos) = geometry::sin_cos_cdeg(azimuth);
        let unit_m = f32::from(self.firing.packet.unit_mm()) * 1e-3;
        let mut lanes = Lanes {
            x: [0.0; C],
            y: [0.0; C],
            z: [0.0; C],
        };
        let Geometry {
            ahead, aside, up, ..
        } = self.geometry;
        for c in 0..C {
            let bytes = echoes[c].to_le_bytes();
            let d = f32::from(u16::from_le_bytes([bytes[0], bytes[1]])) * unit_m;
            lanes.x[c] = d * (ahead[c] * sin + aside[c] * cos);
            lanes.y[c] = d * (ahead[c] * cos - aside[c] * sin);
            lanes.z[c] = d * up[c];
        }
        if let Some(centre) = self.options.optical_centre_m {
            recentre(&mut lanes, centre);
        }
        lanes
    }

    fn emit<const C: usize, const R: usize, S: ReturnSink>(
        &self,
        kept: &[[u32; C]; R],
        lanes: &[Lanes<C>; R],
        sweep: impl Fn(usize) -> u32,
        sink: &mut S,
    ) {
        let azimuths: [u16; R] =
            core::array::from_fn(|r| self.firing.packet.azimuth_cdeg(self.firing.block + r));
        let first_block = u8::try_from(self.firing.block).unwrap_or(u8::MAX);
        for (c, channel) in (0..C).zip(0u8..) {
            for (r, block) in (0..R).zip(first_block..) {
                let [low, high, intensity, _] = kept[r][c].to_le_bytes();
                if low == 0 && high == 0 {
                    continue;
                }
                let fire_ns = i64::from(self.geometry.fire_ns[c]);
                let t = Stamp::from_nanos(self.firing.t_ns.wrapping_add_signed(fire_ns));
                let r = Return {
                    t,
                    x_m: lanes[r].x[c],
                    y_m: lanes[r].y[c],
                    z_m: lanes[r].z[c],
                    azimuth_cdeg: behind(azimuths[r], self.geometry.zero[c]),
                    channel,
                    intensity,
                    block,
                };
                sink.on_return(r, sweep(c));
            }
        }
    }
}

/// Distance and intensity of all channels of a block.
#[inline]
fn read<const C: usize, const STRIDE: usize>(packet: &Packet<'_>, block: usize) -> [u32; C] {
    let (units, _) = packet.channels(block).as_chunks::<STRIDE>();
    let units = units
        .first_chunk::<C>()
        .expect("a checked packet has all its channels");
    // The fourth byte is masked off; taking the last of `STRIDE` lets a whole word be loaded.
    units.map(|unit| u32::from_le_bytes([unit[0], unit[1], unit[2], unit[STRIDE - 1]]) & ECHO)
}

/// As `echoes`, without those that a later block repeats.
#[inline]
fn unique<const C: usize, const R: usize>(echoes: &[[u32; C]; R]) -> [[u32; C]; R] {
    let mut unique = *echoes;
    for r in 0..R {
        for later in r + 1..R {
            for c in 0..C {
                let same = echoes[r][c] == echoes[later][c];
                unique[r][c] = if same { 0 } else { unique[r][c] };
            }
        }
    }
    unique
}

#[inline]
fn count<const C: usize>(echoes: &[u32; C]) -> u32 {
    echoes
        .iter()
        .map(|&echo| u32::from(echo & DISTANCE != 0))
        .sum()
}

/// `azimuth` seen from `zero`, both in `0..36_000`.
#[inline]
fn behind(azimuth: u16, zero: u16) -> u16 {
    if azimuth >= zero {
        azimuth - zero
    } else {
        azimuth + (36_000 - zero)
    }
}

/// Moves points onto beams that start at `centre`, keeping their distance from the origin.
///
/// With u the direction and d the distance: p = s u + o, |p| = d, so that
/// s = sqrt((u.o)^2 - |o|^2 + d^2) - u.o. Nearer than the centre itself, points stay.
fn recentre<const C: usize>(lanes: &mut Lanes<C>, centre: [f32; 3]) {
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
        let echoes = [[5, 6, 0, 7], [5, 9, 0, 0], [5, 6, 0, 7]];
        assert_eq!(unique(&echoes), [[0, 0, 0, 0], [0, 9, 0, 0], [5, 6, 0, 7]]);
        assert_eq!(unique(&[[5, 0x01_0005]]), [[5, 0x01_0005]]);
        assert_eq!(
            count(&[0x01_0000, 1, 0xff_ffff, 0]),
            2,
            "intensity alone is no return"
        );
    }

    #[test]
    fn azimuths_wrap_both_ways() {
        assert_eq!(behind(10, 35_127), 883);
        assert_eq!(behind(10, 790), 35_220);
        assert_eq!(behind(35_999, 0), 35_999);
        assert_eq!(behind(790, 790), 0);
    }

    #[test]
    fn recentred_points_keep_their_distance_and_lie_on_the_beam() {
        let centre = Options::QT64_CENTRE_M;
        let mut lanes = Lanes {
            x: [3.0, 0.0, 0.01],
            y: [4.0, 0.0, 0.0],
            z: [1.0, 0.0, 0.0],
        };
        recentre(&mut lanes, centre);
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

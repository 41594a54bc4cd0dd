//! How sensors differ from those of the example: drawn once per cut, each from its own chance.

use noctule_depth::Ground;

use crate::chance::Chance;
use crate::settings::Augment;

/// Rows of an example that count as one ring of its LiDAR: rings of the world lie 1.45 degrees, that
/// is 6.6 pixels apart near the horizon, those of KITTI 5.3.
const RING_ROWS: f64 = 6.0;
/// Returns are never nearer than this, metres.
const RANGE_M_MIN: f32 = 0.1;

/// What chance is taken for.
#[derive(Clone, Copy)]
pub(super) enum Purpose {
    Zoom = 1,
    Threshold,
    Lag,
    Dead,
    RingDrop,
    RingStride,
    RangeNoise,
    ReadNoise,
    Bits,
    Ground,
    Movers,
}

/// Strengths of the changes to sensors; all neutral by default.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Vary {
    /// Starts every chance.
    pub key: u64,
    /// Factor on the event threshold, 1 or more.
    pub threshold: f64,
    /// Time constant of an event pixel at white, microseconds.
    pub lag_us: f64,
    /// Time an event pixel rests after an event, microseconds.
    pub dead_us: f64,
    /// Share of rings lost.
    pub ring_drop: f64,
    /// One ring of so many is kept.
    pub ring_stride: usize,
    /// Standard deviation of ranges, metres.
    pub range_noise_m: f64,
    /// Standard deviation of the picture's light, white 1.
    pub read_noise: f64,
    /// Bits of the picture's codes.
    pub bits: u32,
    /// Rows by which the horizon is told too low; `None` where nothing is told of the ground.
    pub horizon_shift: Option<f64>,
}

impl Vary {
    /// Changes nothing.
    pub(super) const NONE: Self = Self {
        key: 0,
        threshold: 1.0,
        lag_us: 0.0,
        dead_us: 0.0,
        ring_drop: 0.0,
        ring_stride: 1,
        range_noise_m: 0.0,
        read_noise: 0.0,
        bits: 8,
        horizon_shift: Some(0.0),
    };

    /// Draws strengths up to those of the settings; no draw depends on another setting.
    pub(super) fn random(augment: &Augment, key: u64) -> Self {
        let up_to = |max: f64, purpose| of(key, purpose).between(0.0, max);
        let strides = augment.ring_stride_max.max(1);
        let mut ground = of(key, Purpose::Ground);
        let shift = ground.between(
            -augment.ground_shift_rows_max,
            augment.ground_shift_rows_max,
        );
        let coarser = 8_u32.saturating_sub(augment.picture_bits_min) as usize;
        Self {
            key,
            threshold: up_to(augment.event_threshold_max.ln(), Purpose::Threshold).exp(),
            lag_us: up_to(augment.event_lag_us_max, Purpose::Lag),
            dead_us: up_to(augment.event_dead_us_max, Purpose::Dead),
            ring_drop: up_to(augment.ring_drop_max, Purpose::RingDrop),
            ring_stride: 1 + of(key, Purpose::RingStride).below(strides),
            range_noise_m: up_to(augment.range_noise_m_max, Purpose::RangeNoise),
            read_noise: up_to(augment.read_noise_max, Purpose::ReadNoise),
            bits: 8 - of(key, Purpose::Bits).below(coarser + 1) as u32,
            horizon_shift: (!ground.happens(augment.ground_unknown)).then_some(shift),
        }
    }

    /// What the network is told of the example's ground.
    pub(super) fn ground(&self, ground: Option<&Ground>) -> Option<Ground> {
        let shift = self.horizon_shift? as f32;
        Some(ground?.lowered(shift))
    }

    /// The chance that single pixels, returns and rings draw from.
    pub(super) fn chance(&self, purpose: Purpose) -> Chance {
        let mut chance = of(self.key, purpose);
        Chance::of(&[chance.word(), 1])
    }

    /// Takes rings out of planes of points, `[n, side, side]`, and moves the ranges of the others;
    /// `rows` says from which row of the example each row was taken.
    ///
    /// A ring is lost or kept at all steps. Ranges of one return at two steps are drawn apart.
    pub(super) fn returns(&self, points: &mut [f32], rows: &[usize]) {
        if self.ring_drop > 0.0 || self.ring_stride > 1 {
            let is_kept = self.rings();
            for (line, row) in points.chunks_exact_mut(rows.len()).zip(rows.iter().cycle()) {
                if !is_kept(*row) {
                    line.fill(0.0);
                }
            }
        }
        if self.range_noise_m > 0.0 {
            let mut chance = self.chance(Purpose::RangeNoise);
            for depth in points.iter_mut().filter(|depth| **depth > 0.0) {
                let moved = *depth + self.range_noise_m as f32 * normal(&mut chance);
                *depth = moved.max(RANGE_M_MIN);
            }
        }
    }

    /// Which rows of the example belong to rings that are kept.
    fn rings(&self) -> impl Fn(usize) -> bool + use<> {
        let mut stride = self.chance(Purpose::RingStride);
        let mut lost = self.chance(Purpose::RingDrop);
        let (phase, first) = (stride.unit(), stride.below(self.ring_stride));
        let of_row = move |row: usize| (row as f64 / RING_ROWS + phase) as usize;
        // Examples have at most 256 rows.
        let kept: Vec<bool> = (0..=of_row(256))
            .map(|ring| !lost.happens(self.ring_drop) & (ring % self.ring_stride == first))
            .collect();
        move |row| kept.get(of_row(row)).copied().unwrap_or(true)
    }

    /// Adds noise to the light of encoded values and rounds them to fewer bits; `gamma` is their
    /// encoding's exponent.
    pub(super) fn picture(&self, values: &mut [f32], gamma: f32) {
        if self.read_noise > 0.0 {
            let mut chance = self.chance(Purpose::ReadNoise);
            for value in values.iter_mut() {
                let light = value.powf(gamma) + self.read_noise as f32 * normal(&mut chance);
                *value = light.clamp(0.0, 1.0).powf(1.0 / gamma);
            }
        }
        if self.bits < 8 {
            let codes = ((1_u32 << self.bits) - 1) as f32;
            for value in values.iter_mut() {
                *value = (*value * codes).round() / codes;
            }
        }
    }
}

/// The chance of one purpose.
pub(super) fn of(key: u64, purpose: Purpose) -> Chance {
    Chance::of(&[key, purpose as u64])
}

/// Nearly standard normal: four uniform numbers of 16 bits, added; at most 3.5 from the middle.
fn normal(chance: &mut Chance) -> f32 {
    let word = chance.word();
    let sum: u64 = (0..4).map(|i| word >> (16 * i) & 0xffff).sum();
    // The sum of four uniform numbers in 0..1 has mean 2 and variance 1/3.
    ((sum as f32 + 2.0) / 65536.0 - 2.0) * 3_f32.sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn strong() -> Augment {
        Augment {
            event_threshold_max: 3.0,
            event_lag_us_max: 500.0,
            event_dead_us_max: 2000.0,
            ring_drop_max: 0.5,
            ring_stride_max: 4,
            range_noise_m_max: 0.1,
            read_noise_max: 0.05,
            picture_bits_min: 5,
            ..Augment::default()
        }
    }

    #[test]
    fn nothing_is_drawn_where_nothing_is_asked_for() {
        for key in 0..50 {
            let drawn = Vary::random(&Augment::default(), key);
            assert_eq!(drawn, Vary { key, ..Vary::NONE });
        }
    }

    #[test]
    fn the_ground_is_told_wrongly_or_not_at_all() {
        let ground = Ground::level(1.5, 262.0, 127.5).expect("a plane");
        let augment = Augment {
            ground_shift_rows_max: 3.0,
            ground_unknown: 0.25,
            ..Augment::default()
        };
        let told: Vec<Option<Ground>> = (0..400)
            .map(|key| Vary::random(&augment, key).ground(Some(&ground)))
            .collect();
        assert!((60..140).contains(&told.iter().filter(|told| told.is_none()).count()));
        let horizons = told.iter().flatten().map(|told| {
            assert_eq!(told.per_row, ground.per_row);
            -told.first / told.per_row
        });
        let (low, high) = horizons.fold((f32::MAX, f32::MIN), |(low, high), row| {
            (low.min(row), high.max(row))
        });
        assert!((124.4..125.5).contains(&low), "{low}");
        assert!((129.5..130.6).contains(&high), "{high}");
        assert_eq!(Vary::random(&augment, 1).ground(None), None);
        assert_eq!(Vary::NONE.ground(Some(&ground)), Some(ground));
    }

    #[test]
    fn no_setting_moves_the_draw_of_another() {
        let all = Vary::random(&strong(), 9);
        let ringless = Augment {
            ring_drop_max: 0.0,
            ring_stride_max: 1,
            ..strong()
        };
        let part = Vary::random(&ringless, 9);
        assert_eq!(
            part,
            Vary {
                ring_drop: 0.0,
                ring_stride: 1,
                ..all
            }
        );
        let drawn: Vec<Vary> = (0..200).map(|key| Vary::random(&strong(), key)).collect();
        for (low, high) in [(1, 4), (5, 8)] {
            let seen = |n: usize| {
                drawn
                    .iter()
                    .any(|v| v.ring_stride == n || v.bits as usize == n)
            };
            assert!((low..=high).all(seen));
        }
        assert!(
            drawn
                .iter()
                .all(|v| (1.0..=3.0).contains(&v.threshold) && v.lag_us <= 500.0)
        );
    }

    #[test]
    fn whole_rings_go_and_the_others_stay() {
        let rows: Vec<usize> = (10..74).collect();
        let vary = Vary {
            key: 3,
            ring_stride: 2,
            ..Vary::NONE
        };
        let mut points = vec![5.0_f32; 2 * 64 * 64];
        vary.returns(&mut points, &rows);
        let lines: Vec<bool> = points.chunks(64).map(|line| line[0] > 0.0).collect();
        assert!(
            points
                .chunks(64)
                .all(|line| line.iter().all(|d| *d == line[0]))
        );
        assert_eq!(lines[..64], lines[64..], "a ring is lost at all steps");
        let kept = lines[..64].iter().filter(|kept| **kept).count();
        assert!((26..=38).contains(&kept), "{kept}");
        let changes = lines[..64]
            .windows(2)
            .filter(|pair| pair[0] != pair[1])
            .count();
        assert!((9..=11).contains(&changes), "{changes} rings of six rows");
        let mut none = points.clone();
        Vary {
            ring_drop: 1.0,
            ..vary
        }
        .returns(&mut none, &rows);
        assert!(none.iter().all(|d| *d == 0.0));
    }

    #[test]
    fn noise_has_the_stated_spread() {
        let vary = Vary {
            key: 5,
            range_noise_m: 0.1,
            read_noise: 0.02,
            ..Vary::NONE
        };
        let spread = |values: &[f32]| {
            let n = values.len() as f64;
            let mean = values.iter().map(|v| f64::from(*v)).sum::<f64>() / n;
            let square = |v: &f32| (f64::from(*v) - mean).powi(2);
            (mean, (values.iter().map(square).sum::<f64>() / n).sqrt())
        };
        let mut ranges = vec![8.0_f32; 40_000];
        ranges[7] = 0.0;
        vary.returns(&mut ranges, &[0; 200]);
        assert_eq!(ranges.remove(7), 0.0, "no return stays none");
        let (mean, sigma) = spread(&ranges);
        assert!(
            (mean - 8.0).abs() < 2e-3 && (sigma - 0.1).abs() < 2e-3,
            "{mean} {sigma}"
        );
        let mut picture = vec![0.5_f32.powf(1.0 / 2.2); 40_000];
        vary.picture(&mut picture, 2.2);
        let light: Vec<f32> = picture.iter().map(|v| v.powf(2.2)).collect();
        let (mean, sigma) = spread(&light);
        assert!(
            (mean - 0.5).abs() < 1e-3 && (sigma - 0.02).abs() < 1e-3,
            "{mean} {sigma}"
        );
        let mut coarse: Vec<f32> = (0..=255_u8).map(|code| f32::from(code) / 255.0).collect();
        Vary {
            bits: 3,
            ..Vary::NONE
        }
        .picture(&mut coarse, 2.2);
        coarse.dedup();
        assert_eq!(coarse.len(), 8);
    }
}

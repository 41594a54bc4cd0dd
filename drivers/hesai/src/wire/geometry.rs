//! The correction table in the form the decoder multiplies by.

use super::sweep::Seam;
use super::{Correction, FireTimes};

/// Most lasers any model has.
pub(crate) const MAX_CHANNELS: usize = 128;

/// Directions, seam thresholds and times per channel; unused lanes are zero.
///
/// With a block at azimuth a and a laser at elevation e and offset o, the direction is
/// x = cos e sin(a + o) = `ahead` sin a + `aside` cos a, y = `ahead` cos a - `aside` sin a and
/// z = sin e, so that a block costs one sine and one cosine.
#[derive(Debug, Clone)]
pub(crate) struct Geometry {
    /// cos e cos o.
    pub ahead: [f32; MAX_CHANNELS],
    /// cos e sin o.
    pub aside: [f32; MAX_CHANNELS],
    /// sin e.
    pub up: [f32; MAX_CHANNELS],
    /// Block angle at which the channel crosses the cut, hundredths of a degree.
    pub cut: [i32; MAX_CHANNELS],
    /// Block azimuth at which the channel's own is zero, `0..36_000`.
    pub zero: [u16; MAX_CHANNELS],
    /// Firing time after the block's, nanoseconds.
    pub fire_ns: [i32; MAX_CHANNELS],
    /// Range of `cut`.
    pub seam: Seam,
    /// Range of `fire_ns`.
    pub fire_range_ns: (i32, i32),
}

impl Geometry {
    /// `turning_rpm`: the speed at which the head turns on while the lasers fire, 0 to ignore it.
    pub fn new(
        correction: &Correction,
        fire: &FireTimes,
        cut_azimuth_cdeg: u16,
        turning_rpm: u16,
    ) -> Self {
        let mut this = Self {
            ahead: [0.0; MAX_CHANNELS],
            aside: [0.0; MAX_CHANNELS],
            up: [0.0; MAX_CHANNELS],
            cut: [0; MAX_CHANNELS],
            zero: [0; MAX_CHANNELS],
            fire_ns: [0; MAX_CHANNELS],
            seam: Seam {
                first: i64::MAX,
                last: i64::MIN,
            },
            fire_range_ns: (i32::MAX, i32::MIN),
        };
        let lasers = correction.lasers().iter().zip(fire.channel_ns());
        for (channel, (laser, &fire_ns)) in lasers.enumerate() {
            // 6 degrees per second and rpm.
            let turned_deg = 6e-9 * f64::from(turning_rpm) * f64::from(fire_ns);
            let offset_deg = laser.azimuth_deg + turned_deg;
            this.aim(channel, laser.elevation_deg, offset_deg);
            let cut = ceil_cdeg(f64::from(cut_azimuth_cdeg) - offset_deg * 100.0);
            this.cut[channel] = cut;
            let zero = ceil_cdeg(-offset_deg * 100.0).rem_euclid(36_000);
            this.zero[channel] = u16::try_from(zero).unwrap_or(0);
            this.fire_ns[channel] = fire_ns;
            this.seam.first = this.seam.first.min(i64::from(cut));
            this.seam.last = this.seam.last.max(i64::from(cut));
            let (least, most) = this.fire_range_ns;
            this.fire_range_ns = (least.min(fire_ns), most.max(fire_ns));
        }
        this
    }

    #[expect(
        clippy::cast_possible_truncation,
        reason = "directions are kept in single precision"
    )]
    fn aim(&mut self, channel: usize, elevation_deg: f64, offset_deg: f64) {
        let (sin_e, cos_e) = elevation_deg.to_radians().sin_cos();
        let (sin_o, cos_o) = offset_deg.to_radians().sin_cos();
        self.ahead[channel] = (cos_e * cos_o) as f32;
        self.aside[channel] = (cos_e * sin_o) as f32;
        self.up[channel] = sin_e as f32;
    }
}

/// Rounds up, forgiving the last digits of decimal fractions that binary cannot hold.
#[expect(
    clippy::cast_possible_truncation,
    reason = "angles of a few turns at most"
)]
fn ceil_cdeg(cdeg: f64) -> i32 {
    ((cdeg * 1e5).round() / 1e5).ceil() as i32
}

/// Sines and cosines of block azimuths: of whole degrees and of hundredths, which add up.
///
/// 7 KiB, where a table of all azimuths would take 280 and much of the cache.
#[derive(Debug, Clone)]
pub(crate) struct Circle {
    degrees: [(f64, f64); 360],
    hundredths: [(f64, f64); 100],
}

impl Circle {
    pub fn new() -> Self {
        let mut this = Self {
            degrees: [(0.0, 1.0); 360],
            hundredths: [(0.0, 1.0); 100],
        };
        for (of, degree) in this.degrees.iter_mut().zip(0u16..) {
            *of = f64::from(degree).to_radians().sin_cos();
        }
        for (of, hundredth) in this.hundredths.iter_mut().zip(0u16..) {
            *of = (f64::from(hundredth) / 100.0).to_radians().sin_cos();
        }
        this
    }

    /// Sine and cosine of an azimuth below 36,000 hundredths of a degree, as single precision
    /// holds them.
    #[inline(always)]
    #[expect(
        clippy::cast_possible_truncation,
        reason = "directions are kept in single precision"
    )]
    pub fn sin_cos(&self, azimuth_cdeg: u16) -> (f32, f32) {
        let (sin_a, cos_a) = self.degrees[usize::from(azimuth_cdeg / 100)];
        let (sin_b, cos_b) = self.hundredths[usize::from(azimuth_cdeg % 100)];
        let sin = sin_a * cos_b + cos_a * sin_b;
        let cos = cos_a * cos_b - sin_a * sin_b;
        (sin as f32, cos as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::super::Model;
    use super::*;

    fn qt64(cut: u16, rpm: u16) -> Geometry {
        let model = Model::Qt64;
        Geometry::new(
            &Correction::nominal(model),
            &FireTimes::nominal(model),
            cut,
            rpm,
        )
    }

    #[test]
    fn decimal_offsets_do_not_move_the_seam_by_a_step() {
        assert_eq!(ceil_cdeg(-1.15 * 100.0), -115);
        assert_eq!(ceil_cdeg(0.29 * 100.0), 29);
        assert_eq!(ceil_cdeg(-873.6), -873);
        assert_eq!(ceil_cdeg(789.2), 790);
    }

    #[test]
    fn the_seam_lies_where_each_channel_crosses_the_cut() {
        let geometry = qt64(0, 0);
        assert_eq!(
            geometry.seam,
            Seam {
                first: -873,
                last: 790
            }
        );
        assert_eq!((geometry.cut[0], geometry.zero[0]), (-873, 35_127));
        assert_eq!((geometry.cut[63], geometry.zero[63]), (790, 790));
        assert_eq!(
            qt64(9_000, 0).seam,
            Seam {
                first: 9_000 - 873,
                last: 9_790
            }
        );
        assert_eq!(geometry.fire_range_ns, (2_310, 136_450));
    }

    #[test]
    fn angles_add_up_to_single_precision_everywhere() {
        let geometry = qt64(0, 0);
        let table = Correction::nominal(Model::Qt64);
        let circle = Circle::new();
        let mut worst = 0.0f64;
        for azimuth in (0..36_000).step_by(7) {
            let (sin, cos) = circle.sin_cos(azimuth);
            for (c, laser) in table.lasers().iter().enumerate() {
                let x = geometry.ahead[c] * sin + geometry.aside[c] * cos;
                let y = geometry.ahead[c] * cos - geometry.aside[c] * sin;
                let a = (f64::from(azimuth) / 100.0 + laser.azimuth_deg).to_radians();
                let e = laser.elevation_deg.to_radians();
                worst = worst.max((f64::from(x) - e.cos() * a.sin()).abs());
                worst = worst.max((f64::from(y) - e.cos() * a.cos()).abs());
            }
        }
        assert!(worst < 1.5e-7, "{worst}");
    }

    #[test]
    fn turning_during_the_firing_is_half_a_degree_at_most() {
        let (still, turning) = (qt64(0, 0), qt64(0, 600));
        let angle = |g: &Geometry, c: usize| g.aside[c].atan2(g.ahead[c]).to_degrees();
        let turned = |c| angle(&turning, c) - angle(&still, c);
        assert!((turned(63) - 0.491_22).abs() < 1e-4, "{}", turned(63));
        assert!((turned(0) - 0.008_3).abs() < 1e-4, "{}", turned(0));
    }
}

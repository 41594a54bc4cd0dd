//! When the camera's shutter is open, and how finely an exposure is rendered.

use crate::chance::{Dice, Purpose};
use crate::object::CAMERA_HEIGHT_M;
use crate::optics::Optics;
use crate::scene::Scene;

/// Steps an exposure is divided into.
pub const STEPS: usize = 8;

/// How hard a drive is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Tier {
    /// 60 ms exposures at 5 Hz.
    A,
    /// 160 ms exposures at 5 Hz.
    B,
    /// 400 to 700 ms exposures at 1 Hz.
    C,
    /// The ego vehicle stands and only others move; 100 to 160 ms exposures at 5 Hz.
    S,
}

impl Tier {
    /// Every tier, easiest name first.
    pub const ALL: [Self; 4] = [Self::A, Self::B, Self::C, Self::S];

    /// Whether the ego vehicle drives.
    #[must_use]
    pub const fn drives(self) -> bool {
        !matches!(self, Self::S)
    }

    /// One upper-case letter.
    #[must_use]
    pub const fn letter(self) -> char {
        match self {
            Self::A => 'A',
            Self::B => 'B',
            Self::C => 'C',
            Self::S => 'S',
        }
    }
}

impl core::str::FromStr for Tier {
    type Err = UnknownTier;

    fn from_str(text: &str) -> Result<Self, UnknownTier> {
        let found = Self::ALL.into_iter().find(|tier| {
            let mut buffer = [0; 4];
            text.eq_ignore_ascii_case(tier.letter().encode_utf8(&mut buffer))
        });
        found.ok_or_else(|| UnknownTier(text.to_owned()))
    }
}

/// A tier nobody knows.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("tier is {0:?}, must be A, B, C or S")]
pub struct UnknownTier(pub String);

/// An interval the shutter is open, in nanoseconds of true time since the drive's start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Opening {
    /// Counts the camera's exposures from 0.
    pub index: u64,
    /// The shutter opens.
    pub open_ns: u64,
    /// The shutter closes.
    pub close_ns: u64,
}

impl Opening {
    /// Length, seconds.
    #[must_use]
    pub fn seconds(&self) -> f64 {
        (self.close_ns - self.open_ns) as f64 * 1e-9
    }

    /// The instant at `share` (0 open, 1 close) of the exposure, seconds since the drive's start.
    #[must_use]
    pub fn at(&self, share: f64) -> f64 {
        (self.open_ns as f64 + share * (self.close_ns - self.open_ns) as f64) * 1e-9
    }

    /// Centre of step `k`, 0 to 7, seconds since the drive's start.
    #[must_use]
    pub fn step_centre(&self, k: usize) -> f64 {
        self.at((k as f64 + 0.5) / STEPS as f64)
    }
}

/// A camera's regular exposures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shutter {
    /// When the first exposure opens.
    pub first_ns: u64,
    /// From one opening to the next.
    pub period_ns: u64,
    /// How long it stays open.
    pub exposure_ns: u64,
}

impl Shutter {
    /// The shutter of a seed and tier.
    #[must_use]
    pub fn new(seed: u64, tier: Tier) -> Self {
        let mut dice = Dice::new(seed, Purpose::Exposure);
        let (phase, length) = (dice.unit(), dice.unit());
        let (period_ns, exposure_us) = match tier {
            Tier::A => (200_000_000, 60_000.0),
            Tier::B => (200_000_000, 160_000.0),
            Tier::C => (1_000_000_000, 400_000.0 + 300_000.0 * length),
            Tier::S => (200_000_000, 100_000.0 + 60_000.0 * length),
        };
        Self {
            first_ns: (phase * period_ns as f64) as u64,
            period_ns,
            exposure_ns: exposure_us as u64 * 1000,
        }
    }

    /// The `index`-th exposure.
    #[must_use]
    pub const fn opening(&self, index: u64) -> Opening {
        let open_ns = self.first_ns + index * self.period_ns;
        Opening {
            index,
            open_ns,
            close_ns: open_ns + self.exposure_ns,
        }
    }

    /// The first exposure that opens at or after `start_ns`.
    #[must_use]
    pub const fn first_from(&self, start_ns: u64) -> Opening {
        self.opening(
            start_ns
                .saturating_sub(self.first_ns)
                .div_ceil(self.period_ns),
        )
    }

    /// All exposures that close by `end_ns`.
    pub fn complete_until(&self, end_ns: u64) -> impl Iterator<Item = Opening> + use<> {
        let shutter = *self;
        (0..)
            .map(move |i| shutter.opening(i))
            .take_while(move |o| o.close_ns <= end_ns)
    }
}

/// Largest motion between two rendered instants as a share of the image's width: 2 pixels of the
/// network's 256.
const MOTION_SHARE: f64 = 2.0 / 256.0;
/// Sub-frames of an exposure: a multiple of the steps by odd numbers between these, so that the
/// middle sub-frame of each step is the step's centre.
const PER_STEP: [usize; 2] = [3, 17];

/// Fastest motion expected in an image at `t` seconds, pixels per second: the nearest visible
/// ground under ego motion, or close movers when standing.
fn pixel_rate(scene: &Scene, t: f64, optics: &Optics) -> f64 {
    let (speed, yaw_rate) = scene.ego_motion(t);
    let (focal, half) = (f64::from(optics.focal_px), optics.size as f64 / 2.0);
    let height = f64::from(CAMERA_HEIGHT_M);
    let nearest_m = height * focal / half;
    let ground = focal * height * speed / (nearest_m * nearest_m);
    let movers = 0.6 * focal;
    ground.max(movers) + yaw_rate.abs() * focal
}

/// Sub-frames for an exposure so that motion between them stays near 2 pixels of the
/// network's grid.
#[must_use]
pub(crate) fn sub_frames(scene: &Scene, opening: &Opening, optics: &Optics) -> usize {
    let motion = pixel_rate(scene, opening.at(0.5), optics) * opening.seconds();
    let per_step = (motion / (MOTION_SHARE * optics.size as f64) / STEPS as f64).ceil() as usize;
    STEPS * (per_step | 1).clamp(PER_STEP[0], PER_STEP[1])
}

/// Time between rendered instants while no shutter is open, seconds.
#[must_use]
pub(crate) fn idle_step_s(scene: &Scene, t: f64, optics: &Optics) -> f64 {
    (MOTION_SHARE * optics.size as f64 / pixel_rate(scene, t, optics)).clamp(0.002, 0.008)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exposures_follow_their_tier() {
        for seed in 0..20 {
            for (tier, range) in [
                (Tier::A, 60..=60),
                (Tier::B, 160..=160),
                (Tier::C, 400..=700),
                (Tier::S, 100..=160),
            ] {
                let shutter = Shutter::new(seed, tier);
                assert!(
                    range.contains(&(shutter.exposure_ns / 1_000_000)),
                    "{tier:?}"
                );
                assert!(shutter.exposure_ns < shutter.period_ns);
                let first = shutter.first_from(1_000_000_000);
                assert!(
                    first.open_ns >= 1_000_000_000
                        && first.open_ns < 1_000_000_000 + shutter.period_ns
                );
                assert_eq!(first, shutter.opening(first.index));
            }
        }
    }

    #[test]
    fn the_middle_sub_frame_of_a_step_is_its_centre() {
        let scene = Scene::new(1, 2.0, true);
        let opening = Shutter::new(1, Tier::B).opening(3);
        let n = sub_frames(&scene, &opening, &Optics::new(256));
        let per_step = n / STEPS;
        assert_eq!((n % STEPS, per_step % 2), (0, 1));
        for k in 0..STEPS {
            let middle = opening.at(((k * per_step + per_step / 2) as f64 + 0.5) / n as f64);
            assert!((middle - opening.step_centre(k)).abs() < 1e-12);
        }
    }

    #[test]
    fn tiers_parse_by_letter_and_refuse_others() {
        assert_eq!("b".parse(), Ok(Tier::B));
        let error = "X".parse::<Tier>().expect_err("there is no tier X");
        assert_eq!(error.to_string(), "tier is \"X\", must be A, B, C or S");
    }
}

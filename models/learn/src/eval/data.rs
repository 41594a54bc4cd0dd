//! Which exposures an evaluation is to run over, as written on a command line.

use std::ops::Range;
use std::path::PathBuf;
use std::str::FromStr;

use noctule_depth::Ground;
use noctule_world::Tier;

use super::error::EvalError;
use super::scene::WorldScenes;

/// A set of exposures, named.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum DataSet {
    /// `world:TIER:FIRST..LAST`: seeds of the synthetic night, the last excluded.
    World(WorldScenes),
    /// `rec:DIR`: a recording with truth.
    Recording(PathBuf),
    /// `kitti:ROOT`: KITTI depth completion in its official layout.
    Kitti(PathBuf),
    /// `nyu:ROOT`: NYU Depth v2.
    Nyu(PathBuf),
    /// `rgbd:ROOT`: RGB-D sequences in the layout of 7-Scenes.
    Rgbd(PathBuf),
}

/// Width and height of evaluation pictures, pixels.
const SIZE: usize = 256;

impl FromStr for DataSet {
    type Err = EvalError;

    fn from_str(text: &str) -> Result<Self, EvalError> {
        let wrong = |wanted: &'static str| EvalError::Data {
            text: text.to_owned(),
            wanted,
        };
        let (kind, rest) = text.split_once(':').ok_or_else(|| {
            wrong("world:TIER:FIRST..LAST, rec:DIR, kitti:ROOT, nyu:ROOT or rgbd:ROOT")
        })?;
        if rest.is_empty() {
            return Err(wrong("something after the colon"));
        }
        match kind {
            "world" => {
                let (tier, seeds) = rest
                    .split_once(':')
                    .ok_or_else(|| wrong("world:TIER:FIRST..LAST"))?;
                let tier: Tier = tier.parse().map_err(|_| wrong("tier A, B, C or S"))?;
                let seeds =
                    range(seeds).ok_or_else(|| wrong("seeds FIRST..LAST, FIRST below LAST"))?;
                Ok(Self::World(WorldScenes {
                    tier,
                    seeds,
                    size: SIZE,
                }))
            }
            "rec" => Ok(Self::Recording(rest.into())),
            "kitti" => Ok(Self::Kitti(rest.into())),
            "nyu" => Ok(Self::Nyu(rest.into())),
            "rgbd" => Ok(Self::Rgbd(rest.into())),
            _ => Err(wrong("world:, rec:, kitti:, nyu: or rgbd: in front")),
        }
    }
}

fn range(text: &str) -> Option<Range<u64>> {
    let (first, last) = text.split_once("..")?;
    let (first, last) = (first.parse().ok()?, last.parse().ok()?);
    (first < last).then_some(first..last)
}

/// Part `index` of `count` of a set: every `count`-th exposure.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Share {
    /// From 0.
    pub index: usize,
    /// 1 or more.
    pub count: usize,
}

impl Share {
    /// The whole.
    pub const WHOLE: Self = Self { index: 0, count: 1 };

    /// The indices below `total` that belong to this part.
    pub fn of(self, total: usize) -> impl Iterator<Item = usize> {
        (self.index..total).step_by(self.count)
    }
}

impl FromStr for Share {
    type Err = EvalError;

    /// `i/n`, i from 0 to below n.
    fn from_str(text: &str) -> Result<Self, EvalError> {
        let parts = text.split_once('/');
        let found = parts.and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
        match found {
            Some((index, count)) if index < count => Ok(Self { index, count }),
            _ => Err(EvalError::Data {
                text: text.to_owned(),
                wanted: "i/n with i from 0 to below n",
            }),
        }
    }
}

/// What a network is not allowed to see, and how wrongly it is told of the rest.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Withheld {
    /// No events: voxels of zero.
    pub events: bool,
    /// No picture: black.
    pub image: bool,
    /// No LiDAR: not a single return.
    pub lidar: bool,
    /// Not told where the ground lies.
    pub ground: bool,
    /// Told that the ground, and with it the horizon, lies this many rows farther down than it
    /// does, as where a car pitches or a calibration is off.
    pub ground_rows_off: f32,
}

const INPUTS_WANTED: &str = "full, or no-events, no-image, no-lidar, no-ground and ground-off:ROWS \
    (within 100 up or down) joined by +";
/// Most rows that the ground is told wrongly by.
const ROWS_OFF_MAX: f32 = 100.0;

impl Withheld {
    /// What a table says behind the network's name; empty for everything seen.
    pub fn label(self) -> String {
        let off = format!("ground {:+} rows off", self.ground_rows_off);
        [
            (self.events, "no events"),
            (self.image, "no image"),
            (self.lidar, "no LiDAR"),
            (self.ground, "no ground"),
            (self.ground_rows_off != 0.0, off.as_str()),
        ]
        .iter()
        .filter(|(is, _)| *is)
        .map(|(_, label)| format!(", {label}"))
        .collect()
    }

    /// What the network is told of a ground.
    pub(super) fn ground(self, ground: Option<&Ground>) -> Option<Ground> {
        let told = ground.filter(|_| !self.ground)?;
        Some(told.lowered(self.ground_rows_off))
    }
}

impl FromStr for Withheld {
    type Err = EvalError;

    /// `full`, or `no-events`, `no-image`, `no-lidar`, `no-ground`, `ground-off:ROWS` joined by `+`.
    fn from_str(text: &str) -> Result<Self, EvalError> {
        let mut withheld = Self::default();
        if text == "full" {
            return Ok(withheld);
        }
        for part in text.split('+') {
            match part {
                "no-events" => withheld.events = true,
                "no-image" => withheld.image = true,
                "no-lidar" => withheld.lidar = true,
                "no-ground" => withheld.ground = true,
                _ => {
                    let rows = part.strip_prefix("ground-off:");
                    let rows = rows.and_then(|rows| rows.parse::<f32>().ok());
                    let rows = rows.filter(|rows| rows.abs() <= ROWS_OFF_MAX);
                    withheld.ground_rows_off = rows.ok_or_else(|| EvalError::Data {
                        text: text.to_owned(),
                        wanted: INPUTS_WANTED,
                    })?;
                }
            }
        }
        Ok(withheld)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn data_is_read_and_nonsense_is_named() {
        let world = "world:b:200000..200032".parse::<DataSet>().expect("right");
        assert_eq!(
            world,
            DataSet::World(WorldScenes {
                tier: Tier::B,
                seeds: 200_000..200_032,
                size: 256
            })
        );
        let kitti = "kitti:/data/kitti:1".parse::<DataSet>().expect("right");
        assert_eq!(kitti, DataSet::Kitti("/data/kitti:1".into()));
        for text in [
            "world",
            "world:B",
            "world:Q:1..2",
            "world:B:5..5",
            "world:B:1..x",
            "rec:",
            "x:1",
        ] {
            let error = text.parse::<DataSet>().expect_err(text).to_string();
            assert!(error.contains(text), "{error}");
        }
    }

    #[test]
    fn inputs_are_read_and_the_ground_moves_as_told() {
        let level = Ground::level(1.5, 200.0, 100.0).expect("a plane");
        let inputs = "no-image+ground-off:-2.5".parse::<Withheld>();
        let inputs = inputs.expect("right");
        assert_eq!(inputs.label(), ", no image, ground -2.5 rows off");
        let told = inputs.ground(Some(&level)).expect("told");
        let wanted = Ground::level(1.5, 200.0, 97.5).expect("a plane");
        assert!((told.inverse_depth(0.0, 97.5)).abs() < 1e-6, "{told:?}");
        assert!((told.inverse_depth(7.0, 180.0) - wanted.inverse_depth(7.0, 180.0)).abs() < 1e-6);
        let full = Withheld::default();
        assert_eq!(full.ground(Some(&level)), Some(level));
        assert_eq!("full".parse::<Withheld>().expect("right"), full);
        assert_eq!(full.label(), "");
        let none = "no-ground".parse::<Withheld>().expect("right");
        assert_eq!(none.ground(Some(&level)), None);
        for text in ["", "no", "ground-off:", "ground-off:NaN", "ground-off:200"] {
            let error = text.parse::<Withheld>().expect_err(text).to_string();
            assert!(error.contains("ground-off:ROWS"), "{error}");
        }
    }

    #[test]
    fn parts_cover_the_whole_once() {
        let mut all: Vec<usize> = (0..3)
            .flat_map(|i| format!("{i}/3").parse::<Share>().expect("right").of(10))
            .collect();
        all.sort_unstable();
        assert_eq!(all, (0..10).collect::<Vec<_>>());
        for text in ["3/3", "1", "a/2", "-1/2", "0/0"] {
            assert!(text.parse::<Share>().is_err(), "{text}");
        }
    }

    #[test]
    fn what_is_withheld_is_said() {
        let some: Withheld = "no-events+no-image".parse().expect("right");
        assert_eq!(some.label(), ", no events, no image");
        assert_eq!("full".parse::<Withheld>().expect("right").label(), "");
        assert!("no-sound".parse::<Withheld>().is_err());
    }
}

//! Which exposures an evaluation is to run over, as written on a command line.

use std::ops::Range;
use std::path::PathBuf;
use std::str::FromStr;

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

/// What a network is allowed to see.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Withheld {
    /// No events: voxels of zero.
    pub events: bool,
    /// No picture: black.
    pub image: bool,
    /// No LiDAR: not a single return.
    pub lidar: bool,
    /// Not told where the ground lies.
    pub ground: bool,
}

impl Withheld {
    /// What a table says behind the network's name; empty for everything seen.
    pub fn label(self) -> String {
        [
            (self.events, "no events"),
            (self.image, "no image"),
            (self.lidar, "no LiDAR"),
            (self.ground, "no ground"),
        ]
        .iter()
        .filter(|(is, _)| *is)
        .map(|(_, label)| format!(", {label}"))
        .collect()
    }
}

impl FromStr for Withheld {
    type Err = EvalError;

    /// `full`, or `no-events`, `no-image`, `no-lidar`, `no-ground` joined by `+`.
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
                    return Err(EvalError::Data {
                        text: text.to_owned(),
                        wanted: "full, or no-events, no-image, no-lidar, no-ground joined by +",
                    });
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

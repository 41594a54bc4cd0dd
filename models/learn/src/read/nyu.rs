//! NYU Depth v2 in its raw layout: `SCENE/r-TIME-COUNT.ppm` and `SCENE/d-TIME-COUNT.pgm`.
//!
//! Colour and depth run at their own pace, so every depth map is paired with the picture nearest
//! in time. The two cameras are not registered to each other: that is [`super::nyu_register`]'s
//! work. The labelled set (`nyu_depth_v2_labeled.mat`) is `nyu_labelled`'s, the pre-processed one
//! (`00001.h5`) `nyu_still`'s.

use std::path::{Path, PathBuf};

use noctule_depth::{Canvas, DepthImage};

use super::error::ReadError;
use super::files;
use super::netpbm;

/// Longest file read, bytes; a picture has 921,615.
const FILE_LEN_MAX: u64 = 64 << 20;
/// Farthest depth of the sensor, metres.
const DEPTH_MAX_M: f32 = 10.0;
/// Greatest distance in time of a pair, seconds: half a period of the slower stream, 20 Hz.
const PAIR_S_MAX: f64 = 0.025;

/// Levels of folders below a root in which scenes are looked for: `ROOT/basements/basement_0001a`.
const LEVELS: usize = 2;

/// What lies below a folder of NYU Depth v2.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum NyuLayout {
    /// Folders of raw scenes, sorted.
    Raw(Vec<PathBuf>),
    /// Pre-processed single frames `00001.h5`, sorted; those of the part `val` where there is one.
    Stills(Vec<PathBuf>),
    /// The labelled set in MATLAB's format, and the file that says which frames are for testing.
    Labelled {
        /// `nyu_depth_v2_labeled.mat`.
        set: PathBuf,
        /// `splits.mat`, beside it.
        splits: PathBuf,
    },
}

/// The labelled set's file.
const LABELLED: &str = "nyu_depth_v2_labeled.mat";
/// What says which of its frames are for testing.
const SPLITS: &str = "splits.mat";

impl NyuLayout {
    /// Finds out which layout `root` has, in it and up to two levels below.
    ///
    /// # Errors
    /// [`ReadError`], when it has none of the three, or the labelled set lies there without
    /// `splits.mat`: frames that others train on would be scored too.
    pub fn of(root: &Path) -> Result<Self, ReadError> {
        let raw = files::folders_with(root, LEVELS, &|name| stream_of(name).is_some())?;
        if !raw.is_empty() {
            return Ok(Self::Raw(raw));
        }
        let part = files::first_folder([root.join("val")]).unwrap_or_else(|| root.into());
        let mut stills = Vec::new();
        for folder in files::folders_with(&part, LEVELS, &|name| name.ends_with(".h5"))? {
            let names = files::names(&folder)?;
            let names = names.iter().filter(|name| name.ends_with(".h5"));
            stills.extend(names.map(|name| folder.join(name)));
        }
        if !stills.is_empty() {
            return Ok(Self::Stills(stills));
        }
        let names = files::names(root)?;
        let has = |wanted: &str| names.iter().any(|name| name == wanted);
        match (has(LABELLED), has(SPLITS)) {
            (true, true) => Ok(Self::Labelled {
                set: root.join(LABELLED),
                splits: root.join(SPLITS),
            }),
            (true, false) => Err(ReadError::missing(
                root,
                format!("{SPLITS} beside {LABELLED}: it says which frames are for testing"),
            )),
            _ => Err(ReadError::missing(
                root,
                format!(
                    "scene with r-TIME-COUNT.ppm and d-TIME-COUNT.pgm, nor 00001.h5, nor {LABELLED}"
                ),
            )),
        }
    }
}

/// Which stream a file of a raw scene belongs to, and its name without the extension.
fn stream_of(name: &str) -> Option<(Stream, &str)> {
    match (name.get(..2), name.rsplit_once('.')) {
        (Some("d-"), Some((stem, "pgm"))) => Some((Stream::Depth, stem)),
        (Some("r-"), Some((stem, "ppm"))) => Some((Stream::Picture, stem)),
        _ => None, // acceleration, index files
    }
}

/// The two cameras of a raw scene.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Stream {
    Depth,
    Picture,
}

/// One depth map and the picture nearest to it in time.
#[derive(Debug, Clone, PartialEq)]
pub struct NyuPair {
    /// When depth was measured, seconds.
    pub depth_time_s: f64,
    /// When the picture was taken, seconds.
    pub picture_time_s: f64,
    depth: PathBuf,
    picture: PathBuf,
}

/// Pairs of one scene in order of time. Depth maps without a picture within 25 ms are left out.
///
/// # Errors
/// [`ReadError`], when the folder holds no pair, or a file of either kind without a time.
pub fn nyu_pairs(scene: &Path) -> Result<Vec<NyuPair>, ReadError> {
    let (mut depths, mut pictures) = (Vec::new(), Vec::new());
    for name in files::names(scene)? {
        if let Some((stream, stem)) = stream_of(&name) {
            let time = stem.split('-').nth(1).and_then(|t| t.parse::<f64>().ok());
            let time = time.filter(|t| t.is_finite()).ok_or_else(|| {
                ReadError::content(
                    scene,
                    format!("{name:?} has no time like r-1294886360.5-1.ppm"),
                )
            })?;
            let files = match stream {
                Stream::Depth => &mut depths,
                Stream::Picture => &mut pictures,
            };
            files.push((time, scene.join(&name)));
        }
    }
    depths.sort_by(|a, b| a.0.total_cmp(&b.0));
    pictures.sort_by(|a, b| a.0.total_cmp(&b.0));
    let pairs: Vec<NyuPair> = depths
        .into_iter()
        .filter_map(|(depth_time_s, depth)| {
            let after = pictures.partition_point(|(time, _)| *time < depth_time_s);
            let around = pictures.get(after.saturating_sub(1)..pictures.len().min(after + 1))?;
            let away = |time: f64| (time - depth_time_s).abs();
            let (picture_time_s, picture) = around
                .iter()
                .min_by(|a, b| away(a.0).total_cmp(&away(b.0)))?
                .clone();
            (away(picture_time_s) <= PAIR_S_MAX).then_some(NyuPair {
                depth_time_s,
                picture_time_s,
                depth,
                picture,
            })
        })
        .collect();
    match pairs.is_empty() {
        true => Err(ReadError::missing(
            scene,
            "depth map with a picture within 25 ms",
        )),
        false => Ok(pairs),
    }
}

impl NyuPair {
    /// The picture's file.
    pub fn picture_path(&self) -> &Path {
        &self.picture
    }

    /// The depth map's file.
    pub fn depth_path(&self) -> &Path {
        &self.depth
    }

    /// Reads the picture.
    ///
    /// # Errors
    /// [`ReadError`], when it is missing or no P6 of 8 bits.
    pub fn picture(&self) -> Result<Canvas, ReadError> {
        let bytes = files::bytes(&self.picture, FILE_LEN_MAX)?;
        let fault = |fault: String| ReadError::content(&self.picture, fault);
        let found = netpbm::parse(&bytes, "P6", 255, 3).map_err(fault)?;
        Canvas::from_rgb(found.width, found.height, found.bytes.to_vec())
            .map_err(|error| fault(error.to_string()))
    }

    /// Reads the depth map.
    ///
    /// # Errors
    /// [`ReadError`], when it is missing or no P5 of 16 bits.
    pub fn depth(&self) -> Result<DepthImage, ReadError> {
        let bytes = files::bytes(&self.depth, FILE_LEN_MAX)?;
        let found = netpbm::parse(&bytes, "P5", 65535, 2)
            .map_err(|fault| ReadError::content(&self.depth, fault))?;
        let (codes, _) = found.bytes.as_chunks::<2>();
        Ok(DepthImage {
            width: found.width,
            height: found.height,
            depth_m: codes
                .iter()
                .map(|code| metres(u16::from_le_bytes(*code)))
                .collect(),
        })
    }
}

/// Depth of a Kinect's disparity, which its files hold low byte first, against what the format
/// demands (NYU Depth v2 toolbox, `swapbytes` and the depth parameters); 0 where there is none.
fn metres(disparity: u16) -> f32 {
    let depth = 351.3 / (1092.5 - f32::from(disparity));
    match depth > 0.0 && depth <= DEPTH_MAX_M {
        true => depth,
        false => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn pairs_are_nearest_in_time_and_depth_is_swapped() {
        let folder = tempfile::tempdir().expect("a folder");
        let write =
            |name: &str, bytes: &[u8]| fs::write(folder.path().join(name), bytes).expect("written");
        write("r-100.010-7.ppm", b"P6 1 1 255\nabc");
        write("r-100.040-8.ppm", b"P6 1 1 255\ndef");
        // 741 = 0x02e5: 351.3 / 351.5 m; 2047 is no measurement; 1092 would be 702.6 m.
        write("d-100.030-9.pgm", b"P5 3 1 65535\n\xe5\x02\xff\x07\x44\x04");
        write("d-100.200-10.pgm", b"P5 1 1 65535\n\xe5\x02");
        write("a-100.030-9.dump", b"");
        let pairs = nyu_pairs(folder.path()).expect("one pair");
        assert_eq!(pairs.len(), 1);
        assert_eq!(
            (pairs[0].depth_time_s, pairs[0].picture_time_s),
            (100.03, 100.04)
        );
        assert_eq!(pairs[0].picture().expect("a picture").rgb(), b"def");
        let depth = pairs[0].depth().expect("a map").depth_m;
        assert!(
            (depth[0] - 0.999_431).abs() < 1e-6 && depth[1..] == [0.0, 0.0],
            "{depth:?}"
        );
        write("d-100.030-9.pgm", b"P5 1 1 255\n\xe5");
        let error = pairs[0].depth().expect_err("of 8 bits").to_string();
        assert!(
            error.contains("d-100.030-9.pgm: greatest value is 255"),
            "{error}"
        );
        write("r-soon.ppm", b"");
        let error = nyu_pairs(folder.path()).expect_err("no time").to_string();
        assert!(error.contains("\"r-soon.ppm\" has no time"), "{error}");
    }

    #[test]
    fn layouts_are_told_apart_and_faults_are_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let root = folder.path();
        let write = |name: &str| {
            let path = root.join(name);
            fs::create_dir_all(path.parent().expect("a parent")).expect("a folder");
            fs::write(path, b"").expect("written");
        };
        let error = nyu_pairs(root).expect_err("empty").to_string();
        assert!(error.contains("has no depth map with a picture"), "{error}");
        let error = NyuLayout::of(root).expect_err("empty").to_string();
        assert!(error.contains("has no scene with r-TIME"), "{error}");
        write("nyu_depth_v2_labeled.mat");
        let error = NyuLayout::of(root).expect_err("all frames").to_string();
        assert!(
            error.contains("has no splits.mat beside nyu_depth_v2_labeled.mat"),
            "{error}"
        );
        write("splits.mat");
        let found = NyuLayout::of(root).expect("a layout");
        let [set, splits] = ["nyu_depth_v2_labeled.mat", "splits.mat"].map(|name| root.join(name));
        assert_eq!(found, NyuLayout::Labelled { set, splits });
        write("train/basement_0001a/00001.h5");
        let stills =
            |names: &[&str]| NyuLayout::Stills(names.iter().map(|name| root.join(name)).collect());
        let found = NyuLayout::of(root).expect("a layout");
        assert_eq!(found, stills(&["train/basement_0001a/00001.h5"]));
        write("val/official/00002.h5");
        write("val/official/00001.h5");
        let found = NyuLayout::of(root).expect("a layout");
        let wanted = ["val/official/00001.h5", "val/official/00002.h5"];
        assert_eq!(found, stills(&wanted));
        write("cafes/cafe_0002/d-1.0-2.pgm");
        write("cafes/cafe_0001/r-1.0-2.ppm");
        let scenes = ["cafes/cafe_0001", "cafes/cafe_0002"].map(|name| root.join(name));
        let found = NyuLayout::of(root).expect("a layout");
        assert_eq!(found, NyuLayout::Raw(scenes.to_vec()));
        let one = NyuLayout::of(&scenes[1]).expect("a layout");
        assert_eq!(one, NyuLayout::Raw(vec![scenes[1].clone()]));
    }
}

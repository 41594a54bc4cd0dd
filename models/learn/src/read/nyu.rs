//! NYU Depth v2 in its raw layout: `SCENE/r-TIME-COUNT.ppm` and `SCENE/d-TIME-COUNT.pgm`.
//!
//! Colour and depth run at their own pace, so every depth map is paired with the picture nearest
//! in time. The two cameras are not registered to each other: that is the toolbox's work, and edges
//! of the two lie apart by some pixels. HDF5 files (`nyu_depth_v2_labeled.mat`, `00001.h5`) are not
//! read.

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
/// [`ReadError`], when the folder holds HDF5, or no pair, or a file called otherwise.
pub fn nyu_pairs(scene: &Path) -> Result<Vec<NyuPair>, ReadError> {
    let (mut depths, mut pictures) = (Vec::new(), Vec::new());
    for name in files::names(scene)? {
        if name.ends_with(".h5") || name.ends_with(".mat") {
            let fault = "is HDF5, which is not read: convert it to SCENE/r-TIME-COUNT.ppm (P6) and \
                         SCENE/d-TIME-COUNT.pgm (P5 of 16 bits, raw disparity)";
            return Err(ReadError::content(&scene.join(&name), fault));
        }
        let stream = match (name.get(..2), name.rsplit_once('.')) {
            (Some("d-"), Some((stem, "pgm"))) => Some((&mut depths, stem)),
            (Some("r-"), Some((stem, "ppm"))) => Some((&mut pictures, stem)),
            _ => None, // acceleration, index files
        };
        if let Some((stream, stem)) = stream {
            let time = stem.split('-').nth(1).and_then(|t| t.parse::<f64>().ok());
            let time = time.filter(|t| t.is_finite()).ok_or_else(|| {
                ReadError::content(
                    scene,
                    format!("{name:?} has no time like r-1294886360.5-1.ppm"),
                )
            })?;
            stream.push((time, scene.join(&name)));
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
    fn hdf5_is_refused_with_what_to_do() {
        let folder = tempfile::tempdir().expect("a folder");
        let error = nyu_pairs(folder.path()).expect_err("empty").to_string();
        assert!(error.contains("has no depth map with a picture"), "{error}");
        fs::write(folder.path().join("00001.h5"), b"").expect("written");
        let error = nyu_pairs(folder.path()).expect_err("HDF5").to_string();
        assert!(
            error.contains("00001.h5: is HDF5, which is not read: convert"),
            "{error}"
        );
    }
}

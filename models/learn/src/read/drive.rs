//! Raw drives of KITTI: pictures of one colour camera, Velodyne scans and time stamps.
//!
//! ```text
//! raw/2011_09_26/calib_cam_to_cam.txt, calib_velo_to_cam.txt
//! raw/2011_09_26/2011_09_26_drive_0001_sync/image_02/data/0000000005.png
//!                                           image_02/timestamps.txt
//!                                           velodyne_points/data/0000000005.bin
//! ```

use std::path::{Path, PathBuf};

use noctule_depth::Canvas;

use super::calibration::{Calibration, ColourCamera};
use super::error::ReadError;
use super::files;
use super::velodyne::{ScanPoint, read_scan};

/// Which drives the depth benchmark holds back from training: its folder `val`.
const VALIDATION: [&str; 13] = [
    "2011_09_26_drive_0002",
    "2011_09_26_drive_0005",
    "2011_09_26_drive_0013",
    "2011_09_26_drive_0020",
    "2011_09_26_drive_0023",
    "2011_09_26_drive_0036",
    "2011_09_26_drive_0079",
    "2011_09_26_drive_0095",
    "2011_09_26_drive_0113",
    "2011_09_28_drive_0037",
    "2011_09_29_drive_0026",
    "2011_09_30_drive_0016",
    "2011_10_03_drive_0047",
];

/// Whether the depth benchmark holds this drive back from training.
pub fn is_validation_drive(name: &str) -> bool {
    VALIDATION.contains(&name.strip_suffix("_sync").unwrap_or(name))
}

/// One raw drive as one colour camera saw it.
#[derive(Debug, Clone)]
pub struct Drive {
    folder: PathBuf,
    name: String,
    camera: ColourCamera,
    calibration: Calibration,
    pictures: Vec<u32>,
    scans: Vec<u32>,
}

impl Drive {
    /// Lists a drive's folder and reads its day's calibration, which lies beside it.
    ///
    /// # Errors
    /// [`ReadError`], when pictures, scans or calibration are missing or damaged, or a file among
    /// the frames is called otherwise.
    pub fn open(folder: &Path, camera: ColourCamera) -> Result<Self, ReadError> {
        let name = drive_name(folder).ok_or_else(|| {
            ReadError::content(folder, "is not called like 2011_09_26_drive_0001_sync")
        })?;
        let day = folder.parent().unwrap_or(Path::new(""));
        Ok(Self {
            calibration: Calibration::read(day, camera)?,
            pictures: files::frames(&folder.join(camera.folder()).join("data"), "png")?,
            scans: files::frames(&folder.join("velodyne_points/data"), "bin")?,
            folder: folder.into(),
            name,
            camera,
        })
    }

    /// `2011_09_26_drive_0001_sync`.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its calibration.
    pub fn calibration(&self) -> &Calibration {
        &self.calibration
    }

    /// Numbers of the frames that have a picture, ascending.
    pub fn pictures(&self) -> &[u32] {
        &self.pictures
    }

    /// Numbers of the frames that have a scan, ascending; some drives lack a few.
    pub fn scans(&self) -> &[u32] {
        &self.scans
    }

    /// Reads one picture.
    ///
    /// # Errors
    /// [`ReadError`], when it is missing or not RGB of 8 bits.
    pub fn picture(&self, frame: u32) -> Result<Canvas, ReadError> {
        let folder = self.folder.join(self.camera.folder()).join("data");
        Ok(Canvas::load_png(files::frame_path(&folder, frame, "png"))?)
    }

    /// Reads one scan.
    ///
    /// # Errors
    /// [`ReadError`], when it is missing or damaged.
    pub fn scan(&self, frame: u32) -> Result<Vec<ScanPoint>, ReadError> {
        let folder = self.folder.join("velodyne_points/data");
        read_scan(&files::frame_path(&folder, frame, "bin"))
    }

    /// When the pictures were taken, nanoseconds since 1970 on the recording computer's clock, one
    /// for every frame from 0; `None` where the drive has no such file.
    ///
    /// # Errors
    /// [`ReadError`], naming the line that is no time, or comes before the one above it.
    pub fn picture_times_ns(&self) -> Result<Option<Vec<u64>>, ReadError> {
        let path = self
            .folder
            .join(self.camera.folder())
            .join("timestamps.txt");
        if !path.exists() {
            return Ok(None);
        }
        let times = parse_times(&files::text(&path)?);
        times
            .map(Some)
            .map_err(|fault| ReadError::content(&path, fault))
    }
}

/// A drive folder's name, if it is called like one.
pub(super) fn drive_name(folder: &Path) -> Option<String> {
    let name = folder.file_name()?.to_str()?;
    is_drive_name(name).then(|| name.to_owned())
}

/// `2011_09_26_drive_0001_sync` or without `_sync`.
pub(super) fn is_drive_name(name: &str) -> bool {
    let name = name.strip_suffix("_sync").unwrap_or(name);
    let Some((day, number)) = name.split_once("_drive_") else {
        return false;
    };
    let digits =
        |text: &str, len: usize| text.len() == len && text.bytes().all(|b| b.is_ascii_digit());
    let parts: Vec<&str> = day.split('_').collect();
    let is_day = parts.len() == 3 && parts.iter().zip([4, 2, 2]).all(|(p, len)| digits(p, len));
    is_day && digits(number, 4)
}

/// All raw drives below `root`: in its `raw` or `kitti_raw`, in the days there, in a day, or the
/// drive itself. Sorted by name.
///
/// # Errors
/// [`ReadError`], when there is none or one of them cannot be listed.
pub fn raw_drives(root: &Path, camera: ColourCamera) -> Result<Vec<Drive>, ReadError> {
    let places = raw_drive_folders(root)?;
    if places.is_empty() {
        return Err(ReadError::missing(
            root,
            "raw drive like raw/2011_09_26/2011_09_26_drive_0001_sync",
        ));
    }
    places
        .iter()
        .map(|place| Drive::open(place, camera))
        .collect()
}

/// Folders of raw drives below `root`, sorted by name.
pub(super) fn raw_drive_folders(root: &Path) -> Result<Vec<PathBuf>, ReadError> {
    if drive_name(root).is_some() {
        return Ok(vec![root.into()]);
    }
    let inner = [root.join("raw"), root.join("kitti_raw")];
    let top = files::first_folder(inner).unwrap_or_else(|| root.into());
    let mut found = Vec::new();
    for name in files::names(&top)? {
        let place = top.join(&name);
        if !place.is_dir() {
            continue;
        }
        if is_drive_name(&name) {
            found.push(place);
        } else if top.join(&name).join("calib_cam_to_cam.txt").is_file() {
            let drives = files::names(&place)?;
            let drives = drives.iter().filter(|name| is_drive_name(name));
            found.extend(
                drives
                    .map(|name| place.join(name))
                    .filter(|place| place.is_dir()),
            );
        }
    }
    Ok(found)
}

/// Lines `2011-09-26 13:02:25.964389445`, ascending.
fn parse_times(text: &str) -> Result<Vec<u64>, String> {
    let mut times: Vec<u64> = Vec::new();
    for (number, line) in (1..).zip(text.lines()) {
        let time =
            parse_time(line.trim()).ok_or_else(|| format!("line {number}: {line:?} is no time"))?;
        if times.last().is_some_and(|last| time <= *last) {
            return Err(format!(
                "line {number}: {line:?} comes before the line above it"
            ));
        }
        times.push(time);
    }
    Ok(times)
}

/// Nanoseconds since 1970 of one time stamp; up to nine digits of a second's fraction.
fn parse_time(text: &str) -> Option<u64> {
    let (day, time) = text.split_once(' ')?;
    let [year, month, date] = whole_numbers(day, '-', [1970..=2200, 1..=12, 1..=31])?;
    let (time, fraction) = time.split_once('.').unwrap_or((time, "0"));
    let [hour, minute, second] = whole_numbers(time, ':', [0..=23, 0..=59, 0..=60])?;
    let is_fraction =
        (1..=9).contains(&fraction.len()) && fraction.bytes().all(|b| b.is_ascii_digit());
    let scale = 10_u64.pow(u32::try_from(9_usize.checked_sub(fraction.len())?).ok()?);
    let nanos = is_fraction.then(|| fraction.parse::<u64>().ok())?? * scale;
    // Days since 1970 in the Gregorian calendar, years counted from March.
    let (year, month) = if month > 2 {
        (year, month - 3)
    } else {
        (year - 1, month + 9)
    };
    let days = 365 * year + year / 4 - year / 100 + year / 400 + (153 * month + 2) / 5 + date - 1;
    let days = days - 719_468;
    let seconds = ((days * 24 + hour) * 60 + minute) * 60 + second;
    Some(seconds * 1_000_000_000 + nanos)
}

/// Whole numbers with something between, each in its range.
fn whole_numbers(
    text: &str,
    between: char,
    ranges: [std::ops::RangeInclusive<u64>; 3],
) -> Option<[u64; 3]> {
    let mut words = text.split(between);
    let mut numbers = [0; 3];
    for (number, range) in numbers.iter_mut().zip(ranges) {
        *number = words.next()?.parse().ok().filter(|n| range.contains(n))?;
    }
    words.next().is_none().then_some(numbers)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Expected values by `date -u -d ... +%s`.
    #[test]
    fn times_are_read_to_the_nanosecond() {
        let text = "2011-09-26 13:02:25.964389445\n2011-09-26 13:02:26.07\n2012-02-29 00:00:00\n";
        assert_eq!(
            parse_times(text),
            Ok(vec![
                1_317_042_145_964_389_445,
                1_317_042_146_070_000_000,
                1_330_473_600_000_000_000
            ])
        );
        let back = "2011-09-26 13:02:25.9\n2011-09-26 13:02:25.8\n";
        let error = parse_times(back).expect_err("time runs backwards");
        assert!(error.starts_with("line 2: "), "{error}");
        for wrong in [
            "",
            "2011-09-26",
            "2011-13-26 13:02:25",
            "2011-09-26 13:02:25.",
            "2011-09-26 13:02:25.0123456789",
        ] {
            assert_eq!(parse_time(wrong), None, "{wrong:?}");
        }
    }

    #[test]
    fn drives_are_told_by_their_names() {
        for name in ["2011_09_26_drive_0001_sync", "2011_09_26_drive_0001"] {
            assert!(is_drive_name(name), "{name}");
        }
        for name in [
            "2011_09_26",
            "2011_09_26_drive_1_sync",
            "a_b_c_drive_0001",
            "2011_09_drive_0001_sync",
        ] {
            assert!(!is_drive_name(name), "{name}");
        }
        assert!(is_validation_drive("2011_09_26_drive_0002_sync"));
        assert!(!is_validation_drive("2011_09_26_drive_0001_sync"));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(128))]

        #[test]
        fn no_text_makes_times_panic(text in "[0-9:. \n-]{0,80}|\\PC{0,40}") {
            if let Ok(times) = parse_times(&text) {
                prop_assert_eq!(times.len(), text.lines().count());
            }
        }
    }
}

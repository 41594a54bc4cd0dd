//! Sequences of an RGB-D camera in the layout of 7-Scenes: `frame-000943.color.png` (or `.jpg`) and
//! `frame-000943.depth.png`, millimetres in 16 bits.
//!
//! Poses and calibration beside them are not read. Colour and depth of 7-Scenes are not registered
//! to each other; edges of the two lie apart by a few pixels.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use jpeg_decoder::{Decoder, PixelFormat};
use noctule_depth::{Canvas, DepthImage, load_depth_png16};

use super::error::ReadError;
use super::files;

/// Longest decoded picture, bytes.
const PICTURE_LEN_MAX: usize = 64 << 20;
/// Depth codes per code of the reader, which takes 256 of them for a metre.
const READER_CODES_PER_M: f32 = 256.0;
/// What stands where nothing was measured, besides 0.
const NO_DEPTH: f32 = 65535.0;
/// Levels of folders below a root in which sequences are looked for: `ROOT/chess/seq-01`.
const LEVELS: usize = 2;

/// One picture and the depth map of the same number.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RgbdFrame {
    /// Its number in the sequence.
    pub number: u32,
    picture: PathBuf,
    depth: PathBuf,
}

/// Folders with frames at `root` and up to two levels below, sorted.
///
/// # Errors
/// [`ReadError`], when there is none, or a folder cannot be read.
pub fn rgbd_sequences(root: &Path) -> Result<Vec<PathBuf>, ReadError> {
    let found = files::folders_with(root, LEVELS, &|name| part_of(name).is_some())?;
    match found.is_empty() {
        true => Err(ReadError::missing(
            root,
            "frame-000000.color.png with frame-000000.depth.png",
        )),
        false => Ok(found),
    }
}

/// The frames of one sequence, ascending.
///
/// # Errors
/// [`ReadError`], when a frame has a picture and no depth, or the other way round.
pub fn rgbd_frames(folder: &Path) -> Result<Vec<RgbdFrame>, ReadError> {
    let mut parts: BTreeMap<u32, [Option<PathBuf>; 2]> = BTreeMap::new();
    // Sorted, so that of two pictures of a frame the PNG, which loses nothing, comes last and stays.
    for name in files::names(folder)? {
        if let Some((number, part)) = part_of(&name) {
            parts.entry(number).or_default()[part as usize] = Some(folder.join(&name));
        }
    }
    let frames = parts.into_iter().map(|(number, parts)| match parts {
        [Some(picture), Some(depth)] => Ok(RgbdFrame {
            number,
            picture,
            depth,
        }),
        [None, _] => Err(ReadError::missing(
            folder,
            format!("frame-{number:06}.color.png or .jpg"),
        )),
        [_, None] => Err(ReadError::missing(
            folder,
            format!("frame-{number:06}.depth.png"),
        )),
    });
    frames.collect()
}

/// The two files of a frame.
#[derive(Clone, Copy)]
enum Part {
    Picture,
    Depth,
}

/// Number and part of `frame-000943.color.png`.
fn part_of(name: &str) -> Option<(u32, Part)> {
    let (number, rest) = name.strip_prefix("frame-")?.split_once('.')?;
    let is_number = number.len() == 6 && number.bytes().all(|byte| byte.is_ascii_digit());
    let part = match rest {
        "color.png" | "color.jpg" => Part::Picture,
        "depth.png" => Part::Depth,
        _ => return None,
    };
    is_number.then(|| Some((number.parse().ok()?, part)))?
}

impl RgbdFrame {
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
    /// [`ReadError`], when it is missing, damaged or not RGB of 8 bits.
    pub fn picture(&self) -> Result<Canvas, ReadError> {
        match self.picture.extension().is_some_and(|end| end == "jpg") {
            true => read_jpeg(&self.picture),
            false => Ok(Canvas::load_png(&self.picture)?),
        }
    }

    /// Reads the depth map, metres; 0 where nothing was measured.
    ///
    /// # Errors
    /// [`ReadError`], when it is missing or no PNG of 16 bits.
    pub fn depth(&self) -> Result<DepthImage, ReadError> {
        let mut image = load_depth_png16(&self.depth)?;
        for depth in &mut image.depth_m {
            let millimetres = *depth * READER_CODES_PER_M;
            *depth = match millimetres == NO_DEPTH {
                true => 0.0,
                false => millimetres / 1000.0,
            };
        }
        Ok(image)
    }
}

fn read_jpeg(path: &Path) -> Result<Canvas, ReadError> {
    let file = File::open(path).map_err(ReadError::in_file(path))?;
    let fault = |fault: String| ReadError::content(path, fault);
    let mut decoder = Decoder::new(BufReader::new(file));
    decoder.set_max_decoding_buffer_size(PICTURE_LEN_MAX);
    let pixels = decoder.decode().map_err(|error| fault(error.to_string()))?;
    let info = decoder
        .info()
        .ok_or_else(|| fault("has no header".into()))?;
    if info.pixel_format != PixelFormat::RGB24 {
        let found = info.pixel_format;
        return Err(fault(format!("has pixels {found:?}, wanted RGB of 8 bits")));
    }
    Canvas::from_rgb(info.width.into(), info.height.into(), pixels)
        .map_err(|error| fault(error.to_string()))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use noctule_depth::save_depth_png16;

    use super::*;

    #[test]
    fn frames_are_pairs_in_millimetres() {
        let folder = tempfile::tempdir().expect("a folder");
        let root = folder.path();
        let error = rgbd_sequences(root).expect_err("empty").to_string();
        assert!(error.contains("has no frame-000000.color.png"), "{error}");
        let sequence = root.join("chess/seq-01");
        fs::create_dir_all(&sequence).expect("a folder");
        let picture = Canvas::new(3, 1, [1, 2, 3]).expect("a picture");
        let at = |name: &str| sequence.join(name);
        picture
            .save_png(at("frame-000007.color.png"))
            .expect("written");
        // 1500, 65535 and 0 as codes.
        let codes = [1500.0 / 256.0, 65535.0 / 256.0, 0.0];
        save_depth_png16(at("frame-000007.depth.png"), 3, 1, &codes).expect("written");
        fs::write(at("frame-000007.pose.txt"), b"").expect("written");
        assert_eq!(
            rgbd_sequences(root).expect("one"),
            std::slice::from_ref(&sequence)
        );
        let frames = rgbd_frames(&sequence).expect("one frame");
        assert_eq!((frames.len(), frames[0].number), (1, 7));
        assert_eq!(frames[0].picture().expect("a picture").rgb(), picture.rgb());
        assert_eq!(frames[0].depth().expect("a map").depth_m, [1.5, 0.0, 0.0]);
        fs::write(at("frame-000008.color.jpg"), b"no picture").expect("written");
        let error = rgbd_frames(&sequence).expect_err("no depth").to_string();
        assert!(error.contains("has no frame-000008.depth.png"), "{error}");
        let torn = read_jpeg(&at("frame-000008.color.jpg")).expect_err("no JPEG");
        assert!(
            torn.to_string().contains("frame-000008.color.jpg: "),
            "{torn}"
        );
    }
}

//! Rooms as exposures with truth: windows of eight frames of an RGB-D camera, 640 x 480 pixels.
//!
//! The middle 456 x 456 pixels become 256 x 256: pictures by area in linear light, depth by the
//! nearest pixel. What a LiDAR would have given are points of the depth map, drawn anew for every
//! step from a seed that only the window's name decides; the map itself is what is scored, up to
//! 10 m.

use std::path::Path;
use std::sync::Arc;

use noctule_depth::{Canvas, DepthImage, Size};
use noctule_raster::{Encoding, EncodingTable};
use noctule_world::STEPS;

use super::error::EvalError;
use super::scene::{Scene, voxels};
use crate::chance::Chance;
use crate::read::{NyuPair, ReadError, RgbdFrame, registered};
use crate::synth::{Footage, Synthesis, expose};

/// Columns of a frame.
const WIDTH: usize = 640;
/// Rows of a frame.
const HEIGHT: usize = 480;
/// Side of the middle square that is looked at, pixels.
const SQUARE: usize = 456;
/// Side of the squares that are scored, pixels.
const SIDE: usize = 256;
/// Points given per step.
const POINTS: usize = 500;
/// Farthest depth scored, metres.
const CAP_M: f32 = 10.0;
/// Salt of the points' chance.
const DRAW: u64 = 0x726f_6f6d;
/// Period that stands for a frame which does not move, microseconds: an eighth of the exposure.
const STILL_US: u32 = 33_333;

/// One frame, wherever it lies.
pub(super) trait RoomFrame {
    /// The picture's file.
    fn picture_path(&self) -> &Path;
    /// The depth map's file.
    fn depth_path(&self) -> &Path;
    /// Reads the picture.
    fn picture(&self) -> Result<Canvas, ReadError>;
    /// Reads depth as seen from the picture's camera, metres, 0 for none.
    fn depth(&self) -> Result<DepthImage, ReadError>;
}

impl RoomFrame for NyuPair {
    fn picture_path(&self) -> &Path {
        self.picture_path()
    }
    fn depth_path(&self) -> &Path {
        self.depth_path()
    }
    fn picture(&self) -> Result<Canvas, ReadError> {
        self.picture()
    }
    fn depth(&self) -> Result<DepthImage, ReadError> {
        Ok(registered(self.depth()?))
    }
}

impl RoomFrame for RgbdFrame {
    fn picture_path(&self) -> &Path {
        self.picture_path()
    }
    fn depth_path(&self) -> &Path {
        self.depth_path()
    }
    fn picture(&self) -> Result<Canvas, ReadError> {
        self.picture()
    }
    fn depth(&self) -> Result<DepthImage, ReadError> {
        self.depth()
    }
}

/// Eight frames of a run of frames without a gap.
#[derive(Debug, Clone)]
pub(super) struct RoomWindow<F> {
    /// Folder and first frame.
    name: String,
    run: Arc<[F]>,
    /// Index of its first frame in the run.
    first: usize,
    period_us: f64,
}

/// All windows of a run, which share no frame; `name` says what the `i`-th frame is called.
pub(super) fn windows<F>(
    run: Vec<F>,
    name: &dyn Fn(&F) -> String,
    period_us: &dyn Fn(&[F]) -> f64,
) -> Vec<RoomWindow<F>> {
    let run: Arc<[F]> = run.into();
    let starts = (0..run.len()).step_by(STEPS);
    let starts = starts.filter(|first| first + STEPS <= run.len());
    let window = |first: usize| RoomWindow {
        name: name(&run[first]),
        period_us: period_us(&run[first..first + STEPS]),
        run: Arc::clone(&run),
        first,
    };
    starts.map(window).collect()
}

/// A folder's name below `root`, as tables can hold it.
pub(super) fn folder_name(root: &Path, folder: &Path) -> String {
    let below = folder.strip_prefix(root).ok();
    let below = below.filter(|below| !below.as_os_str().is_empty());
    let name = below.or_else(|| folder.file_name().map(Path::new));
    let name = name.unwrap_or(folder).to_string_lossy();
    name.replace([',', '"', '\n', '\r'], "_")
}

impl<F: RoomFrame> RoomWindow<F> {
    /// The exposure: step centres lie on the frames, and the shutter is open for half a period
    /// more at either end. Light there comes from the neighbouring frames, where the run has them.
    ///
    /// # Errors
    /// [`EvalError`], naming the file that cannot be read or has another size.
    pub(super) fn scene(&self) -> Result<Scene, EvalError> {
        let fault = |fault: String| EvalError::Scene {
            scene: self.name.clone(),
            fault,
        };
        let before = usize::from(self.first > 0);
        let end = self.first + STEPS;
        let lit = &self.run[self.first - before..self.run.len().min(end + 1)];
        let parts = lit
            .iter()
            .map(|frame| {
                let picture = frame.picture()?;
                check_size(frame.picture_path(), picture.width(), picture.height())?;
                Ok(shrunk(&picture))
            })
            .collect::<Result<Vec<_>, EvalError>>()?;
        let size = Size::new(SIDE, SIDE)?;
        let footage = Footage::from_srgb(parts.iter().map(Vec::as_slice), size, self.period_us)
            .map_err(|error| fault(error.to_string()))?;
        let open = before as f64 - 0.5;
        let recipe = Synthesis::of_seed(seed_of(&self.name));
        let exposed = expose(&footage, open, open + STEPS as f64, &recipe)
            .map_err(|error| fault(error.to_string()))?;
        let mut truth = Vec::with_capacity(STEPS * size.pixels());
        for frame in &self.run[self.first..end] {
            let map = frame.depth()?;
            check_size(frame.depth_path(), map.width, map.height)?;
            let map = nearest(&map.depth_m);
            check_truth(frame.depth_path(), &map)?;
            truth.extend(map);
        }
        let voxel = voxels(&exposed.events, exposed.exposure_us, size);
        let voxel = voxel.map_err(|error| fault(error.to_string()))?;
        Ok(of_parts(&self.name, size, &exposed.blur, voxel, truth))
    }
}

/// A single frame as an exposure of a room that stands still: the picture is its own blur, nothing
/// fires, and all steps are scored on the same depth. Points are still drawn anew for every step.
///
/// # Errors
/// [`EvalError`], naming the file, when it has another size or no depth.
pub(super) fn still(
    name: &str,
    path: &Path,
    picture: &Canvas,
    depth: &DepthImage,
) -> Result<Scene, EvalError> {
    check_size(path, picture.width(), picture.height())?;
    check_size(path, depth.width, depth.height)?;
    let map = nearest(&depth.depth_m);
    check_truth(path, &map)?;
    let size = Size::new(SIDE, SIDE)?;
    let pixels = shrunk(picture);
    let plane = |channel: usize| pixels.iter().skip(channel).step_by(3).copied();
    let planes: Vec<u8> = (0..3).flat_map(plane).collect();
    let voxel = voxels(&[], STEPS as u32 * STILL_US, size).map_err(|error| EvalError::Scene {
        scene: name.to_owned(),
        fault: error.to_string(),
    })?;
    Ok(of_parts(name, size, &planes, voxel, map.repeat(STEPS)))
}

fn of_parts(name: &str, size: Size, blur: &[u8], voxel: Vec<f32>, depth: Vec<f32>) -> Scene {
    let sparse = (0_u64..)
        .zip(depth.chunks_exact(size.pixels()))
        .flat_map(|(step, truth)| points(truth, &mut Chance::of(&[DRAW, seed_of(name), step])))
        .collect();
    Scene {
        name: name.to_owned(),
        size,
        blur: blur.iter().map(|&code| f32::from(code) / 255.0).collect(),
        voxel,
        sparse,
        ground: None,
        depth,
        movers: Vec::new(),
        thin: Vec::new(),
        flow: Vec::new(),
        cap_m: CAP_M,
    }
}

/// A number that only the name decides (FNV-1a, 64 bits).
fn seed_of(name: &str) -> u64 {
    name.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
    })
}

fn check_size(path: &Path, width: usize, height: usize) -> Result<(), EvalError> {
    match (width, height) == (WIDTH, HEIGHT) {
        true => Ok(()),
        false => Err(fault_in(
            path,
            format!("is {width}x{height} pixels, wanted {WIDTH}x{HEIGHT}"),
        )),
    }
}

fn check_truth(path: &Path, map: &[f32]) -> Result<(), EvalError> {
    match map.iter().any(|depth| *depth > 0.0) {
        true => Ok(()),
        false => Err(fault_in(
            path,
            format!("has no depth within {CAP_M} m in its middle {SQUARE}x{SQUARE} pixels"),
        )),
    }
}

fn fault_in(path: &Path, fault: String) -> EvalError {
    let path = path.into();
    ReadError::Content { path, fault }.into()
}

/// Keeps [`POINTS`] pixels with depth, all equally likely; all of them where there are fewer.
fn points(truth: &[f32], chance: &mut Chance) -> Vec<f32> {
    let mut known: Vec<usize> = (0..truth.len()).filter(|&i| truth[i] > 0.0).collect();
    let mut sparse = vec![0.0; truth.len()];
    for drawn in 0..POINTS.min(known.len()) {
        let other = drawn + chance.below(known.len() - drawn);
        known.swap(drawn, other);
        sparse[known[drawn]] = truth[known[drawn]];
    }
    sparse
}

/// The middle square of a depth map, each pixel that of the map nearest to its centre; depth beyond
/// the cap, and what is no number, is none.
fn nearest(map: &[f32]) -> Vec<f32> {
    let at = |i: usize| (2 * i + 1) * SQUARE / (2 * SIDE);
    let (left, top) = ((WIDTH - SQUARE) / 2, (HEIGHT - SQUARE) / 2);
    let cell = |i: usize| map[(top + at(i / SIDE)) * WIDTH + left + at(i % SIDE)];
    let known = |depth: f32| match depth > 0.0 && depth <= CAP_M {
        true => depth,
        false => 0.0,
    };
    (0..SIDE * SIDE).map(|i| known(cell(i))).collect()
}

/// The middle square of a picture, `[H, W, 3]` sRGB: each pixel the mean light of the area under it.
fn shrunk(picture: &Canvas) -> Vec<u8> {
    let table = EncodingTable::new(Encoding::Srgb);
    let shares = shares();
    let (left, top) = ((WIDTH - SQUARE) / 2, (HEIGHT - SQUARE) / 2);
    // Rows first narrowed, then laid together.
    let mut narrow = vec![0.0_f32; SQUARE * SIDE * 3];
    for (row, out) in narrow.chunks_exact_mut(SIDE * 3).enumerate() {
        let start = 3 * ((top + row) * WIDTH + left);
        let codes = &picture.rgb()[start..start + 3 * SQUARE];
        for (pixel, (first, share)) in out.chunks_exact_mut(3).zip(&shares) {
            for (code, share) in codes[3 * first..].chunks_exact(3).zip(share) {
                for (sum, code) in pixel.iter_mut().zip(code) {
                    *sum += share * table.light(*code);
                }
            }
        }
    }
    let mut out = Vec::with_capacity(SIDE * SIDE * 3);
    let mut row = vec![0.0_f32; SIDE * 3];
    for (first, share) in &shares {
        row.fill(0.0);
        for (lights, share) in narrow[first * SIDE * 3..].chunks_exact(SIDE * 3).zip(share) {
            for (sum, light) in row.iter_mut().zip(lights) {
                *sum += share * light;
            }
        }
        out.extend(row.iter().map(|light| table.code(*light)));
    }
    out
}

/// For every pixel of a shrunk row the first pixel under it, and the shares of its light that come
/// from that one and those after it; they add up to 1.
fn shares() -> Vec<(usize, Vec<f32>)> {
    // In units of 1/SIDE of an old pixel, a new one is SQUARE long and an old one SIDE.
    let of_pixel = |i: usize| {
        let (start, end) = (i * SQUARE, (i + 1) * SQUARE);
        let (first, last) = (start / SIDE, end.div_ceil(SIDE));
        let under = |j: usize| end.min((j + 1) * SIDE) - start.max(j * SIDE);
        let share = |j: usize| under(j) as f32 / SQUARE as f32;
        (first, (first..last).map(share).collect())
    };
    (0..SIDE).map(of_pixel).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_of_a_row_use_every_pixel_once() {
        let mut used = vec![0.0_f64; SQUARE];
        for (first, share) in shares() {
            assert!((share.iter().sum::<f32>() - 1.0).abs() < 1e-6);
            for (used, share) in used[first..].iter_mut().zip(share) {
                *used += f64::from(share);
            }
        }
        let wanted = SIDE as f64 / SQUARE as f64;
        assert!(used.iter().all(|used| (used - wanted).abs() < 1e-6));
    }

    /// A lit pixel of a dark picture: its light is spread, none is lost.
    #[test]
    fn light_is_averaged_and_not_codes() {
        let mut picture = Canvas::new(WIDTH, HEIGHT, [0; 3]).expect("a picture");
        // Columns alternate black and white.
        for (i, pixel) in picture.rgb_mut().chunks_exact_mut(3).enumerate() {
            pixel.fill(if (i % WIDTH).is_multiple_of(2) {
                255
            } else {
                0
            });
        }
        let table = EncodingTable::new(Encoding::Srgb);
        let small = shrunk(&picture);
        let light: f32 = small.iter().map(|code| table.light(*code)).sum();
        assert!((light / small.len() as f32 - 0.5).abs() < 2e-3);
        // Old pixel 92 (white) counts whole, of pixel 93 (black) 25/32: white is 32/57 of the light.
        assert_eq!(small[0], table.code(32.0 / 57.0));
    }

    #[test]
    fn depth_is_that_of_the_pixel_under_the_centre() {
        let map: Vec<f32> = (0..WIDTH * HEIGHT).map(|i| i as f32 * 1e-5).collect();
        let small = nearest(&map);
        let at = |x: f64| (x * 456.0 / 256.0).floor();
        for (x, y) in [(0, 0), (255, 0), (3, 200), (128, 255)] {
            let (column, row) = (92.0 + at(x as f64 + 0.5), 12.0 + at(y as f64 + 0.5));
            let wanted = (row * 640.0 + column) * 1e-5;
            let found = f64::from(small[y * SIDE + x]);
            assert!((found - wanted).abs() < 1e-6, "{x} {y}: {found} {wanted}");
        }
        assert!(
            nearest(&vec![10.5; WIDTH * HEIGHT])
                .iter()
                .all(|d| *d == 0.0)
        );
        assert!(
            nearest(&vec![f32::NAN; WIDTH * HEIGHT])
                .iter()
                .all(|d| *d == 0.0)
        );
    }

    #[test]
    fn points_are_so_many_and_all_pixels_have_a_chance() {
        let truth: Vec<f32> = (0..2000)
            .map(|i| if i % 2 == 0 { 0.0 } else { 1.0 })
            .collect();
        let mut hits = vec![0_u32; truth.len()];
        for seed in 0..200 {
            let sparse = points(&truth, &mut Chance::of(&[seed]));
            assert_eq!(sparse.iter().filter(|d| **d > 0.0).count(), POINTS);
            for (hit, depth) in hits.iter_mut().zip(&sparse) {
                *hit += u32::from(*depth > 0.0);
            }
        }
        // Half of a thousand pixels, 200 times: 100 +- 7 each.
        let odd: Vec<u32> = hits.iter().skip(1).step_by(2).copied().collect();
        assert!(odd.iter().all(|n| (65..=135).contains(n)), "{odd:?}");
        let few = points(&truth[..100], &mut Chance::of(&[1]));
        assert_eq!(few, truth[..100]);
    }
}

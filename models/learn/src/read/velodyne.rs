//! Velodyne scans: `.bin` files, and the sparse depth maps that they make.

use std::path::Path;

use noctule_depth::Size;

use super::calibration::Calibration;
use super::error::ReadError;
use super::files;

/// Bytes of one point: x, y, z, reflectance, 32-bit floats, little endian.
const POINT_LEN: usize = 16;
/// Longest scan read, bytes; a turn of the HDL-64E has about 2 MB.
const SCAN_LEN_MAX: u64 = 64 << 20;

/// One measured point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScanPoint {
    /// x forward, y left, z up, metres, Velodyne frame.
    pub position_m: [f32; 3],
    /// 0 to 1.
    pub reflectance: f32,
}

impl ScanPoint {
    /// Angle above the scanner's horizon, radians.
    pub fn elevation(&self) -> f32 {
        let [x, y, z] = self.position_m;
        z.atan2(x.hypot(y))
    }

    /// Angle to the left of straight ahead, radians, -pi to pi.
    pub fn azimuth(&self) -> f32 {
        self.position_m[1].atan2(self.position_m[0])
    }
}

/// Reads a scan, its points in the file's order.
///
/// # Errors
/// [`ReadError`], when the file's length is no whole number of points, or a coordinate is no
/// finite number.
pub fn read_scan(path: &Path) -> Result<Vec<ScanPoint>, ReadError> {
    let bytes = files::bytes(path, SCAN_LEN_MAX)?;
    parse_scan(&bytes).map_err(|fault| ReadError::content(path, fault))
}

fn parse_scan(bytes: &[u8]) -> Result<Vec<ScanPoint>, String> {
    let (points, rest) = bytes.as_chunks::<POINT_LEN>();
    if !rest.is_empty() {
        let len = bytes.len();
        return Err(format!(
            "{len} bytes are no whole number of {POINT_LEN}-byte points"
        ));
    }
    let point = |(index, bytes): (usize, &[u8; POINT_LEN])| {
        let value = |at: usize| {
            f32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
        };
        let position_m = [value(0), value(4), value(8)];
        match position_m.iter().all(|x| x.is_finite()) {
            true => Ok(ScanPoint {
                position_m,
                reflectance: value(12),
            }),
            false => Err(format!("point {index} lies at {position_m:?}")),
        }
    };
    points.iter().enumerate().map(point).collect()
}

/// Draws points into a depth map, `[H, W]` in metres, 0 where there is none.
///
/// A point belongs to the pixel whose centre is nearest (half-way to the greater), and the nearest
/// point to the camera wins.
pub fn sparse_depth<'a>(
    points: impl IntoIterator<Item = &'a ScanPoint>,
    calibration: &Calibration,
    size: Size,
) -> Vec<f32> {
    let mut map = vec![0.0_f32; size.pixels()];
    let column = |at: f64, len: usize| {
        let cell = (at + 0.5).floor();
        (0.0..len as f64).contains(&cell).then_some(cell as usize)
    };
    for point in points {
        let Some(found) = calibration.project(point.position_m) else {
            continue;
        };
        let cell = (
            column(found.u, size.width()),
            column(found.v, size.height()),
        );
        if let (Some(x), Some(y)) = cell {
            let held = &mut map[y * size.width() + x];
            let depth = found.depth_m as f32;
            if *held == 0.0 || depth < *held {
                *held = depth;
            }
        }
    }
    map
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Forward is depth, one pixel per degree of slope times 100.
    fn plain() -> Calibration {
        let rotation = [0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0, 0.0];
        let identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        let projection = [
            100.0, 0.0, 2.0, 0.0, 0.0, 100.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0,
        ];
        Calibration::new(projection, identity, rotation, [0.0; 3])
    }

    fn at(x: f32, y: f32, z: f32) -> ScanPoint {
        ScanPoint {
            position_m: [x, y, z],
            reflectance: 0.0,
        }
    }

    #[test]
    fn the_nearest_point_of_a_pixel_wins_and_the_rest_falls_nowhere() {
        let points = [
            at(10.0, 0.0, 0.0),       // column 2, row 1
            at(5.0, 0.0, 0.0),        // the same, nearer
            at(7.0, 0.0, 0.0),        // the same, farther again
            at(12.5, 0.1875, 0.0625), // column 0.5, row 0.5: rounded up
            at(-5.0, 0.0, 0.0),       // behind
            at(0.0, 1.0, 0.0),        // beside, at no depth
            at(10.0, 5.0, 0.0),       // far to the left
        ];
        let map = sparse_depth(&points, &plain(), Size::new(4, 3).expect("a size"));
        let mut expected = [0.0; 12];
        expected[4 + 2] = 5.0;
        expected[4 + 1] = 12.5;
        assert_eq!(map, expected);
    }

    #[test]
    fn a_torn_scan_is_refused() {
        let error = parse_scan(&[0; 33]).expect_err("two points and a byte");
        assert_eq!(error, "33 bytes are no whole number of 16-byte points");
        let mut bytes = [0; 32];
        bytes[16..20].copy_from_slice(&f32::NAN.to_le_bytes());
        let error = parse_scan(&bytes).expect_err("no place");
        assert_eq!(error, "point 1 lies at [NaN, 0.0, 0.0]");
        assert_eq!(parse_scan(&[]), Ok(Vec::new()));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn no_bytes_make_a_scan_panic(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
            if let Ok(points) = parse_scan(&bytes) {
                prop_assert_eq!(points.len() * POINT_LEN, bytes.len());
                let size = Size::new(20, 10).expect("a size");
                let map = sparse_depth(&points, &plain(), size);
                prop_assert!(map.iter().all(|d| *d >= 0.0 && d.is_finite()));
            }
        }
    }
}

//! Which laser measured which point, for scoring on rings that were held back.

use std::f32::consts::PI;

use super::velodyne::ScanPoint;

/// Lasers of the HDL-64E.
pub const RINGS: usize = 64;
/// Rounds of Lloyd's algorithm at most; real scans settle within thirty or so.
const ROUNDS_MAX: usize = 200;
/// A ring has begun to end once it is this far to the right of straight ahead, radians.
const RIGHT: f32 = 0.05;

/// Clusters points by elevation into [`RINGS`] groups; 0 is the lowest.
///
/// One-dimensional k-means from equal quantiles: the same points give the same groups. The lasers
/// of an HDL-64E do not start at one point, so near things of one laser can fall to a neighbour's
/// group. A scan of fewer points than groups leaves groups empty.
pub fn rings_by_elevation(points: &[ScanPoint]) -> Vec<u8> {
    let elevation: Vec<f64> = points.iter().map(|p| f64::from(p.elevation())).collect();
    let mut sorted = elevation.clone();
    sorted.sort_unstable_by(f64::total_cmp);
    let edges = edges(&sorted);
    let ring = |e: &f64| edges.partition_point(|edge| edge <= e);
    elevation
        .iter()
        .map(|e| u8::try_from(ring(e)).unwrap_or(u8::MAX)) // 64 at most
        .collect()
}

/// The borders between clusters of sorted values, ascending.
fn edges(sorted: &[f64]) -> Vec<f64> {
    let mut sums = vec![0.0];
    let mut sum = 0.0;
    sums.extend(sorted.iter().map(|value| {
        sum += value;
        sum
    }));
    let mut starts: Vec<usize> = (0..=RINGS).map(|i| i * sorted.len() / RINGS).collect();
    let mut edges = Vec::new();
    for _ in 0..ROUNDS_MAX {
        let centres = starts
            .windows(2)
            .filter(|range| range[0] < range[1])
            .map(|range| (sums[range[1]] - sums[range[0]]) / (range[1] - range[0]) as f64);
        let centres: Vec<f64> = centres.collect();
        edges = centres.windows(2).map(|c| 0.5 * (c[0] + c[1])).collect();
        let inner = edges.iter().map(|e| sorted.partition_point(|v| v < e));
        let moved: Vec<usize> = std::iter::once(0)
            .chain(inner)
            .chain([sorted.len()])
            .collect();
        if moved == starts {
            break;
        }
        starts = moved;
    }
    edges
}

/// Counts rings as the files of KITTI's raw drives store them: laser after laser from the top,
/// each starting straight ahead and turning left; 0 is the topmost.
///
/// Files whose points were reordered give nonsense; saturates at 255.
pub fn rings_by_order(points: &[ScanPoint]) -> Vec<u8> {
    let mut ring = 0_u8;
    let mut is_ending = false;
    points
        .iter()
        .map(|point| {
            let azimuth = point.azimuth();
            if is_ending && (0.0..0.5 * PI).contains(&azimuth) {
                ring = ring.saturating_add(1);
                is_ending = false;
            }
            is_ending |= azimuth < -RIGHT;
            ring
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A turn of a scanner whose lasers share one origin, ring after ring from the top.
    fn turn(lasers: u8, columns: u16) -> Vec<(u8, ScanPoint)> {
        let mut points = Vec::new();
        for laser in 0..lasers {
            let elevation = (2.0 - 0.4 * f32::from(laser)).to_radians();
            for column in 0..columns {
                let azimuth = (f32::from(column) + 0.5) / f32::from(columns) * 2.0 * PI;
                let range = 5.0 + f32::from(column % 7) * 3.0;
                let flat = range * elevation.cos();
                let position_m = [
                    flat * azimuth.cos(),
                    flat * azimuth.sin(),
                    range * elevation.sin(),
                ];
                let reflectance = 0.5;
                points.push((
                    laser,
                    ScanPoint {
                        position_m,
                        reflectance,
                    },
                ));
            }
        }
        points
    }

    #[test]
    fn lasers_of_one_origin_are_told_apart_by_either_rule() {
        let (lasers, points): (Vec<u8>, Vec<ScanPoint>) = turn(64, 90).into_iter().unzip();
        assert_eq!(rings_by_order(&points), lasers);
        let from_below: Vec<u8> = lasers.iter().map(|laser| 63 - laser).collect();
        assert_eq!(rings_by_elevation(&points), from_below);
    }

    #[test]
    fn odd_scans_have_rings_too() {
        assert!(rings_by_elevation(&[]).is_empty() && rings_by_order(&[]).is_empty());
        let (lasers, few): (Vec<u8>, Vec<ScanPoint>) = turn(5, 2).into_iter().unzip();
        let rings = rings_by_elevation(&few);
        for (pair, laser) in rings.windows(2).zip(lasers.windows(2)) {
            assert!(
                pair[0] >= pair[1] && (laser[0] == laser[1] || pair[0] > pair[1]),
                "{rings:?}"
            );
        }
        let same = vec![few[0]; 100];
        let rings = rings_by_elevation(&same);
        assert!(rings.iter().all(|ring| *ring == rings[0]), "{rings:?}");
    }
}

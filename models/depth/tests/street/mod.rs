//! A made-up street, ray-cast exactly: dense truth and what a 64-channel LiDAR would return of it.
//!
//! Camera frame: x right, y down, z forward, metres. The camera stands 1.5 m above the road.
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "pixels of a small map, checked to lie inside"
)]

/// Pixels of a side of the maps.
pub const SIDE: usize = 256;
/// Focal length for a field of view of 52 degrees, pixels.
const FOCAL_PX: f64 = 262.4;
const CAMERA_HEIGHT_M: f64 = 1.5;
/// The LiDAR sits above and behind the camera.
const LIDAR: [f64; 3] = [0.0, -0.25, -0.10];
/// Range noise of the LiDAR, standard deviation in metres.
const NOISE_M: f64 = 0.03;

/// Upright box: `[x0, x1], [y0, y1], [z0, z1]` with its share of light sent back.
struct Block {
    low: [f64; 3],
    high: [f64; 3],
    albedo: f64,
}

/// Upright cylinder from the road up.
struct Pole {
    x: f64,
    z: f64,
    radius: f64,
    height: f64,
}

/// A street with its random numbers.
pub struct Street {
    blocks: Vec<Block>,
    poles: Vec<Pole>,
    random: Random,
}

impl Street {
    /// Facades on both sides, cars, pedestrians and poles, all drawn from `seed`.
    pub fn new(seed: u64) -> Self {
        let mut random = Random(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1);
        let mut blocks = Vec::new();
        for side in [-1.0, 1.0] {
            let mut z = random.between(2.0, 10.0);
            while z < 90.0 {
                let length = random.between(6.0, 18.0);
                let near = random.between(6.0, 12.0);
                let top = CAMERA_HEIGHT_M - random.between(4.0, 12.0);
                let xs = if side < 0.0 {
                    [-near - 8.0, -near]
                } else {
                    [near, near + 8.0]
                };
                blocks.push(Block {
                    low: [xs[0], top, z],
                    high: [xs[1], CAMERA_HEIGHT_M, z + length],
                    albedo: random.between(0.1, 0.4),
                });
                z += length + random.between(0.0, 8.0);
            }
        }
        for _ in 0..2 + (random.unit() * 5.0) as usize {
            let (x, z) = (random.between(-5.0, 5.0), random.between(5.0, 45.0));
            for (inset, bottom, top) in [(0.0, 1.5, 0.6), (0.9, 0.6, 0.0)] {
                blocks.push(Block {
                    low: [x - 0.9, top, z + inset],
                    high: [x + 0.9, bottom, z + 4.2 - inset],
                    albedo: 0.3,
                });
            }
        }
        let poles = (0..10)
            .map(|index| Pole {
                x: random.between(-6.0, 6.0),
                z: random.between(4.0, 40.0),
                radius: if index % 2 == 0 {
                    0.07
                } else {
                    random.between(0.2, 0.3)
                },
                height: if index % 2 == 0 { 4.5 } else { 1.75 },
            })
            .collect();
        Self {
            blocks,
            poles,
            random,
        }
    }

    /// Exact depth (z) of every pixel, 0 beyond 80 m and in the sky.
    pub fn truth(&self) -> Vec<f32> {
        let mut depth = Vec::with_capacity(SIDE * SIDE);
        for row in 0..SIDE {
            for column in 0..SIDE {
                let direction = [slope(column), slope(row), 1.0];
                let hit = self.cast([0.0; 3], direction).map(|(z, _)| z);
                depth.push(hit.filter(|&z| z <= 80.0).unwrap_or(0.0) as f32);
            }
        }
        depth
    }

    /// Projected returns of one turn, nearest wins: 64 channels 1.45 degrees apart, 600 columns.
    pub fn sparse(&mut self) -> Vec<f32> {
        let mut sparse = vec![0.0_f32; SIDE * SIDE];
        for channel in 0..64 {
            let elevation = (f64::from(channel) - 31.5) * 1.45_f64.to_radians();
            for column in -75..75 {
                let azimuth =
                    (f64::from(column) * 0.6 + f64::from(channel % 4) * 0.15).to_radians();
                let direction = [
                    elevation.cos() * azimuth.sin(),
                    -elevation.sin(),
                    elevation.cos() * azimuth.cos(),
                ];
                let Some((range, albedo)) = self.cast(LIDAR, direction) else {
                    continue;
                };
                // Chance of a return: half at 32 m on 10 % albedo.
                let half_range = 32.0 * (albedo / 0.1).sqrt();
                let chance = 1.0 / (1.0 + ((range - half_range) / (0.1 * half_range)).exp());
                if range > 60.0 || self.random.unit() > chance {
                    continue;
                }
                let range = range + NOISE_M * self.random.normal();
                let point: [f64; 3] = std::array::from_fn(|i| LIDAR[i] + range * direction[i]);
                splat(&mut sparse, point);
            }
        }
        sparse
    }

    /// First surface along a ray: its parameter and albedo.
    fn cast(&self, from: [f64; 3], direction: [f64; 3]) -> Option<(f64, f64)> {
        let road = (CAMERA_HEIGHT_M - from[1]) / direction[1];
        let mut nearest = (road > 0.0).then_some((road, 0.1));
        let mut offer = |hit: Option<f64>, albedo: f64| {
            if let Some(t) = hit.filter(|&t| nearest.is_none_or(|(best, _)| t < best)) {
                nearest = Some((t, albedo));
            }
        };
        for block in &self.blocks {
            offer(block.hit(from, direction), block.albedo);
        }
        for pole in &self.poles {
            offer(pole.hit(from, direction), 0.25);
        }
        nearest
    }
}

impl Block {
    fn hit(&self, from: [f64; 3], direction: [f64; 3]) -> Option<f64> {
        let (mut enter, mut leave) = (1e-3_f64, f64::INFINITY);
        for axis in 0..3 {
            let a = (self.low[axis] - from[axis]) / direction[axis];
            let b = (self.high[axis] - from[axis]) / direction[axis];
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        (enter < leave && enter > 1e-3).then_some(enter)
    }
}

impl Pole {
    fn hit(&self, from: [f64; 3], direction: [f64; 3]) -> Option<f64> {
        let (dx, dz) = (from[0] - self.x, from[2] - self.z);
        let a = direction[0] * direction[0] + direction[2] * direction[2];
        let b = dx * direction[0] + dz * direction[2];
        let c = dx * dx + dz * dz - self.radius * self.radius;
        let root = (b * b - a * c).sqrt();
        let t = (-b - root) / a;
        let y = from[1] + t * direction[1];
        (t > 1e-3 && y > CAMERA_HEIGHT_M - self.height).then_some(t)
    }
}

fn slope(pixel: usize) -> f64 {
    (pixel as f64 - (SIDE as f64 / 2.0 - 0.5)) / FOCAL_PX
}

fn splat(sparse: &mut [f32], point: [f64; 3]) {
    if point[2] < 0.1 {
        return;
    }
    let pixel = |value: f64| (value / point[2] * FOCAL_PX + SIDE as f64 / 2.0 - 0.5).round();
    let (column, row) = (pixel(point[0]), pixel(point[1]));
    let inside = 0.0..SIDE as f64;
    if inside.contains(&column) && inside.contains(&row) {
        let slot = &mut sparse[row as usize * SIDE + column as usize];
        if *slot == 0.0 || point[2] < f64::from(*slot) {
            *slot = point[2] as f32;
        }
    }
}

/// Xorshift numbers: enough for a street.
struct Random(u64);

impl Random {
    fn unit(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.unit()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.unit()).cos()
    }
}

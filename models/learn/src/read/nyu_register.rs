//! NYU Depth v2's raw depth as its colour camera would have seen it.
//!
//! The two cameras of the Kinect stand 25 mm apart and have lenses of different length: without
//! this step depth and picture disagree by up to 12 % of the distance from the middle. Numbers are
//! those of the data set's toolbox (`camera_params.m`), and as there a pixel keeps the depth along
//! the depth camera's axis, which is parallel to the other to 0.4 degrees. Other than there the
//! picture stays as it was taken: points are projected through the colour camera's distortion.

use std::sync::OnceLock;

use noctule_depth::DepthImage;

/// Columns of both cameras.
pub(super) const WIDTH: usize = 640;
/// Rows of both cameras.
pub(super) const HEIGHT: usize = 480;

/// A lens: focal lengths and principal point in pixels, and Brown's distortion k1, k2, p1, p2, k3.
struct Lens {
    focal: [f64; 2],
    centre: [f64; 2],
    distortion: [f64; 5],
}

const COLOUR: Lens = Lens {
    focal: [518.857_901_174_501_9, 519.469_611_121_274_9],
    centre: [325.582_449_411_190_3, 253.736_166_334_004_65],
    distortion: [
        0.207_966_153_188_090_6,
        -0.586_138_251_639_117_8,
        7.223_136_313_588_833e-4,
        1.047_962_719_576_518e-3,
        0.498_569_866_847_051_07,
    ],
};

const DEPTH: Lens = Lens {
    focal: [582.624_481_677_379_6, 582.691_032_709_886_4],
    centre: [313.044_758_708_047_3, 238.443_896_266_203_86],
    distortion: [
        -0.099_897_236_553_084_48,
        0.390_653_246_027_653_44,
        1.929_059_287_022_927_7e-3,
        -1.942_202_247_597_505_5e-3,
        -0.510_317_250_534_005_8,
    ],
};

/// From the depth camera's frame to the colour camera's: x right, y down, z forward. The toolbox
/// writes its negative, and the translation after it with the other sign.
const ROTATION: [[f64; 3]; 3] = [
    [
        0.999_977_989_408_292_6,
        -5.035_991_948_081_099e-3,
        -4.319_662_492_306_024e-3,
    ],
    [
        5.051_841_938_615_745e-3,
        0.999_980_518_611_44,
        3.666_236_574_848_48e-3,
    ],
    [
        4.301_115_201_411_869e-3,
        -3.687_978_130_951_421_8e-3,
        0.999_983_949_483_855_4,
    ],
];

/// Where the colour camera stands, metres; the toolbox applies its `t_z` across and `t_y` along.
const COLOUR_AT: [f64; 3] = [
    0.025_031_875_059_141_3,
    -2.934_231_293_584_641e-4,
    6.623_874_700_833_01e-4,
];

impl Lens {
    /// Where a ray (x and y at z = 1) falls after distortion, x and y at z = 1.
    fn distorted(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [k1, k2, p1, p2, k3] = self.distortion;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ]
    }

    /// The ray through a pixel: fixed-point iteration on the distortion, which is small.
    fn ray(&self, pixel: [f64; 2]) -> [f64; 2] {
        let seen: [f64; 2] = std::array::from_fn(|i| (pixel[i] - self.centre[i]) / self.focal[i]);
        (0..20).fold(seen, |ray, _| {
            let bent = self.distorted(ray);
            std::array::from_fn(|i| ray[i] + seen[i] - bent[i])
        })
    }

    fn pixel(&self, ray: [f64; 2]) -> [f64; 2] {
        let bent = self.distorted(ray);
        std::array::from_fn(|i| bent[i] * self.focal[i] + self.centre[i])
    }
}

/// The ray of every pixel of the depth camera.
fn rays() -> &'static [[f64; 2]] {
    static RAYS: OnceLock<Vec<[f64; 2]>> = OnceLock::new();
    RAYS.get_or_init(|| {
        let pixels = (0..WIDTH * HEIGHT).map(|i| [(i % WIDTH) as f64, (i / WIDTH) as f64]);
        pixels.map(|pixel| DEPTH.ray(pixel)).collect()
    })
}

/// Where in the colour camera's picture a point at `depth_m` along `ray` falls.
fn place(ray: [f64; 2], depth_m: f64) -> [f64; 2] {
    let point = [ray[0] * depth_m, ray[1] * depth_m, depth_m];
    let [x, y, z]: [f64; 3] = std::array::from_fn(|i| {
        let turned: f64 = ROTATION[i].iter().zip(point).map(|(r, p)| r * p).sum();
        turned - COLOUR_AT[i]
    });
    COLOUR.pixel([x / z, y / z])
}

/// A depth map in the colour camera's pixels, nearest point wins; pixels that none falls on are 0.
/// A map of another size than 640 x 480 is no map of this camera and given back as it is.
pub(crate) fn registered(map: DepthImage) -> DepthImage {
    if (map.width, map.height) != (WIDTH, HEIGHT) {
        return map;
    }
    let mut out = vec![0.0_f32; WIDTH * HEIGHT];
    for (depth, ray) in map.depth_m.iter().zip(rays()) {
        if *depth <= 0.0 {
            continue;
        }
        let [x, y] = place(*ray, f64::from(*depth)).map(f64::round);
        if (0.0..WIDTH as f64).contains(&x) && (0.0..HEIGHT as f64).contains(&y) {
            let held = &mut out[y as usize * WIDTH + x as usize];
            if *held == 0.0 || *depth < *held {
                *held = *depth;
            }
        }
    }
    DepthImage {
        depth_m: out,
        ..map
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_are_the_inverse_of_the_lens() {
        for lens in [&COLOUR, &DEPTH] {
            for pixel in [[0.0, 0.0], [320.0, 240.0], [639.0, 100.0], [200.0, 479.0]] {
                let back = lens.pixel(lens.ray(pixel));
                let away = (back[0] - pixel[0]).hypot(back[1] - pixel[1]);
                assert!(away < 0.05, "{pixel:?} comes back as {back:?}");
            }
        }
        for (i, row) in ROTATION.iter().enumerate() {
            for (j, other) in ROTATION.iter().enumerate() {
                let dot: f64 = row.iter().zip(other).map(|(a, b)| a * b).sum();
                assert!((dot - f64::from(u8::from(i == j))).abs() < 1e-9);
            }
        }
    }

    /// In the middle, where lenses do not bend: the shift is the base line over the distance, and
    /// away from it lengths shrink by the ratio of the focal lengths.
    #[test]
    fn the_base_line_shifts_and_the_lens_shrinks() {
        let at = |x: f64, depth| place(DEPTH.ray([x, 240.0]), depth)[0];
        let shift = at(313.0, 1.0) - at(313.0, 5.0);
        let wanted = -0.025_03 * 518.86 * (1.0 - 0.2);
        assert!((shift - wanted).abs() < 0.3, "{shift} {wanted}");
        let ratio = (at(363.0, 3.0) - at(263.0, 3.0)) / 100.0;
        assert!((ratio - 518.86 / 582.62).abs() < 0.01, "{ratio}");
    }

    #[test]
    fn a_wall_stays_a_wall_and_what_is_near_hides_it() {
        let map = |depth_m| DepthImage {
            width: WIDTH,
            height: HEIGHT,
            depth_m,
        };
        let mut depth = vec![3.0_f32; WIDTH * HEIGHT];
        for row in 200..280 {
            depth[row * WIDTH + 280..][..80].fill(1.0);
        }
        let seen = registered(map(depth));
        assert!(seen.depth_m.iter().all(|d| [0.0, 1.0, 3.0].contains(d)));
        let [x, y] = place(DEPTH.ray([320.0, 240.0]), 1.0).map(|p| p as usize);
        assert_eq!(seen.depth_m[y * WIDTH + x], 1.0);
        // The picture's middle is covered; few pixels of it miss every point.
        let middle = (100..400).flat_map(|row| &seen.depth_m[row * WIDTH + 100..][..440]);
        let holes = middle.clone().filter(|d| **d == 0.0).count();
        assert!(holes * 20 < middle.count(), "{holes} holes");
        let small = DepthImage {
            width: 1,
            height: 1,
            depth_m: vec![2.0],
        };
        assert_eq!(registered(small.clone()), small);
    }
}

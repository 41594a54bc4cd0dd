//! One training or evaluation sample: everything the sensors saw of one exposure, and the truth.

use noctule_raster::RasterError;
use noctule_recording::Calibration;
use noctule_sensor::{Event, Lidar, Motion, Return, Stamp, Tai};

use crate::camera::{Camera, Light};
use crate::events::{EventSimulator, PixelModel};
use crate::lidar::{self, Scanner};
use crate::optics::Optics;
use crate::render::{Frame, render};
use crate::scene::Scene;
use crate::shutter::{Opening, STEPS, Shutter, Tier, sub_frames};
use crate::snapshot::{Horizon, Snapshot};
use crate::{sparse, truth};

/// Sub-frames before the exposure that bring the event pixels into their state.
pub(crate) const WARM_UP: usize = 8;
/// The LiDAR is heard from this long before the exposure: two turns and a bit.
const LIDAR_LEAD_NS: u64 = 250_000_000;
/// Vehicle motion is reported every 10 ms.
const MOTION_PERIOD_NS: u64 = 10_000_000;

/// One exposure's worth of sensor data with exact truth.
///
/// All stamps, whatever their clock type says, are true time since the drive's start: a rig with
/// perfect clocks and no delays. `T` is 8, `H = W = size`.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample {
    /// Width and height, pixels.
    pub size: usize,
    /// The exposure.
    pub opening: Opening,
    /// Rendered instants within the exposure.
    pub sub_frames: usize,
    /// The noisy long exposure, `[3, H, W]`, gamma 1/2.2, 8 bit.
    pub blur: Vec<u8>,
    /// Electrons shown as white in `blur` and `sharp`.
    pub white_electrons: f32,
    /// Median noise-free electrons per pixel and channel of the long exposure.
    pub median_electrons: f32,
    /// Events of the exposure in order, in pixels of this grid; whole microseconds.
    pub events: Vec<Event>,
    /// LiDAR returns around the camera's view, from a quarter of a second before the exposure.
    pub returns: Vec<Return>,
    /// Every firing of the LiDAR over that time: when, and its raw azimuth in hundredths of a
    /// degree.
    pub firings: Vec<(Stamp<Lidar>, u16)>,
    /// The LiDAR's depth at the step centres, `[T, H, W]`, metres; 0 where there is none. Drawn
    /// by the vehicle's own code from `returns`, `firings` and `motion`.
    pub sparse: Vec<f32>,
    /// Speed and yaw rate at 100 Hz over that time, noise-free.
    pub motion: Vec<Motion>,
    /// Depth at the step centres, `[T, H, W]`, metres along the optical axis; 0 is sky.
    pub depth: Vec<f32>,
    /// Noise-free images at the step centres at the blur's brightness, `[T, 3, H, W]`, gamma
    /// 1/2.2, 8 bit.
    pub sharp: Vec<u8>,
    /// Motion of each pixel from one step centre to the next, `[T - 1, 2, H, W]`, pixels right
    /// and down.
    pub flow: Vec<f32>,
    /// 1 where something moves on its own, `[T, H, W]`.
    pub movers: Vec<u8>,
    /// 1 on objects narrower than 0.3 m, `[T, H, W]`.
    pub thin: Vec<u8>,
}

impl Sample {
    /// The first complete exposure after 1 s of the drive with this seed and tier, on a grid of
    /// `size` by `size` pixels.
    ///
    /// # Panics
    /// When `size` is not a multiple of 16 or exceeds 2048.
    #[must_use]
    pub fn render(seed: u64, tier: Tier, size: usize) -> Self {
        Self::of_exposure(
            seed,
            tier,
            Shutter::new(seed, tier).first_from(1_000_000_000),
            size,
        )
    }

    /// Any exposure of a drive.
    ///
    /// # Panics
    /// As [`render`](Self::render).
    #[must_use]
    pub fn of_exposure(seed: u64, tier: Tier, opening: Opening, size: usize) -> Self {
        let scene = Scene::new(seed, opening.at(1.0), tier.drives());
        let optics = Optics::new(size);
        let film = Film::shoot(seed, &scene, &opening, &optics);
        let camera = Camera::new(seed);
        let electrons = Camera::expose(&film.mean, size, opening.seconds());
        let white_electrons = camera.white(&electrons);
        let truth = Truth::of_steps(&scene, &opening, &optics, &film.steps, white_electrons);
        let (returns, firings) = listen(seed, &scene, &opening);
        let motion = motion(&scene, &opening);
        let sparse = sparse_depth(&optics, &opening, &returns, &firings, &motion)
            .expect("the default rig's beams meet the image and its motion is known throughout");
        Self {
            size,
            opening,
            sub_frames: film.sub_frames,
            blur: camera.develop(&electrons, white_electrons, size, opening.index),
            white_electrons,
            median_electrons: median(&electrons),
            events: film.events,
            returns,
            firings,
            sparse,
            motion,
            depth: truth.depth,
            sharp: truth.sharp,
            flow: truth.flow,
            movers: truth.movers,
            thin: truth.thin,
        }
    }
}

fn median(electrons: &Light) -> f32 {
    let mut all = electrons.concat();
    let middle = all.len() / 2;
    *all.select_nth_unstable_by(middle, f32::total_cmp).1
}

/// What one exposure leaves on film and in the event camera.
pub(crate) struct Film {
    pub sub_frames: usize,
    /// Mean radiance over the exposure.
    pub mean: Light,
    /// Events with open <= t < close.
    pub events: Vec<Event>,
    /// The frames at the step centres.
    pub steps: Vec<Frame>,
}

impl Film {
    /// Renders warm-up, exposure and one instant beyond it, and lets both cameras look on.
    fn shoot(seed: u64, scene: &Scene, opening: &Opening, optics: &Optics) -> Self {
        let count = sub_frames(scene, opening, optics);
        let per_step = count / STEPS;
        let size = optics.size;
        let mut pixels = EventSimulator::new(size, size, PixelModel::of_seed(seed), seed);
        let mut film = Self {
            sub_frames: count,
            mean: Frame::new(size).rgb,
            events: Vec::new(),
            steps: Vec::with_capacity(STEPS),
        };
        let mut frame = Frame::new(size);
        for i in 0..WARM_UP + count + 1 {
            let share = (i as f64 + 0.5 - WARM_UP as f64) / count as f64;
            let t = opening.at(share);
            render(
                scene,
                &Snapshot::new(scene, t, Horizon::CAMERA),
                optics,
                &mut frame,
            );
            pixels.step(&frame.luma, t * 1e6, &mut film.events);
            let Some(inside) = i.checked_sub(WARM_UP).filter(|&i| i < count) else {
                continue;
            };
            accumulate(&mut film.mean, &frame.rgb, 1.0 / count as f32);
            if inside % per_step == per_step / 2 {
                film.steps.push(frame.clone());
            }
        }
        let (open, close) = (opening.open_ns, opening.close_ns);
        film.events
            .retain(|event| (open..close).contains(&event.t.as_nanos()));
        // Two intervals may share the microsecond in which they meet.
        film.events.sort_by_key(|event| (event.t, event.y, event.x));
        film
    }
}

/// Adds `share` of a frame to a sum of light.
pub(crate) fn accumulate(sum: &mut Light, light: &Light, share: f32) {
    for (plane, add) in sum.iter_mut().zip(light) {
        for (cell, value) in plane.iter_mut().zip(add) {
            *cell += share * value;
        }
    }
}

/// Truth of one exposure on one grid; shapes as in [`Sample`].
pub(crate) struct Truth {
    pub depth: Vec<f32>,
    pub sharp: Vec<u8>,
    pub flow: Vec<f32>,
    pub movers: Vec<u8>,
    pub thin: Vec<u8>,
}

impl Truth {
    /// From the frames at the step centres.
    pub(crate) fn of_steps(
        scene: &Scene,
        opening: &Opening,
        optics: &Optics,
        steps: &[Frame],
        white: f32,
    ) -> Self {
        let mut all = Self {
            depth: Vec::new(),
            sharp: Vec::new(),
            flow: Vec::new(),
            movers: Vec::new(),
            thin: Vec::new(),
        };
        for (k, frame) in steps.iter().enumerate() {
            all.depth.extend_from_slice(&frame.depth);
            let electrons = Camera::expose(&frame.rgb, frame.size, opening.seconds());
            all.sharp
                .append(&mut Camera::develop_clean(&electrons, white));
            all.movers
                .append(&mut truth::mask(scene, frame, Scene::is_mover));
            all.thin
                .append(&mut truth::mask(scene, frame, Scene::is_thin));
            if k + 1 < steps.len() {
                let (from, to) = (opening.step_centre(k), opening.step_centre(k + 1));
                all.flow
                    .append(&mut truth::flow(scene, frame, optics, from, to));
            }
        }
        all
    }
}

type Firing = (Stamp<Lidar>, u16);

/// What the LiDAR says from before the exposure to its end.
fn listen(seed: u64, scene: &Scene, opening: &Opening) -> (Vec<Return>, Vec<Firing>) {
    let start = opening.open_ns.saturating_sub(LIDAR_LEAD_NS);
    let heard: Vec<u64> = (lidar::first_column_from(start)..)
        .take_while(|&index| lidar::fire_ns(index, lidar::CHANNELS - 1) < opening.close_ns)
        .collect();
    let firings = heard
        .iter()
        .map(|&index| {
            (
                Stamp::from_nanos(lidar::fire_ns(index, 0)),
                lidar::azimuth_cdeg(index),
            )
        })
        .collect();
    let seen: Vec<u64> = heard
        .into_iter()
        .filter(|&i| lidar::sees_camera_view(i))
        .collect();
    let columns =
        Scanner::new(seed, Calibration::default_rig().camera_from_lidar)
            .scan(scene, &seen, |ns| ns as f64 * 1e-9);
    let mut returns = Vec::new();
    columns
        .iter()
        .for_each(|column| column.append_returns(0, &mut returns));
    (returns, firings)
}

fn motion(scene: &Scene, opening: &Opening) -> Vec<Motion> {
    let first = opening
        .open_ns
        .saturating_sub(LIDAR_LEAD_NS + MOTION_PERIOD_NS)
        / MOTION_PERIOD_NS;
    (first..=opening.close_ns.div_ceil(MOTION_PERIOD_NS))
        .map(|i| {
            let t_ns = i * MOTION_PERIOD_NS;
            let (speed, yaw_rate) = scene.ego_motion(t_ns as f64 * 1e-9);
            Motion {
                t: Stamp::from_nanos(t_ns),
                speed_mps: speed as f32,
                yaw_rate_rps: yaw_rate as f32,
            }
        })
        .collect()
}

/// Sparse depth at the step centres, `[T, H, W]`.
fn sparse_depth(
    optics: &Optics,
    opening: &Opening,
    returns: &[Return],
    firings: &[Firing],
    motion: &[Motion],
) -> Result<Vec<f32>, RasterError> {
    let mut raster = sparse::drawer(&Calibration::default_rig(), optics)?;
    let true_time = |ns: u64| Stamp::<Tai>::from_nanos(ns);
    for sample in motion {
        raster.push_motion(
            true_time(sample.t.as_nanos()),
            sample.speed_mps,
            sample.yaw_rate_rps,
        )?;
    }
    let mut rest = returns;
    for (index, &(at, azimuth_cdeg)) in firings.iter().enumerate() {
        raster.note_block(true_time(at.as_nanos()), u32::from(azimuth_cdeg));
        let end = firings.get(index + 1).map_or(Stamp::MAX, |next| next.0);
        let (now, later) = rest.split_at(rest.partition_point(|echo| echo.t < end));
        for echo in now {
            raster.push_return(true_time(echo.t.as_nanos()), echo);
        }
        rest = later;
    }
    let centre = |k: usize| true_time((opening.step_centre(k) * 1e9).round() as u64);
    sparse::draw(&mut raster, (0..STEPS).map(centre))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Light adds up: developing the mean of all sub-frames is the mean of developing each.
    #[test]
    fn the_noise_free_blur_is_the_mean_of_sharp_frames_in_linear_light() {
        let (seed, size) = (6, 64);
        let opening = Shutter::new(seed, Tier::A).opening(2);
        let (scene, optics) = (Scene::new(seed, 2.0, true), Optics::new(size));
        let film = Film::shoot(seed, &scene, &opening, &optics);
        let blur = Camera::expose(&film.mean, size, opening.seconds());
        let mut mean = Frame::new(size).rgb;
        let mut frame = Frame::new(size);
        for i in 0..film.sub_frames {
            let t = opening.at((i as f64 + 0.5) / film.sub_frames as f64);
            render(
                &scene,
                &Snapshot::new(&scene, t, Horizon::CAMERA),
                &optics,
                &mut frame,
            );
            let sharp = Camera::expose(&frame.rgb, size, opening.seconds());
            accumulate(&mut mean, &sharp, 1.0 / film.sub_frames as f32);
        }
        for (a, b) in blur.iter().flatten().zip(mean.iter().flatten()) {
            assert!((a - b).abs() <= 1e-3 * b.max(1.0), "{a} and {b} electrons");
        }
        assert_eq!(film.steps.len(), STEPS);
        let (open, close) = (opening.open_ns, opening.close_ns);
        assert!(
            film.events
                .iter()
                .all(|e| (open..close).contains(&e.t.as_nanos()))
        );
    }
}

//! From luminance frames to events: the pixel model of v2e (Hu, Liu, Delbruck: v2e: From Video
//! Frames to Realistic DVS Events, 2021).
//!
//! Works on any sequence of linear luminance frames (white about 1), rendered or photographed.
//! Each pixel low-passes the logarithm of its light, compares it with a remembered level, and
//! fires when the difference reaches its own threshold; leak and shot noise are added. Crossing
//! times are interpolated linearly between frames.

use noctule_sensor::{Event, Evk4, Stamp};
use rayon::prelude::*;

use crate::approx::{exp, ln, max, min};
use crate::chance::{Dice, Purpose, hash32, unit32};

/// Parameters of the pixel model; the defaults are those of the world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PixelModel {
    /// Mean contrast threshold, both polarities (change of the natural logarithm).
    pub threshold: f32,
    /// Spread of the threshold from pixel to pixel, standard deviation.
    pub threshold_sigma: f32,
    /// Rate of ON events that leak causes, Hz; per pixel times 10^N(0, 0.1).
    pub leak_hz: f32,
    /// Rate of noise events in darkness, Hz; per pixel times 10^N(0, 0.1).
    pub shot_hz: f32,
    /// A pixel stays silent this long after an event, microseconds.
    pub refractory_us: f64,
    /// Bandwidth at luminance 0.1, Hz; proportional to light, between 8 Hz and 3 kHz.
    pub bandwidth_hz: f32,
}

impl Default for PixelModel {
    fn default() -> Self {
        Self {
            threshold: 0.25,
            threshold_sigma: 0.03,
            leak_hz: 0.1,
            shot_hz: 3.0,
            refractory_us: 500.0,
            bandwidth_hz: 300.0,
        }
    }
}

impl PixelModel {
    /// The world's sensor of `seed`: shot noise 10^U(0, 1) Hz.
    #[must_use]
    pub fn of_seed(seed: u64) -> Self {
        let mut dice = Dice::new(seed, Purpose::Pixels);
        Self {
            shot_hz: 10_f64.powf(dice.unit()) as f32,
            ..Self::default()
        }
    }

    /// The same sensor without noise: equal thresholds, no leak, no shot noise.
    #[must_use]
    pub fn without_noise(self) -> Self {
        Self {
            threshold_sigma: 0.0,
            leak_hz: 0.0,
            shot_hz: 0.0,
            ..self
        }
    }
}

/// Added to luminance before the logarithm: the photoreceptor's dark current.
const DARK: f32 = 0.002;
/// Thresholds are at least this.
const THRESHOLD_FLOOR: f32 = 0.05;
/// Rows handled together by one thread.
const BAND_ROWS: usize = 16;
/// Pixels looked at together.
const LANES: usize = 16;

/// An event camera's pixels as they go through a sequence of frames.
#[derive(Debug, Clone)]
pub struct EventSimulator {
    model: PixelModel,
    width: usize,
    height: usize,
    bands: Vec<Band>,
    key: u32,
    frames: u32,
    last_us: f64,
    sorted: Vec<u64>,
}

/// State of some rows of pixels, one plane per quantity.
#[derive(Debug, Clone)]
struct Band {
    first_pixel: u32,
    filtered: Vec<f32>,
    reference: Vec<f32>,
    threshold_on: Vec<f32>,
    threshold_off: Vec<f32>,
    leak: Vec<f32>,
    shot: Vec<f32>,
    /// When the pixel last fired, microseconds.
    fired_us: Vec<f64>,
    found: Vec<u64>,
}

/// The interval between two frames, as the pixels need it.
struct Interval {
    start_us: f64,
    end_us: f64,
    seconds: f32,
    key: u32,
}

impl EventSimulator {
    /// A camera of `width` by `height` pixels whose mismatch and noise come from `seed`.
    ///
    /// # Panics
    /// When either side exceeds 2048 pixels, the range of the sensor's coordinates.
    #[must_use]
    pub fn new(width: usize, height: usize, model: PixelModel, seed: u64) -> Self {
        assert!(
            width <= 2048 && height <= 2048,
            "{width} x {height} pixels, at most 2048 a side"
        );
        let bands = (0..height.div_ceil(BAND_ROWS)).map(|index| {
            let first = index * BAND_ROWS;
            Band::new(width, first, BAND_ROWS.min(height - first), &model, seed)
        });
        Self {
            model,
            width,
            height,
            bands: bands.collect(),
            key: Dice::numbered(seed, Purpose::Pixels, 1).bits() as u32,
            frames: 0,
            last_us: 0.0,
            sorted: Vec::new(),
        }
    }

    /// Takes the frame at `t_us` (microseconds on the event camera's clock) and appends the
    /// events since the frame before, in order of time, row, column (two intervals may share the
    /// microsecond in which they meet). The first frame only sets the pixels' state.
    ///
    /// # Panics
    /// When `luminance` has not one value per pixel, or time does not advance.
    pub fn step(&mut self, luminance: &[f32], t_us: f64, out: &mut Vec<Event>) {
        assert_eq!(
            luminance.len(),
            self.width * self.height,
            "one luminance per pixel"
        );
        let first = self.frames == 0;
        assert!(
            first || t_us > self.last_us,
            "frame at {t_us} us after one at {} us",
            self.last_us
        );
        let interval = Interval {
            start_us: self.last_us,
            end_us: t_us,
            seconds: ((t_us - self.last_us) * 1e-6) as f32,
            key: self.key ^ self.frames.wrapping_mul(0x85eb_ca6b),
        };
        let (model, width) = (self.model, self.width);
        self.bands
            .par_iter_mut()
            .zip_eq(luminance.par_chunks(BAND_ROWS * self.width))
            .for_each(|(band, light)| {
                if first {
                    band.settle(light);
                } else {
                    band.advance(light, &interval, &model, width);
                }
            });
        self.last_us = t_us;
        self.frames = self.frames.wrapping_add(1);
        self.collect(out);
    }

    fn collect(&mut self, out: &mut Vec<Event>) {
        self.sorted.clear();
        for band in &mut self.bands {
            self.sorted.append(&mut band.found);
        }
        self.sorted.sort_unstable();
        out.extend(self.sorted.iter().map(|&packed| unpack(packed)));
    }
}

/// Time, row, column and polarity in one word that sorts like them.
fn pack(t_us: f64, pixel: u32, width: usize, on: bool) -> u64 {
    let (y, x) = (
        u64::from(pixel) / width as u64,
        u64::from(pixel) % width as u64,
    );
    (t_us.max(0.0) as u64) << 23 | y << 12 | x << 1 | u64::from(on)
}

fn unpack(packed: u64) -> Event {
    Event {
        t: Stamp::<Evk4>::from_micros(packed >> 23),
        x: (packed >> 1 & 0x7ff) as u16,
        y: (packed >> 12 & 0x7ff) as u16,
        on: packed & 1 == 1,
    }
}

impl Band {
    fn new(width: usize, first_row: usize, rows: usize, model: &PixelModel, seed: u64) -> Self {
        let count = width * rows;
        let mut dice = Dice::numbered(seed, Purpose::Pixels, 2 + first_row as u64);
        let mut threshold = || {
            let theta =
                f64::from(model.threshold) + f64::from(model.threshold_sigma) * dice.normal();
            (theta as f32).max(THRESHOLD_FLOOR)
        };
        let threshold_on: Vec<f32> = (0..count).map(|_| threshold()).collect();
        let threshold_off: Vec<f32> = (0..count).map(|_| threshold()).collect();
        let mut spread = |rate: f32| rate * 10_f64.powf(0.1 * dice.normal()) as f32;
        Self {
            first_pixel: (first_row * width) as u32,
            filtered: vec![0.0; count],
            reference: vec![0.0; count],
            leak: threshold_on
                .iter()
                .map(|theta| theta * spread(model.leak_hz))
                .collect(),
            shot: (0..count).map(|_| spread(model.shot_hz)).collect(),
            threshold_on,
            threshold_off,
            fired_us: vec![f64::NEG_INFINITY; count],
            found: Vec::new(),
        }
    }

    fn settle(&mut self, light: &[f32]) {
        for (i, &y) in light.iter().enumerate() {
            let level = ln(max(y, 0.0) + DARK);
            self.filtered[i] = level;
            self.reference[i] = level;
        }
    }

    fn advance(&mut self, light: &[f32], interval: &Interval, model: &PixelModel, width: usize) {
        let mut at = 0;
        while at < light.len() {
            let count = LANES.min(light.len() - at);
            let mut lanes = [0.0; LANES];
            lanes[..count].copy_from_slice(&light[at..at + count]);
            let before = self.filter(at, count, &lanes, interval, model);
            for i in 0..count {
                if before.active[i] {
                    let was = before.filtered[i];
                    self.fire(at + i, was, before.noisy[i], interval, model, width);
                }
            }
            at += count;
        }
    }

    /// Band limit and leak of up to 16 pixels, and which of them may fire.
    fn filter(
        &mut self,
        at: usize,
        count: usize,
        light: &[f32; LANES],
        interval: &Interval,
        model: &PixelModel,
    ) -> Before {
        let mut before = Before::default();
        let load = |plane: &[f32]| {
            let mut lanes = [0.0; LANES];
            lanes[..count].copy_from_slice(&plane[at..at + count]);
            lanes
        };
        before.filtered = load(&self.filtered);
        let (reference, leak) = (load(&self.reference), load(&self.leak));
        let (on, off, shot) = (
            load(&self.threshold_on),
            load(&self.threshold_off),
            load(&self.shot),
        );
        let (mut filtered, mut level) = ([0.0; LANES], [0.0; LANES]);
        let first = self.first_pixel.wrapping_add(at as u32);
        let dt = interval.seconds;
        for i in 0..LANES {
            let y = max(light[i], 0.0) + DARK;
            let bandwidth = min(max(model.bandwidth_hz * (y * 10.0), 8.0), 3000.0);
            let share = 1.0 - exp(-core::f32::consts::TAU * bandwidth * dt);
            filtered[i] = before.filtered[i] + share * (ln(y) - before.filtered[i]);
            level[i] = reference[i] - leak[i] * dt;
            let rate = shot[i] * (0.25 + 0.75 / (1.0 + (y - DARK) * 20.0));
            let draw = unit32(hash32(first.wrapping_add(i as u32), interval.key));
            let noisy = draw < 1.0 - exp(-rate * dt);
            let up = filtered[i] - level[i];
            before.noisy[i] = noisy;
            before.active[i] = noisy | (up >= on[i]) | (-up >= off[i]);
        }
        self.filtered[at..at + count].copy_from_slice(&filtered[..count]);
        self.reference[at..at + count].copy_from_slice(&level[..count]);
        before
    }

    /// Lets one pixel fire as often as its thresholds were crossed, then as noise has it.
    fn fire(
        &mut self,
        i: usize,
        was: f32,
        noisy: bool,
        interval: &Interval,
        model: &PixelModel,
        width: usize,
    ) {
        let now = self.filtered[i];
        let span = interval.end_us - interval.start_us;
        let pixel = self.first_pixel + i as u32;
        loop {
            let up = now - self.reference[i];
            let on = up >= self.threshold_on[i];
            if !on && -up < self.threshold_off[i] {
                break;
            }
            let step = if on {
                self.threshold_on[i]
            } else {
                -self.threshold_off[i]
            };
            self.reference[i] += step;
            let crossed = if now == was {
                1.0
            } else {
                (self.reference[i] - was) / (now - was)
            };
            let t_us = interval.start_us + span * f64::from(crossed.clamp(0.0, 1.0));
            self.emit(i, t_us, pack(t_us, pixel, width, on), model);
        }
        if noisy {
            let dice = hash32(pixel, interval.key ^ 0x27d4_eb2f);
            let t_us = interval.start_us + span * f64::from(unit32(dice));
            self.reference[i] = now;
            self.emit(i, t_us, pack(t_us, pixel, width, dice & 1 == 1), model);
        }
    }

    fn emit(&mut self, i: usize, t_us: f64, packed: u64, model: &PixelModel) {
        if t_us - self.fired_us[i] >= model.refractory_us {
            self.fired_us[i] = t_us;
            self.found.push(packed);
        }
    }
}

/// What [`Band::filter`] found out about some pixels.
#[derive(Default)]
struct Before {
    filtered: [f32; LANES],
    noisy: [bool; LANES],
    active: [bool; LANES],
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One bright pixel, so that the band limit (3 kHz) is out of the way.
    fn pixel(model: PixelModel) -> EventSimulator {
        EventSimulator::new(1, 1, model.without_noise(), 5)
    }

    fn light(log: f32) -> Vec<f32> {
        vec![log.exp() - DARK]
    }

    #[test]
    fn a_rise_fires_once_per_threshold_at_interpolated_times() {
        let mut camera = pixel(PixelModel::default());
        let mut events = Vec::new();
        camera.step(&light(0.0), 0.0, &mut events);
        assert!(events.is_empty());
        // 0.6 in 6 ms: levels 0.25 and 0.5 are crossed at 2.5 and 5 ms.
        camera.step(&light(0.6), 6000.0, &mut events);
        let times: Vec<u64> = events.iter().map(|e| e.t.as_micros()).collect();
        assert!(
            times.len() == 2 && times[0].abs_diff(2500) <= 1 && times[1].abs_diff(5000) <= 1,
            "{times:?}"
        );
        assert!(events.iter().all(|e| e.on));
        // From 0.6 down to -0.1 with the reference at 0.5: OFF at 0.25 and 0.0, that is after
        // 3 ms and 5.143 ms.
        events.clear();
        camera.step(&light(-0.1), 12_000.0, &mut events);
        let times: Vec<u64> = events.iter().map(|e| e.t.as_micros()).collect();
        assert!(
            times.len() == 2 && times[0].abs_diff(9000) <= 1 && times[1].abs_diff(11_143) <= 1,
            "{times:?}"
        );
        assert!(events.iter().all(|e| !e.on));
    }

    #[test]
    fn events_within_the_refractory_time_are_dropped_but_the_level_moves_on() {
        let mut camera = pixel(PixelModel::default());
        let mut events = Vec::new();
        camera.step(&light(0.0), 0.0, &mut events);
        // Four thresholds in 1 ms are 0.24 ms apart: the first and third pass.
        camera.step(&light(1.04), 1000.0, &mut events);
        assert_eq!(events.len(), 2);
        events.clear();
        camera.step(&light(1.2), 9000.0, &mut events);
        assert!(events.is_empty(), "the reference stands at 1.0, 0.2 below");
    }

    #[test]
    fn a_dark_pixel_is_slow() {
        let mut camera = pixel(PixelModel::default());
        let mut events = Vec::new();
        camera.step(&[0.0], 0.0, &mut events);
        // ln(0.004 / 0.002) = 0.69; at 12 Hz only 1 - exp(-2 pi 12 0.002) = 14 % arrive.
        camera.step(&[0.002], 2000.0, &mut events);
        assert!(events.is_empty());
        for i in 2..100 {
            camera.step(&[0.002], 2000.0 * f64::from(i), &mut events);
        }
        assert_eq!(events.len(), 2);
    }

    #[test]
    fn shot_noise_has_the_stated_rate() {
        let model = PixelModel {
            leak_hz: 0.0,
            shot_hz: 5.0,
            ..PixelModel::default()
        };
        let mut camera = EventSimulator::new(64, 64, model, 1);
        let mut events = Vec::new();
        let frame = vec![0.05; 64 * 64];
        for i in 0..=100 {
            camera.step(&frame, f64::from(i) * 5000.0, &mut events);
        }
        // Half a second; at Y = 0.05 the rate is 0.25 + 0.75 / 2 of 5 Hz, times E[10^N(0,0.1)].
        let expected = 4096.0 * 0.5 * 5.0 * 0.625 * 1.0269;
        let found = events.len() as f64;
        assert!(
            (found / expected - 1.0).abs() < 0.05,
            "{found} for {expected}"
        );
        let on = events.iter().filter(|e| e.on).count() as f64;
        assert!((on / found - 0.5).abs() < 0.03);
        assert!(events.is_sorted_by_key(|e| (e.t, e.y, e.x)));
    }

    #[test]
    fn leak_fires_on_events_at_its_rate() {
        let model = PixelModel {
            shot_hz: 0.0,
            leak_hz: 0.2,
            ..PixelModel::default()
        };
        let mut camera = EventSimulator::new(32, 32, model, 1);
        let mut events = Vec::new();
        let frame = vec![0.3; 32 * 32];
        for i in 0..=100 {
            camera.step(&frame, f64::from(i) * 200_000.0, &mut events);
        }
        let rate = events.len() as f64 / 1024.0 / 20.0;
        assert!((rate / 0.2 - 1.0).abs() < 0.15, "{rate} Hz");
        assert!(events.iter().all(|e| e.on));
    }
}

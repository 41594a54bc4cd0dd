//! One exposure as training and evaluation use it: what the sensors saw, and the truth.

use noctule_depth::Ground;
use noctule_raster::{PackedEvent, RasterError};
use noctule_world::{CAMERA_HEIGHT_M, Optics, STEPS, Sample, Tier};

/// Where an example comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// A rendered night of this tier.
    Night(Tier),
    /// A real drive of KITTI.
    Kitti,
}

impl Origin {
    /// The tier's letter, or K.
    pub fn letter(self) -> char {
        match self {
            Self::Night(tier) => tier.letter(),
            Self::Kitti => 'K',
        }
    }
}

/// One exposure on the network's grid; `T` is 8, `H = W = size`.
///
/// The part of a [`Sample`] that learning needs, or its like of real frames. Depth truth is kept to a 512th of a metre and up
/// to 127.99 m; everything else is exactly the sample's.
#[derive(Debug, Clone, PartialEq)]
pub struct Example {
    /// The drive's seed; of real drives a number that tells exposures of one drive apart.
    pub seed: u64,
    /// Where it comes from.
    pub origin: Origin,
    /// Width and height, pixels.
    pub size: usize,
    /// Length of the exposure, whole microseconds.
    pub exposure_us: u32,
    /// Where level ground lies in the picture, where that is known.
    pub ground: Option<Ground>,
    /// The long exposure, `[3, H, W]`, gamma 1/2.2 (real drives: sRGB), 8 bit.
    pub blur: Vec<u8>,
    /// Events in order; times are microseconds since the shutter opened.
    pub events: Vec<PackedEvent>,
    /// The LiDAR's depth at the step centres, `[T, H, W]`, metres; 0 where there is none.
    pub sparse: Vec<f32>,
    /// True depth at the step centres, `[T, H, W]`, metres; 0 is sky, or unknown.
    pub depth: Vec<f32>,
    /// Sharp images at the step centres, `[T, 3, H, W]`, gamma 1/2.2, 8 bit; empty where not asked
    /// for.
    pub sharp: Vec<u8>,
    /// Whether something moves on its own, `[T, H, W]`.
    pub movers: Vec<bool>,
    /// Whether something is narrower than 0.3 m, `[T, H, W]`.
    pub thin: Vec<bool>,
}

/// The ground of every rendered night, in a picture of `size` by `size` pixels.
pub fn night_ground(size: usize) -> Option<Ground> {
    let optics = Optics::new(size);
    let [height, focal, horizon] =
        [CAMERA_HEIGHT_M, optics.focal_px, optics.centre_px].map(f64::from);
    Ground::level(height, focal, horizon)
}

/// Steps of depth truth in a metre.
pub(super) const DEPTH_CODES_PER_M: f32 = 512.0;

/// The code of a depth in metres: 512ths of a metre, 0 for nothing, saturating at 127.998 m.
pub(super) fn depth_code(depth_m: f32) -> u16 {
    if depth_m > 0.0 {
        (depth_m * DEPTH_CODES_PER_M).round().clamp(1.0, 65535.0) as u16
    } else {
        0
    }
}

impl Example {
    /// Renders the exposure that `seed` and `tier` stand for.
    ///
    /// # Errors
    /// [`RasterError::Pixel`], when `size` exceeds what a packed event can address.
    pub fn render(seed: u64, tier: Tier, size: usize) -> Result<Self, RasterError> {
        Self::from_sample(seed, tier, &Sample::render(seed, tier, size))
    }

    /// Takes from a sample what learning needs.
    ///
    /// # Errors
    /// As [`render`](Self::render).
    pub fn from_sample(seed: u64, tier: Tier, sample: &Sample) -> Result<Self, RasterError> {
        let micros = |ns: u64| (ns + 500) / 1000; // as the strobe's edges are read
        let open_us = micros(sample.opening.open_ns);
        let width_us = micros(sample.opening.close_ns) - open_us;
        let events = sample
            .events
            .iter()
            .map(|event| {
                let since = event.t.as_micros().saturating_sub(open_us);
                PackedEvent::new(since as u32, event.x, event.y, event.on)
            })
            .collect::<Result<_, _>>()?;
        let stored = |depth: &f32| f32::from(depth_code(*depth)) / DEPTH_CODES_PER_M;
        let flags = |mask: &[u8]| mask.iter().map(|&m| m != 0).collect();
        Ok(Self {
            seed,
            origin: Origin::Night(tier),
            size: sample.size,
            exposure_us: width_us as u32,
            ground: night_ground(sample.size),
            blur: sample.blur.clone(),
            events,
            sparse: sample.sparse.clone(),
            depth: sample.depth.iter().map(stored).collect(),
            sharp: sample.sharp.clone(),
            movers: flags(&sample.movers),
            thin: flags(&sample.thin),
        })
    }

    /// Pixels of one map.
    pub fn pixels(&self) -> usize {
        self.size * self.size
    }

    /// One step's part of a `[T, H, W]` field.
    pub fn step<'a, V>(&self, field: &'a [V], step: usize) -> &'a [V] {
        debug_assert!(step < STEPS);
        &field[step * self.pixels()..][..self.pixels()]
    }
}

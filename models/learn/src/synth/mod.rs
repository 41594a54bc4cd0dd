//! Exposures made of sharp frames: the blurred picture and the events that a night rig would have
//! had of the same motion.
//!
//! The frames are taken to linear light and looked at `between` times per frame or more often,
//! moved along the optical flow between the two around each instant, or blended from them. The
//! pictures' mean, darkened and with the noise of few electrons, is the long exposure; the same
//! pictures go through the world's [`EventSimulator`], after eight of warm-up. Everything is a pure
//! function of frames, recipe and seed, bit for bit.

mod error;
mod film;
mod flow;
mod footage;
mod motion;
mod plane;
mod view;

use noctule_raster::{EXPOSURE_US_MAX, PackedEvent};
use noctule_world::{EventSimulator, LUMA, PixelModel, STEPS};

pub use error::SynthError;
pub use film::Film;
pub use flow::OpticalFlow;
pub use footage::Footage;
use footage::Scratch;

/// Most pictures looked at per frame.
pub const BETWEEN_MAX: usize = 64;
/// Where doubling the pictures per frame ends, however fast things move.
const DOUBLED_MAX: usize = 32;
/// Farthest that things may move from picture to picture before that, pixels.
const REACH_PX: f32 = 1.0;
/// Pictures that events settle on before the shutter opens.
const WARM_UP: usize = 8;

/// How pictures between two frames are made of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum InBetween {
    /// Moved along optical flow; blended where that contradicts itself.
    #[default]
    Moved,
    /// Blended. What moves by more than a pixel from frame to frame fades out and in instead of
    /// moving; cheaper by far, and right where light changes and nothing moves.
    Blended,
}

/// How exposures are made.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Synthesis {
    /// Pictures looked at per frame, 1 to [`BETWEEN_MAX`]. Where they are moved it is the least
    /// number: doubled, up to 32, until nearly nothing moves by more than a pixel between two.
    pub between: usize,
    /// How they are made.
    pub in_between: InBetween,
    /// The event camera's pixels.
    pub pixels: PixelModel,
    /// The frame camera's noise; `None` for a blur without noise.
    pub film: Option<Film>,
    /// Where all chance comes from.
    pub seed: u64,
}

impl Synthesis {
    /// Eight pictures per frame or more, moved; the world's pixels of this seed, and its night.
    pub fn of_seed(seed: u64) -> Self {
        Self {
            between: 8,
            in_between: InBetween::Moved,
            pixels: PixelModel::of_seed(seed),
            film: Some(Film::of_seed(seed)),
            seed,
        }
    }

    /// Pictures per frame that `footage` is looked at with from `open` to `close`, both in frames.
    pub fn pictures_per_frame(&self, footage: &Footage, open: f64, close: f64) -> usize {
        let mut between = self.between.max(1);
        if self.in_between == InBetween::Moved {
            let reach = footage.reach(open, close);
            while reach > REACH_PX * between as f32 && 2 * between <= DOUBLED_MAX {
                between *= 2;
            }
        }
        between
    }
}

/// One exposure.
#[derive(Debug, Clone, PartialEq)]
pub struct Exposed {
    /// The long exposure, `[3, H, W]`, sRGB, 8 bit.
    pub blur: Vec<u8>,
    /// Sharp pictures at the step centres, `[T, 3, H, W]`, sRGB, 8 bit, no noise.
    pub sharp: Vec<u8>,
    /// Events in order of time, row and column; microseconds since the shutter opened.
    pub events: Vec<PackedEvent>,
    /// Length, microseconds.
    pub exposure_us: u32,
}

/// Exposes `footage` from `open` to `close`, both in frames from its first. Either may lie beyond
/// the footage, where the light stands still.
///
/// # Errors
/// [`SynthError`], when the exposure or the recipe is out of range.
pub fn expose(
    footage: &Footage,
    open: f64,
    close: f64,
    recipe: &Synthesis,
) -> Result<Exposed, SynthError> {
    if !(1..=BETWEEN_MAX).contains(&recipe.between) {
        return Err(SynthError::Between(recipe.between));
    }
    let micros = (close - open) * footage.period_us();
    let exposure_us = micros.round();
    if !(1.0..=f64::from(EXPOSURE_US_MAX)).contains(&exposure_us) || !open.is_finite() {
        let max_us = EXPOSURE_US_MAX;
        return Err(SynthError::Span {
            open,
            close,
            micros,
            max_us,
        });
    }
    let frames = close - open;
    let between = recipe.pictures_per_frame(footage, open, close);
    let per_step = (frames * between as f64 / STEPS as f64).ceil().max(1.0) as usize;
    let count = STEPS * per_step;
    let instant = |index: f64| open + frames * (index - WARM_UP as f64) / count as f64;

    let (size, area) = (footage.size(), footage.size().pixels());
    let mut simulator =
        EventSimulator::new(size.width(), size.height(), recipe.pixels, recipe.seed);
    let lead_us = (micros * WARM_UP as f64 / count as f64).ceil();
    let (mut light, mut luma, mut mean) = (Vec::new(), vec![0.0; area], vec![0.0_f32; 3 * area]);
    let (mut found, mut scratch) = (Vec::new(), Scratch::default());
    for index in 0..WARM_UP + count + 1 {
        let at = instant(index as f64 + 0.5);
        footage.light_at(at, recipe.in_between, &mut scratch, &mut light);
        for (pixel, luma) in luma.iter_mut().enumerate() {
            *luma = (0..3).map(|c| LUMA[c] * light[c * area + pixel]).sum();
        }
        simulator.step(
            &luma,
            lead_us + (at - open) * footage.period_us(),
            &mut found,
        );
        if (WARM_UP..WARM_UP + count).contains(&index) {
            mean.iter_mut()
                .zip(&light)
                .for_each(|(sum, l)| *sum += l / count as f32);
        }
    }
    let mut sharp = Vec::with_capacity(STEPS * 3 * area);
    for step in 0..STEPS {
        let centre = open + frames * (step as f64 + 0.5) / STEPS as f64;
        footage.light_at(centre, recipe.in_between, &mut scratch, &mut light);
        sharp.append(&mut film::develop_clean(&light));
    }
    Ok(Exposed {
        blur: match &recipe.film {
            Some(film) => film.develop(&mean, recipe.seed),
            None => film::develop_clean(&mean),
        },
        sharp,
        events: inside(&found, lead_us as u64, exposure_us as u64),
        exposure_us: exposure_us as u32,
    })
}

/// Events while the shutter is open, counted from then, in order.
fn inside(found: &[noctule_sensor::Event], open_us: u64, len_us: u64) -> Vec<PackedEvent> {
    let mut events: Vec<PackedEvent> = found
        .iter()
        .filter_map(|event| {
            let since = event.t.as_micros().checked_sub(open_us)?;
            let since = u32::try_from(since).ok().filter(|_| since < len_us)?;
            // The footage is within what event coordinates can say.
            PackedEvent::new(since, event.x, event.y, event.on).ok()
        })
        .collect();
    // Two intervals may share the microsecond in which they meet.
    events.sort_by_key(|event| (event.t_us, event.y(), event.x()));
    events
}

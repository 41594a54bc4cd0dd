//! Sharp frames as light that can be looked at at any instant.

use noctule_depth::Size;
use noctule_raster::{Encoding, EncodingTable};

use super::error::SynthError;

/// Longest side of a frame: event coordinates are 11 bits.
const SIDE_MAX: usize = 2048;

/// Consecutive sharp frames in linear light, white 1; time counts in frames from the first.
#[derive(Debug, Clone)]
pub struct Footage {
    size: Size,
    period_us: f64,
    frames: Vec<Light>,
}

/// Linear light, three planes `[3, H, W]`.
pub(super) type Light = Vec<f32>;

impl Footage {
    /// Takes frames encoded as sRGB, each `[H, W, 3]`, that follow one another every `period_us`
    /// microseconds.
    ///
    /// # Errors
    /// [`SynthError`], when there is none, one has another size, or the period is none.
    pub fn from_srgb<'a>(
        frames: impl IntoIterator<Item = &'a [u8]>,
        size: Size,
        period_us: f64,
    ) -> Result<Self, SynthError> {
        let (width, height, area) = (size.width(), size.height(), size.pixels());
        if width > SIDE_MAX || height > SIDE_MAX {
            let max = SIDE_MAX;
            return Err(SynthError::Side { width, height, max });
        }
        if !(period_us.is_finite() && period_us > 0.0) {
            return Err(SynthError::Period(period_us));
        }
        let table = EncodingTable::new(Encoding::Srgb);
        let mut linear = Vec::new();
        for (index, frame) in frames.into_iter().enumerate() {
            if frame.len() != 3 * area {
                let (len, wanted) = (frame.len(), 3 * area);
                return Err(SynthError::Length { index, len, wanted });
            }
            let mut light = vec![0.0; 3 * area];
            for (at, pixel) in frame.chunks_exact(3).enumerate() {
                for (channel, code) in pixel.iter().enumerate() {
                    light[channel * area + at] = table.light(*code);
                }
            }
            linear.push(light);
        }
        match linear.is_empty() {
            true => Err(SynthError::Empty),
            false => Ok(Self {
                size,
                period_us,
                frames: linear,
            }),
        }
    }

    /// Its size.
    pub fn size(&self) -> Size {
        self.size
    }

    /// Time from frame to frame, microseconds.
    pub fn period_us(&self) -> f64 {
        self.period_us
    }

    /// The light at an instant: the two frames around it, blended linearly. Before the first frame
    /// and after the last the light stands still.
    ///
    /// Blending fades things in and out where they move by more than a pixel from frame to frame;
    /// it does not move them.
    pub(super) fn light_at(&self, at: f64, out: &mut Light) {
        let last = self.frames.len() - 1; // INVARIANT: there is a frame
        let at = at.clamp(0.0, last as f64);
        let before = (at.floor() as usize).min(last);
        let after = (before + 1).min(last);
        let share = (at - before as f64) as f32;
        out.clear();
        let pairs = self.frames[before].iter().zip(&self.frames[after]);
        out.extend(pairs.map(|(a, b)| a + share * (b - a)));
    }
}

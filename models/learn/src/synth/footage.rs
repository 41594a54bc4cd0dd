//! Sharp frames as light that can be looked at at any instant.

use std::sync::{Arc, OnceLock};

use noctule_depth::Size;
use noctule_raster::{Encoding, EncodingTable};
use noctule_world::LUMA;
use rayon::prelude::*;

use super::InBetween;
use super::error::SynthError;
use super::motion::{Arrivals, Gap};
use super::plane::Plane;
use super::view::{Light, View};

/// Longest side of a frame: event coordinates are 11 bits.
const SIDE_MAX: usize = 2048;

/// Consecutive sharp frames in linear light, white 1; time counts in frames from the first.
///
/// Clones share the frames, and the flow between them once it has been asked for.
#[derive(Debug, Clone)]
pub struct Footage {
    whole: Arc<Whole>,
    view: View,
}

#[derive(Debug)]
struct Whole {
    size: Size,
    period_us: f64,
    frames: Vec<Light>,
    /// As encoded, 0 to 255.
    greys: Vec<Plane>,
    /// One fewer than frames; found when they are first wanted.
    gaps: OnceLock<Vec<Gap>>,
}

/// What looking at footage works in; one may serve any.
#[derive(Debug, Default)]
pub(super) struct Scratch(Vec<Arrivals>);

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
        let (mut linear, mut greys) = (Vec::new(), Vec::new());
        for (index, frame) in frames.into_iter().enumerate() {
            if frame.len() != 3 * area {
                let (len, wanted) = (frame.len(), 3 * area);
                return Err(SynthError::Length { index, len, wanted });
            }
            let mut light = vec![0.0; 3 * area];
            let mut grey = Plane::zeros(width, height);
            for (at, pixel) in frame.chunks_exact(3).enumerate() {
                for (channel, code) in pixel.iter().enumerate() {
                    light[channel * area + at] = table.light(*code);
                    grey.values[at] += LUMA[channel] * f32::from(*code);
                }
            }
            linear.push(light);
            greys.push(grey);
        }
        if linear.is_empty() {
            return Err(SynthError::Empty);
        }
        let whole = Whole {
            size,
            period_us,
            frames: linear,
            greys,
            gaps: OnceLock::new(),
        };
        Ok(Self {
            whole: Arc::new(whole),
            view: View {
                x: 0,
                y: 0,
                size,
                width,
            },
        })
    }

    /// The same frames looked at through a window whose first pixel is `(x, y)`. What enters and
    /// leaves the window is still known from outside it.
    ///
    /// # Errors
    /// [`SynthError::View`], when it does not lie within the frames.
    pub fn seen_through(&self, x: usize, y: usize, size: Size) -> Result<Self, SynthError> {
        let whole = self.whole.size;
        let fits = |start: usize, len: usize, room: usize| {
            start.checked_add(len).is_some_and(|end| end <= room)
        };
        if !fits(x, size.width(), whole.width()) || !fits(y, size.height(), whole.height()) {
            return Err(SynthError::View {
                at: [x, y],
                size: [size.width(), size.height()],
                whole: [whole.width(), whole.height()],
            });
        }
        let width = whole.width();
        Ok(Self {
            whole: Arc::clone(&self.whole),
            view: View { x, y, size, width },
        })
    }

    /// Size of what is looked at.
    pub fn size(&self) -> Size {
        self.view.size
    }

    /// Time from frame to frame, microseconds.
    pub fn period_us(&self) -> f64 {
        self.whole.period_us
    }

    /// The linear light at an instant, `[3, H, W]`, white 1. Before the first frame and after the
    /// last it stands still; on a frame it is that frame.
    pub fn light(&self, at: f64, in_between: InBetween) -> Vec<f32> {
        let mut light = Light::new();
        self.light_at(at, in_between, &mut Scratch::default(), &mut light);
        light
    }

    pub(super) fn light_at(
        &self,
        at: f64,
        in_between: InBetween,
        scratch: &mut Scratch,
        out: &mut Light,
    ) {
        let frames = &self.whole.frames;
        let last = frames.len() - 1; // INVARIANT: there is a frame
        let at = at.clamp(0.0, last as f64);
        let before = (at.floor() as usize).min(last);
        let after = (before + 1).min(last);
        let share = (at - before as f64) as f32;
        if in_between == InBetween::Moved && share > 0.0 {
            let ends = [&frames[before], &frames[after]];
            return self.gaps()[before].light(ends, share, &self.view, &mut scratch.0, out);
        }
        let area = self.whole.size.pixels();
        out.clear();
        for channel in 0..3 {
            let plane = |frame: usize| &frames[frame][channel * area..][..area];
            let (a, b) = (plane(before), plane(after));
            let blend = |cell: usize| a[cell] + share * (b[cell] - a[cell]);
            out.extend(self.view.cells().map(blend));
        }
    }

    /// The farthest that things move from frame to frame between two instants, pixels, as
    /// [`Gap::reach`] has it.
    pub(super) fn reach(&self, open: f64, close: f64) -> f32 {
        let gaps = self.gaps();
        let crossed = |gap: &usize| (*gap as f64) < close && open < (*gap + 1) as f64;
        let crossed = (0..gaps.len()).filter(crossed);
        crossed
            .map(|gap| gaps[gap].reach(&self.view))
            .fold(0.0, f32::max)
    }

    /// Found outside the lock: a thread that waited for it could be one that must finish it.
    fn gaps(&self) -> &[Gap] {
        if let Some(gaps) = self.whole.gaps.get() {
            return gaps;
        }
        let pairs = self.whole.greys.par_windows(2);
        let found: Vec<Gap> = pairs.map(|pair| Gap::between(&pair[0], &pair[1])).collect();
        self.whole.gaps.get_or_init(|| found)
    }
}

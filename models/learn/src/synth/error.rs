//! Why no exposure can be made of some frames.

use thiserror::Error;

/// What is wrong with frames or with what was asked of them.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum SynthError {
    /// There is no frame.
    #[error("no frames, wanted one or more")]
    Empty,
    /// A frame has another size than footage was promised to have.
    #[error("frame {index} has {len} bytes, wanted {wanted}")]
    Length {
        /// Which, from 0.
        index: usize,
        /// Its bytes.
        len: usize,
        /// Three for each pixel.
        wanted: usize,
    },
    /// Frames are wider or higher than events can say.
    #[error("frames of {width}x{height} pixels, at most {max} a side")]
    Side {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// The most.
        max: usize,
    },
    /// Frames do not follow one another at a rate.
    #[error("frames every {0} us, wanted a number above 0")]
    Period(f64),
    /// The exposure does not last, lasts too long, or leaves nothing to see.
    #[error("exposure from {open} to {close} frames lasts {micros} us, wanted 1 us to {max_us} us")]
    Span {
        /// When it opens, frames.
        open: f64,
        /// When it closes, frames.
        close: f64,
        /// How long that is.
        micros: f64,
        /// The longest.
        max_us: u32,
    },
    /// The up-sampling factor is out of range.
    #[error("{0} pictures per frame, wanted 1 to {max}", max = super::BETWEEN_MAX)]
    Between(usize),
    /// A window does not lie within the frames.
    #[error(
        "a window of {}x{} pixels at ({}, {}) of frames of {}x{}",
        size[0], size[1], at[0], at[1], whole[0], whole[1]
    )]
    View {
        /// First column and row.
        at: [usize; 2],
        /// Width and height.
        size: [usize; 2],
        /// Of the frames.
        whole: [usize; 2],
    },
    /// A picture that flow is asked of is none.
    #[error("grey of {len} numbers{}, wanted {wanted} finite ones", if *is_finite { "" } else { ", not all finite" })]
    Grey {
        /// Its numbers.
        len: usize,
        /// One for each pixel.
        wanted: usize,
        /// Whether all of them are numbers.
        is_finite: bool,
    },
}

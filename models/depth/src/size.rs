//! The size of a depth map, checked once; every slice is measured against it. Holds no pixels.

use thiserror::Error;

/// Longest side of a map in pixels: up to here the nearest search is exact in `f64`.
pub const SIDE_MAX: usize = 4096;

/// A size or a slice that cannot be a depth map.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum SizeError {
    /// A side is zero or above [`SIDE_MAX`].
    #[error("map is {width}x{height} pixels, sides must lie in 1..={SIDE_MAX}")]
    Side {
        /// Columns asked for.
        width: usize,
        /// Rows asked for.
        height: usize,
    },
    /// A slice does not hold one value per pixel (or per channel of a pixel).
    #[error("{name} holds {actual} values, needs {expected}")]
    Length {
        /// Which argument.
        name: &'static str,
        /// Its length.
        actual: usize,
        /// The length it must have.
        expected: usize,
    },
}

/// Columns and rows of a map whose pixels lie row by row, top left first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Size {
    width: usize,
    height: usize,
}

impl Size {
    /// Checks that both sides lie in `1..=SIDE_MAX`.
    pub fn new(width: usize, height: usize) -> Result<Self, SizeError> {
        let fits = |side| (1..=SIDE_MAX).contains(&side);
        if fits(width) && fits(height) {
            Ok(Self { width, height })
        } else {
            Err(SizeError::Side { width, height })
        }
    }

    /// Columns.
    pub fn width(self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(self) -> usize {
        self.height
    }

    /// Columns times rows.
    pub fn pixels(self) -> usize {
        self.width * self.height
    }

    /// Errors unless `actual` equals the pixel count; `name` says which argument it was.
    pub(crate) fn check(self, name: &'static str, actual: usize) -> Result<(), SizeError> {
        check_len(name, actual, self.pixels())
    }
}

/// Errors unless the slice called `name` has `expected` values.
pub(crate) fn check_len(
    name: &'static str,
    actual: usize,
    expected: usize,
) -> Result<(), SizeError> {
    if actual == expected {
        Ok(())
    } else {
        Err(SizeError::Length {
            name,
            actual,
            expected,
        })
    }
}

/// Whether a sparse map holds a return here: a finite depth above zero.
#[inline]
pub(crate) fn is_return(depth_m: f32) -> bool {
    depth_m > 0.0 && depth_m < f32::INFINITY
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sides_are_bounded_and_the_error_shows_them() {
        assert_eq!(Size::new(4096, 1).map(Size::pixels), Ok(4096));
        for (width, height) in [(0, 5), (5, 0), (4097, 5), (5, 4097)] {
            let error = Size::new(width, height).expect_err("out of bounds");
            assert_eq!(
                error.to_string(),
                format!("map is {width}x{height} pixels, sides must lie in 1..=4096")
            );
        }
        let error = check_len("sparse", 3, 4).expect_err("short");
        assert_eq!(error.to_string(), "sparse holds 3 values, needs 4");
    }

    #[test]
    fn only_finite_positive_depths_are_returns() {
        assert!(is_return(0.1) && is_return(f32::MAX));
        for depth in [0.0, -0.0, -1.0, f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            assert!(!is_return(depth), "{depth}");
        }
    }
}

//! Light, and which part of a picture is looked at.

use noctule_depth::Size;

/// Linear light, three planes `[3, H, W]`.
pub(super) type Light = Vec<f32>;

/// The part of the frames that is looked at.
#[derive(Debug, Clone, Copy)]
pub(super) struct View {
    pub x: usize,
    pub y: usize,
    pub size: Size,
    pub width: usize,
}

impl View {
    /// Row by row, the index in the frames of each pixel of the view.
    pub(super) fn cells(&self) -> impl Iterator<Item = usize> + '_ {
        let rows = self.y..self.y + self.size.height();
        rows.flat_map(move |y| {
            let start = y * self.width + self.x;
            start..start + self.size.width()
        })
    }
}

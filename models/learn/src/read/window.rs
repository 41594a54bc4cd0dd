//! Parts of KITTI's pictures: the benchmark's 1216 x 352, and 256 x 256 for networks.

use noctule_depth::{Canvas, Size};

/// Width of the benchmark's crop, pixels.
pub const BENCHMARK_WIDTH: usize = 1216;
/// Height of the benchmark's crop, pixels.
pub const BENCHMARK_HEIGHT: usize = 352;

/// A rectangle of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Window {
    /// First column.
    pub x: usize,
    /// First row.
    pub y: usize,
    /// Its size.
    pub size: Size,
}

impl Window {
    /// The benchmark's crop, bottom and centre; as much of it as a smaller picture has.
    pub fn benchmark(width: usize, height: usize) -> Option<Self> {
        let size = Size::new(width.min(BENCHMARK_WIDTH), height.min(BENCHMARK_HEIGHT)).ok()?;
        Some(Self {
            x: (width - size.width()) / 2,
            y: height - size.height(),
            size,
        })
    }

    /// The three squares that evaluation looks at: left, centre and right at the bottom of the
    /// benchmark's crop. `None` for a picture smaller than that.
    pub fn squares(width: usize, height: usize, side: usize) -> Option<[Self; 3]> {
        let whole = Self::benchmark(width, height)?;
        let size = Size::new(side, side).ok()?;
        let room = whole.size.width().checked_sub(side)?;
        let y = height.checked_sub(side)?;
        Some([0, room / 2, room].map(|x| Self {
            x: whole.x + x,
            y,
            size,
        }))
    }

    /// The same with so many pixels more on every side, where the picture has them.
    #[must_use]
    pub fn grown(&self, margin: usize, width: usize, height: usize) -> Option<Self> {
        let grow = |start: usize, len: usize, room: usize| {
            let end = start.checked_add(len).filter(|end| *end <= room)?;
            let grown = start.saturating_sub(margin);
            Some((grown, end.saturating_add(margin).min(room) - grown))
        };
        let (x, columns) = grow(self.x, self.size.width(), width)?;
        let (y, rows) = grow(self.y, self.size.height(), height)?;
        let size = Size::new(columns, rows).ok()?;
        Some(Self { x, y, size })
    }

    /// Its part of a map of `width` columns; `None` where the map does not reach that far.
    pub fn of_map(&self, map: &[f32], width: usize) -> Option<Vec<f32>> {
        let mut part = Vec::with_capacity(self.size.pixels());
        for row in self.y..self.y + self.size.height() {
            part.extend_from_slice(self.row(map, width, row, 1)?);
        }
        Some(part)
    }

    /// Its part of a picture, `[H, W, 3]`; `None` where the picture does not reach that far.
    pub fn of_picture(&self, picture: &Canvas) -> Option<Vec<u8>> {
        let mut part = Vec::with_capacity(3 * self.size.pixels());
        for row in self.y..self.y + self.size.height() {
            part.extend_from_slice(self.row(picture.rgb(), picture.width(), row, 3)?);
        }
        Some(part)
    }

    fn row<'a, V>(
        &self,
        field: &'a [V],
        width: usize,
        row: usize,
        channels: usize,
    ) -> Option<&'a [V]> {
        if self.x + self.size.width() > width {
            return None;
        }
        let start = row * width + self.x;
        field.get(channels * start..channels * (start + self.size.width()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn crops_lie_where_the_benchmark_has_them() {
        let whole = Window::benchmark(1242, 375).expect("a picture");
        assert_eq!((whole.x, whole.y), (13, 23));
        assert_eq!((whole.size.width(), whole.size.height()), (1216, 352));
        let squares = Window::squares(1241, 376, 256).expect("room for three");
        assert_eq!(
            squares.map(|s| (s.x, s.y)),
            [(12, 120), (492, 120), (972, 120)]
        );
        let cropped = Window::squares(1216, 352, 256).expect("room for three");
        assert_eq!(cropped.map(|s| (s.x, s.y)), [(0, 96), (480, 96), (960, 96)]);
        assert_eq!(Window::squares(255, 400, 256), None);
        assert_eq!(Window::squares(400, 255, 256), None);
    }

    #[test]
    fn a_grown_window_ends_with_the_picture() {
        let size = Size::new(10, 20).expect("a size");
        let window = Window { x: 3, y: 40, size };
        let grown = window.grown(5, 100, 62).expect("inside");
        assert_eq!((grown.x, grown.y), (0, 35));
        assert_eq!((grown.size.width(), grown.size.height()), (18, 27));
        assert_eq!(window.grown(0, 100, 62), Some(window));
        assert_eq!(window.grown(5, 12, 62), None);
    }

    #[test]
    fn a_part_is_the_part_and_never_wraps() {
        let map: Vec<f32> = (0..12).map(|i| i as f32).collect();
        let size = Size::new(2, 2).expect("a size");
        let part = |x, y| Window { x, y, size }.of_map(&map, 4);
        assert_eq!(part(1, 1), Some(vec![5.0, 6.0, 9.0, 10.0]));
        assert_eq!((part(3, 0), part(0, 2)), (None, None));
        let picture = Canvas::from_rgb(2, 2, (0..12).collect()).expect("a picture");
        let size = Size::new(1, 2).expect("a size");
        let column = Window { x: 1, y: 0, size }.of_picture(&picture);
        assert_eq!(column, Some(vec![3, 4, 5, 9, 10, 11]));
    }
}

//! A bar that says what the colours mean.

use super::canvas::Canvas;
use super::colour::Ramp;
use super::font::{LINE_HEIGHT, text_width};
use super::maps::error_position;
use super::scale::Scale;

const BAR_HEIGHT: usize = 14;
const TICK_LEN: usize = 5;
const TEXT_SCALE: usize = 2;
/// Space between title, bar and tick labels.
const GAP: usize = 6;

/// Title, colours and labelled ticks of one colour scale.
#[derive(Debug, Clone, PartialEq)]
pub struct Legend {
    title: String,
    ramp: &'static Ramp,
    /// Position on the ramp and label, left to right.
    ticks: Vec<(f32, String)>,
}

impl Legend {
    /// The legend of depth maps.
    pub fn depth(scale: Scale) -> Self {
        let ticks = scale
            .ticks_m()
            .into_iter()
            .map(|tick| (scale.position(tick), number(tick)))
            .collect();
        Self {
            title: "depth, metres".into(),
            ramp: Ramp::depth(),
            ticks,
        }
    }

    /// The legend of [`super::error_to_rgb`] with the same full scale.
    pub fn error(full_m: f32) -> Self {
        let ticks = [-1.0, -0.25, -0.05, 0.0, 0.05, 0.25, 1.0].map(|share: f32| {
            let error_m = share * full_m;
            let sign = if share > 0.0 { "+" } else { "" };
            (
                error_position(error_m, full_m),
                format!("{sign}{}", number(error_m)),
            )
        });
        Self {
            title: "error, metres: - too near, + too far".into(),
            ramp: Ramp::signed(),
            ticks: ticks.into(),
        }
    }

    /// The legend of [`super::events_to_rgb`].
    pub fn events() -> Self {
        let ticks = [(0.0, "darker"), (0.5, "0"), (1.0, "brighter")];
        Self {
            title: "events".into(),
            ramp: Ramp::events(),
            ticks: ticks
                .map(|(position, label)| (position, label.into()))
                .into(),
        }
    }

    /// Rows a drawn legend takes.
    pub(crate) fn height() -> usize {
        2 * LINE_HEIGHT * TEXT_SCALE + BAR_HEIGHT + TICK_LEN + 2 * GAP
    }

    /// Draws title, bar and ticks in `width` columns from `(x, y)`.
    pub fn draw(&self, canvas: &mut Canvas, x: usize, y: usize, width: usize, ink: [u8; 3]) {
        canvas.text(x, y, TEXT_SCALE, ink, &self.title);
        let bar_top = y + LINE_HEIGHT * TEXT_SCALE + GAP;
        let span = width.saturating_sub(1).max(1);
        for column in 0..width {
            let colour = self.ramp.at(column as f32 / span as f32);
            canvas.rect(x + column, bar_top, 1, BAR_HEIGHT, colour);
        }
        let label_top = bar_top + BAR_HEIGHT + TICK_LEN + GAP / 2;
        let mut free_from = x;
        for (position, label) in &self.ticks {
            let at = x + (position * span as f32).round() as usize;
            canvas.rect(at, bar_top + BAR_HEIGHT, 1, TICK_LEN, ink);
            let label_width = text_width(label, TEXT_SCALE);
            // Centred under the tick, but never beyond the bar's ends.
            let left = at.saturating_sub(label_width / 2);
            let left = left.min((x + width).saturating_sub(label_width)).max(x);
            if left >= free_from {
                canvas.text(left, label_top, TEXT_SCALE, ink, label);
                free_from = left + label_width + 2 * TEXT_SCALE;
            }
        }
    }
}

/// A number with as many digits as it needs: `0.5`, `80`.
fn number(value: f32) -> String {
    let text = format!("{value:.2}");
    text.trim_end_matches('0').trim_end_matches('.').into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_read_plainly() {
        let texts = [0.5, 80.0, 0.0, 10.0, -0.25].map(number);
        assert_eq!(texts, ["0.5", "80", "0", "10", "-0.25"]);
    }

    #[test]
    fn the_bar_runs_from_end_to_end() {
        let mut canvas = Canvas::new(400, 80, [0; 3]).expect("a size");
        Legend::depth(Scale::DRIVE).draw(&mut canvas, 20, 4, 360, [255; 3]);
        let y = 4 + LINE_HEIGHT * TEXT_SCALE + GAP + 3;
        assert_eq!(canvas.pixel(20, y), Some(Ramp::depth().at(0.0)));
        assert_eq!(canvas.pixel(379, y), Some(Ramp::depth().at(1.0)));
        assert_eq!(
            (canvas.pixel(19, y), canvas.pixel(380, y)),
            (Some([0; 3]), Some([0; 3]))
        );
        // A tick under 80 m, at the far end.
        assert_eq!(canvas.pixel(379, y + BAR_HEIGHT - 1), Some([255; 3]));
    }
}

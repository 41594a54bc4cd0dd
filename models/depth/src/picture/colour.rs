//! Colour ramps: a few anchor colours, blended in OKLab so that equal steps look equal.

use std::sync::LazyLock;

/// Steps of a ramp.
const STEPS: usize = 256;

/// A smooth run of colours over `0..=1`.
#[derive(Debug, Clone, PartialEq)]
pub struct Ramp {
    rgb: [[u8; 3]; STEPS],
}

/// Near to far: lightness falls steadily while the hue turns from lamplight to night sky.
const DEPTH_ANCHORS: [(f32, [u8; 3]); 8] = [
    (0.00, [255, 246, 204]),
    (0.14, [255, 208, 96]),
    (0.29, [252, 141, 60]),
    (0.44, [230, 74, 88]),
    (0.58, [178, 54, 136]),
    (0.72, [112, 62, 172]),
    (0.86, [56, 84, 178]),
    (1.00, [22, 104, 140]),
];

/// Below zero blue, zero near black, above zero orange; both ends equally light.
const SIGNED_ANCHORS: [(f32, [u8; 3]); 7] = [
    (0.00, [190, 226, 255]),
    (0.20, [72, 156, 240]),
    (0.38, [26, 66, 130]),
    (0.50, [18, 19, 22]),
    (0.62, [132, 46, 18]),
    (0.80, [244, 122, 44]),
    (1.00, [255, 222, 160]),
];

/// Brightness lost blue, none black, gained red.
const EVENT_ANCHORS: [(f32, [u8; 3]); 5] = [
    (0.00, [150, 196, 255]),
    (0.25, [52, 108, 255]),
    (0.50, [8, 8, 10]),
    (0.75, [250, 58, 48]),
    (1.00, [255, 190, 170]),
];

static DEPTH: LazyLock<Ramp> = LazyLock::new(|| Ramp::through(&DEPTH_ANCHORS));
static EVENTS: LazyLock<Ramp> = LazyLock::new(|| Ramp::through(&EVENT_ANCHORS));
static SIGNED: LazyLock<Ramp> = LazyLock::new(|| Ramp::through(&SIGNED_ANCHORS));

impl Ramp {
    /// The ramp of depth maps: 0 near and light, 1 far and dark.
    pub fn depth() -> &'static Self {
        &DEPTH
    }

    /// The ramp of signed values: 0 blue, 0.5 near black, 1 orange.
    pub fn signed() -> &'static Self {
        &SIGNED
    }

    /// The ramp of event sums: 0 blue (darker), 0.5 black, 1 red (brighter).
    pub fn events() -> &'static Self {
        &EVENTS
    }

    /// Colour at `position`, which is clamped to `0..=1`; not a number reads as 0.
    #[inline]
    pub fn at(&self, position: f32) -> [u8; 3] {
        // NaN survives the clamp and becomes 0 as an integer.
        let step = position.clamp(0.0, 1.0) * (STEPS - 1) as f32 + 0.5;
        self.rgb[(step as usize).min(STEPS - 1)]
    }

    /// Blends between anchors `(position, sRGB)`; positions rise from 0 to 1.
    fn through<const N: usize>(anchors: &[(f32, [u8; 3]); N]) -> Self {
        let lab = anchors.map(|(position, rgb)| (position, oklab_from_srgb(rgb)));
        let colour = |step: usize| {
            let position = step as f32 / (STEPS - 1) as f32;
            let upper = lab
                .partition_point(|anchor| anchor.0 < position)
                .clamp(1, lab.len() - 1);
            let ((from, a), (to, b)) = (lab[upper - 1], lab[upper]);
            let share = (position - from) / (to - from);
            srgb_from_oklab(std::array::from_fn(|i| a[i] + share * (b[i] - a[i])))
        };
        Self {
            rgb: std::array::from_fn(colour),
        }
    }
}

/// sRGB decoding (IEC 61966-2-1).
fn linear(code: u8) -> f32 {
    let value = f32::from(code) / 255.0;
    if value <= 0.04045 {
        value / 12.92
    } else {
        ((value + 0.055) / 1.055).powf(2.4)
    }
}

/// sRGB encoding, clamped to what a byte can hold.
fn encoded(value: f32) -> u8 {
    let value = value.clamp(0.0, 1.0);
    let code = if value <= 0.003_130_8 {
        12.92 * value
    } else {
        1.055 * value.powf(1.0 / 2.4) - 0.055
    };
    (code * 255.0).round() as u8
}

/// OKLab (Ottosson, "A perceptual color space for image processing", 2020).
pub(crate) fn oklab_from_srgb(rgb: [u8; 3]) -> [f32; 3] {
    let [r, g, b] = rgb.map(linear);
    let l = (0.412_221_46 * r + 0.536_332_55 * g + 0.051_445_995 * b).cbrt();
    let m = (0.211_903_5 * r + 0.680_699_5 * g + 0.107_396_96 * b).cbrt();
    let s = (0.088_302_46 * r + 0.281_718_85 * g + 0.629_978_7 * b).cbrt();
    [
        0.210_454_26 * l + 0.793_617_8 * m - 0.004_072_047 * s,
        1.977_998_5 * l - 2.428_592_2 * m + 0.450_593_7 * s,
        0.025_904_037 * l + 0.782_771_77 * m - 0.808_675_77 * s,
    ]
}

fn srgb_from_oklab([lightness, a, b]: [f32; 3]) -> [u8; 3] {
    let l = (lightness + 0.396_337_78 * a + 0.215_803_76 * b).powi(3);
    let m = (lightness - 0.105_561_346 * a - 0.063_854_17 * b).powi(3);
    let s = (lightness - 0.089_484_18 * a - 1.291_485_5 * b).powi(3);
    [
        encoded(4.076_741_7 * l - 3.307_711_6 * m + 0.230_969_94 * s),
        encoded(-1.268_438 * l + 2.609_757_4 * m - 0.341_319_38 * s),
        encoded(-0.004_196_086_3 * l - 0.703_418_6 * m + 1.707_614_7 * s),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lightness(rgb: [u8; 3]) -> f32 {
        oklab_from_srgb(rgb)[0]
    }

    #[test]
    fn oklab_there_and_back_keeps_every_code() {
        for r in (0..=255).step_by(15) {
            for g in (0..=255).step_by(15) {
                for b in (0..=255).step_by(15) {
                    let rgb = [r, g, b];
                    assert_eq!(srgb_from_oklab(oklab_from_srgb(rgb)), rgb);
                }
            }
        }
        // Published check values: white is (1, 0, 0).
        let [l, a, b] = oklab_from_srgb([255; 3]);
        assert!((l - 1.0).abs() < 1e-4 && a.abs() < 1e-4 && b.abs() < 1e-4);
    }

    #[test]
    fn ramps_hit_their_anchors_and_clamp() {
        for (ramp, anchors) in [
            (Ramp::depth(), &DEPTH_ANCHORS[..]),
            (Ramp::signed(), &SIGNED_ANCHORS[..]),
        ] {
            assert_eq!(ramp.at(0.0), anchors[0].1);
            assert_eq!(ramp.at(1.0), anchors[anchors.len() - 1].1);
            assert_eq!(
                (ramp.at(-3.0), ramp.at(f32::NAN)),
                (ramp.at(0.0), ramp.at(0.0))
            );
            assert_eq!(ramp.at(f32::INFINITY), ramp.at(1.0));
        }
    }

    /// A reader who sees no hue still reads the depth ramp: lightness falls at every step.
    #[test]
    fn depth_lightness_falls_and_no_two_steps_are_far_apart() {
        let ramp = Ramp::depth();
        for pair in ramp.rgb.windows(2) {
            assert!(lightness(pair[1]) <= lightness(pair[0]) + 3e-3, "{pair:?}");
            let jump = (0..3)
                .map(|i| pair[0][i].abs_diff(pair[1][i]))
                .max()
                .expect("three");
            assert!(jump <= 6, "{pair:?}");
        }
    }

    #[test]
    fn the_signed_ramp_is_darkest_in_the_middle() {
        let ramp = Ramp::signed();
        let (low, mid, high) = (ramp.at(0.0), ramp.at(0.5), ramp.at(1.0));
        assert!(lightness(mid) < 0.25);
        assert!((lightness(low) - lightness(high)).abs() < 0.06);
        assert!(low[2] > low[0] && high[0] > high[2]);
    }
}

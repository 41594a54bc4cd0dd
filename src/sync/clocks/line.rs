//! A straight line through noisy points: robust, with a prior on its slope and honest variances.
//!
//! Arithmetic is `f64` addition, multiplication, division and square root only, in a fixed order,
//! so the same points give the same line on every machine.

/// One point of the line: `y` observed at `x`, both nanoseconds from the caller's origin.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Point {
    pub x: f64,
    pub y: f64,
    /// Noise of this point relative to the others; 1 for the typical one.
    pub scale: f64,
}

/// What is believed about the line before the points are seen.
#[derive(Debug, Clone, Copy)]
pub(super) struct Prior {
    pub slope: f64,
    pub slope_sd: f64,
    /// Slopes outside plus or minus this are not credible for an oscillator.
    pub slope_limit: f64,
    /// Expected noise of a point with scale 1, nanoseconds.
    pub noise: f64,
    /// How many points that expectation is worth.
    pub noise_weight: f64,
    /// Noise is never taken to be below this, nanoseconds.
    pub noise_floor: f64,
}

/// The fitted line and how well it is known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Line {
    /// Centre of gravity of the points used.
    pub x: f64,
    /// Height of the line there.
    pub y: f64,
    pub slope: f64,
    /// Standard deviation of a point with scale 1.
    pub noise: f64,
    /// Standard deviation of `y`.
    pub y_sd: f64,
    /// Standard deviation of `slope`.
    pub slope_sd: f64,
    /// Degrees of freedom behind `noise`, the prior's included.
    pub freedom: f64,
    /// Points the line was fitted to.
    pub used: usize,
}

impl Line {
    /// Height at `x`.
    pub fn at(&self, x: f64) -> f64 {
        self.y + self.slope * (x - self.x)
    }

    /// Standard deviation of the height at `x`.
    pub fn sd_at(&self, x: f64) -> f64 {
        let lever = self.slope_sd * (x - self.x);
        (self.y_sd * self.y_sd + lever * lever).sqrt()
    }

    /// Two-sided 99 % factor for `sd_at`: the normal quantile, widened for few degrees of freedom
    /// as Student's t is (first term of its Cornish-Fisher expansion, Abramowitz & Stegun 26.7.5).
    /// A fifth is added for noise that is neither quite normal nor quite independent.
    pub fn quantile(&self) -> f64 {
        const NORMAL: f64 = 2.576;
        const MARGIN: f64 = 1.2;
        let widening = (NORMAL * NORMAL * NORMAL + NORMAL) / (4.0 * self.freedom.max(1.0));
        MARGIN * (NORMAL + widening)
    }
}

/// A point is an outlier when it is further from the line than this many noise deviations.
pub(super) const REJECT: f64 = 6.0;
/// Rounds of rejecting and fitting again; the set of outliers settles in two or three.
const ROUNDS: usize = 4;

/// Fits a line to `points`, starting from `start` (height at the origin, slope) and rejecting
/// outliers; `scratch` needs room for as many values as there are points.
///
/// `None` when no point is left or the arithmetic does not stay finite.
pub(super) fn fit(
    points: &[Point],
    start: Option<(f64, f64)>,
    prior: &Prior,
    scratch: &mut Vec<f64>,
) -> Option<Line> {
    let (mut slope, mut height) = match start {
        Some((height, slope)) => (slope, height),
        None => {
            let slope = prior.slope;
            scratch.clear();
            scratch.extend(points.iter().map(|p| p.y - slope * p.x));
            (slope, median(scratch)?)
        }
    };
    let mut line = None;
    for _ in 0..ROUNDS {
        scratch.clear();
        scratch.extend(
            points
                .iter()
                .map(|p| (p.y - height - slope * p.x).abs() / p.scale),
        );
        // 1.4826: ratio of standard deviation to median absolute deviation of a normal variable.
        let spread = (1.4826 * median(scratch)?).max(prior.noise_floor);
        let limit = REJECT * spread;
        let fitted = weighted(points, prior, |p| {
            (p.y - height - slope * p.x).abs() <= limit * p.scale
        })?;
        (slope, height) = (fitted.slope, fitted.at(0.0));
        line = Some(fitted);
    }
    line
}

/// One weighted least-squares fit over the points that `keep` admits.
fn weighted(points: &[Point], prior: &Prior, keep: impl Fn(&Point) -> bool) -> Option<Line> {
    let kept = || points.iter().filter(|p| keep(p));
    let (mut sum, mut x, mut y, mut used) = (0.0, 0.0, 0.0, 0_usize);
    for p in kept() {
        let w = 1.0 / (p.scale * p.scale);
        (sum, x, y, used) = (sum + w, x + w * p.x, y + w * p.y, used + 1);
    }
    if used == 0 {
        return None;
    }
    let (x, y) = (x / sum, y / sum);
    let (mut xx, mut xy) = (0.0, 0.0);
    for p in kept() {
        let w = 1.0 / (p.scale * p.scale);
        (xx, xy) = (
            xx + w * (p.x - x) * (p.x - x),
            xy + w * (p.x - x) * (p.y - y),
        );
    }
    let prior_weight = 1.0 / (prior.slope_sd * prior.slope_sd);
    let mut noise = prior.noise.max(prior.noise_floor);
    let mut slope = prior.slope;
    let freedom = prior.noise_weight + (used.saturating_sub(2)) as f64;
    // Noise and slope depend on each other through the prior; three rounds settle both.
    for _ in 0..3 {
        let data_weight = xx / (noise * noise);
        slope = (xy / (noise * noise) + prior.slope * prior_weight) / (data_weight + prior_weight);
        slope = slope.clamp(-prior.slope_limit, prior.slope_limit);
        let squares: f64 = kept()
            .map(|p| {
                let r = (p.y - y - slope * (p.x - x)) / p.scale;
                r * r
            })
            .sum();
        let expected = prior.noise_weight * prior.noise * prior.noise;
        noise = ((expected + squares) / freedom.max(1.0))
            .sqrt()
            .max(prior.noise_floor);
    }
    let line = Line {
        x,
        y,
        slope,
        noise,
        y_sd: noise / sum.sqrt(),
        slope_sd: 1.0 / (xx / (noise * noise) + prior_weight).sqrt(),
        freedom,
        used,
    };
    (line.y.is_finite() && line.slope.is_finite() && line.slope_sd.is_finite()).then_some(line)
}

/// The middle value (the upper one of an even number); `None` of nothing. Reorders `values`.
pub(super) fn median(values: &mut [f64]) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let middle = values.len() / 2;
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    const PRIOR: Prior = Prior {
        slope: 0.0,
        slope_sd: 1e-4,
        slope_limit: 2e-4,
        noise: 10.0,
        noise_weight: 4.0,
        noise_floor: 0.1,
    };

    fn point(x: f64, y: f64) -> Point {
        Point { x, y, scale: 1.0 }
    }

    #[test]
    fn an_exact_line_is_found_and_one_far_point_does_not_move_it() {
        let mut points: Vec<Point> = (0..20)
            .map(|i| point(f64::from(i) * 1e9, 500.0 + f64::from(i) * 5e4))
            .collect();
        points[7].y += 3e6;
        let line = fit(&points, None, &PRIOR, &mut Vec::new()).unwrap();
        assert_eq!(line.used, 19);
        assert!((line.slope - 5e-5).abs() < 1e-11, "{}", line.slope);
        assert!((line.at(0.0) - 500.0).abs() < 0.1);
        assert!(line.noise < 10.0);
    }

    #[test]
    fn two_points_are_held_by_the_prior() {
        // 1 us apart after 1 ms: a slope of 1000 ppm that no oscillator has.
        let points = [point(0.0, 0.0), point(1e6, 1000.0)];
        let line = fit(&points, None, &PRIOR, &mut Vec::new()).unwrap();
        assert!(line.slope.abs() <= 2e-4);
        assert!(
            line.sd_at(1e9) > 5e4,
            "one second away the slope's doubt dominates"
        );
    }

    #[test]
    fn nothing_gives_nothing() {
        assert!(fit(&[], None, &PRIOR, &mut Vec::new()).is_none());
        assert_eq!(median(&mut []), None);
    }
}

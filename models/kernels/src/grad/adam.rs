//! One step of Adam over the values of one variable.

/// Factors of one step, the same for every variable.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdamRates {
    /// Decay of the mean of gradients.
    pub beta1: f32,
    /// Decay of the mean of squared gradients.
    pub beta2: f32,
    /// Added to the root of the corrected mean of squares.
    pub eps: f32,
    /// Factor on the gradient, for clipping.
    pub gain: f32,
    /// Learning rate over the correction of the mean.
    pub step: f32,
    /// Factor on the root of the mean of squares that corrects it.
    pub spread: f32,
}

/// Updates `weights` and their moments in place.
///
/// # Panics
/// If the slices differ in length.
pub fn adam_update(
    weights: &mut [f32],
    mean: &mut [f32],
    square: &mut [f32],
    gradient: &[f32],
    rates: AdamRates,
) {
    let len = weights.len();
    assert!(
        mean.len() == len && square.len() == len && gradient.len() == len,
        "{len} weights, moments of {} and {}, gradient of {}",
        mean.len(),
        square.len(),
        gradient.len(),
    );
    let moments = mean.iter_mut().zip(square);
    for ((w, (m, v)), g) in weights.iter_mut().zip(moments).zip(gradient) {
        let g = g * rates.gain;
        *m = rates.beta1 * *m + (1.0 - rates.beta1) * g;
        *v = rates.beta2 * *v + (1.0 - rates.beta2) * (g * g);
        *w -= rates.step * *m / (v.sqrt() * rates.spread + rates.eps);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_step_moves_by_the_learning_rate_against_the_gradient() {
        let rates = AdamRates {
            beta1: 0.9,
            beta2: 0.999,
            eps: 1e-8,
            gain: 0.5,
            step: 0.01 / 0.1,
            spread: (1.0f32 / 0.001).sqrt(),
        };
        let (mut w, mut m, mut v) = ([1.0f32, 1.0], [0.0; 2], [0.0; 2]);
        adam_update(&mut w, &mut m, &mut v, &[4.0, -0.2], rates);
        let got = w.iter().chain(&m);
        for (got, wanted) in got.zip([0.99, 1.01, 0.2, -0.01]) {
            assert!((got - wanted).abs() < 1e-5, "{got} {wanted}");
        }
    }
}

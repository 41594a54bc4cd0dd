//! The rate of learning over a stage: half a cosine, after a linear rise where one is asked for.

use std::f64::consts::PI;

use crate::settings::Stage;

/// Rate of step `step` (from 0) of the stage.
pub(super) fn rate(stage: &Stage, step: u64) -> f64 {
    let [start, end] = stage.rate;
    let share = step as f64 / stage.steps as f64;
    let cosine = end + (start - end) * 0.5 * (1.0 + (PI * share.min(1.0)).cos());
    if step < stage.warm_up {
        cosine * (step + 1) as f64 / stage.warm_up as f64
    } else {
        cosine
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::settings::Settings;

    #[test]
    fn the_rate_rises_then_falls_along_a_cosine() {
        let text = r#"
            member = "tiny"
            seed = 1
            [data]
            cache = "x"
            train = [{ tier = "A", seeds = [0, 1] }]
            validation = [{ tier = "A", seeds = [100000, 100001] }]
            [[stages]]
            kind = "2"
            steps = 100
            batch = 1
            crop = 32
            window = 1
            rate = [1e-3, 1e-5]
            warm_up = 10
            validate_every = 1
            checkpoint_every = 1
        "#;
        let settings = Settings::from_toml(text).expect("is right");
        let stage = &settings.stages[0];
        assert!(rate(stage, 0) < 1.1e-4 && rate(stage, 9) > 9e-4);
        let middle = (1e-3 + 1e-5) / 2.0;
        assert!((rate(stage, 50) - middle).abs() < 1e-12);
        assert!((rate(stage, 100) - 1e-5).abs() < 1e-12);
        assert!((10..99).all(|step| rate(stage, step) > rate(stage, step + 1)));
    }
}

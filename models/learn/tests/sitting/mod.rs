//! One sitting of a training run, which can be stopped at any step.

use std::sync::atomic::{AtomicBool, Ordering};

use noctule_learn::{Report, Run, TrainError, Validation};

/// Trains until done or until `stop_at` changes; returns losses and validations.
pub fn train(
    run: &mut Run,
    stop_at: Option<u64>,
) -> (Vec<f64>, Vec<Validation>, Result<(), TrainError>) {
    let stop = AtomicBool::new(false);
    let (mut losses, mut validations) = (Vec::new(), Vec::new());
    let outcome = run.train(&stop, &mut |report| match report {
        Report::Step(step) => {
            losses.push(step.loss);
            if Some(step.total) == stop_at {
                stop.store(true, Ordering::Relaxed);
            }
        }
        Report::Validation(found) => validations.push((*found).clone()),
        Report::Note(_) => {}
    });
    (losses, validations, outcome)
}

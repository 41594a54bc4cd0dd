//! Which model still makes the deadline: prediction by measured times, cheaper ones below.

use crate::frame::ModelId;

/// One model and what it has been seen to take.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rung {
    /// Which model.
    pub model: ModelId,
    /// Time before the first step can begin, nanoseconds.
    pub begin_ns: u64,
    /// Time of one step, nanoseconds.
    pub step_ns: u64,
}

impl Rung {
    fn sequence_ns(&self, steps: u64) -> u64 {
        self.begin_ns + steps * self.step_ns
    }
}

/// What to run now.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Choice {
    /// This model, as asked for.
    AsAsked(ModelId),
    /// This cheaper model, because time is short.
    SteppedDown(ModelId),
    /// Nothing: even the cheapest would be late.
    Stale,
}

/// The models that may run, and their predicted times.
#[derive(Debug, Clone)]
pub struct Ladder {
    // Dearest first; the first is the one asked for.
    rungs: Vec<Rung>,
    steps_down: bool,
}

impl Ladder {
    /// A ladder from `asked` down over `rungs`; rungs above it are left out.
    #[must_use]
    pub fn new(asked: ModelId, mut rungs: Vec<Rung>, steps_down: bool) -> Self {
        rungs.retain(|r| r.model <= asked);
        rungs.sort_by_key(|r| std::cmp::Reverse(r.model));
        Self { rungs, steps_down }
    }

    /// The best model for a sequence of `steps` with `left_ns` to its deadline.
    #[must_use]
    pub fn choose(&self, left_ns: u64, steps: u64) -> Choice {
        let fits = |r: &&Rung| r.sequence_ns(steps) <= left_ns;
        let among = if self.steps_down {
            &self.rungs[..]
        } else {
            &self.rungs[..1.min(self.rungs.len())]
        };
        match among.iter().find(fits) {
            Some(rung) if self.rungs.first().is_some_and(|r| r.model == rung.model) => {
                Choice::AsAsked(rung.model)
            }
            Some(rung) => Choice::SteppedDown(rung.model),
            None => Choice::Stale,
        }
    }

    /// The model to go on with after `model` fell behind, with `steps` still to go.
    #[must_use]
    pub fn rescue(&self, model: ModelId, left_ns: u64, steps: u64) -> Option<ModelId> {
        if !self.steps_down {
            return None;
        }
        let below = self.rungs.iter().filter(|r| r.model < model);
        below
            .into_iter()
            .find(|r| r.sequence_ns(steps) <= left_ns)
            .map(|r| r.model)
    }

    /// The predicted time of one more step of `model`.
    #[must_use]
    pub fn step_ns(&self, model: ModelId) -> u64 {
        self.rungs
            .iter()
            .find(|r| r.model == model)
            .map_or(0, |r| r.step_ns)
    }

    /// Learns from a sequence that ran: up at once to what it took, down slowly.
    pub fn learn(&mut self, ran: Rung) {
        if let Some(rung) = self.rungs.iter_mut().find(|r| r.model == ran.model) {
            rung.begin_ns = blend(rung.begin_ns, ran.begin_ns);
            rung.step_ns = blend(rung.step_ns, ran.step_ns);
        }
    }
}

/// Half-way up when slower than thought, an eighth of the way down when faster.
fn blend(known: u64, seen: u64) -> u64 {
    if seen > known {
        known + (seen - known).div_ceil(2)
    } else {
        known - (known - seen) / 8
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rung(model: ModelId, begin_ns: u64, step_ns: u64) -> Rung {
        Rung {
            model,
            begin_ns,
            step_ns,
        }
    }

    fn ladder(steps_down: bool) -> Ladder {
        let rungs = vec![
            rung(ModelId::Fill, 0, 10),
            rung(ModelId::Full, 100, 1000),
            rung(ModelId::Xs, 20, 100),
            rung(ModelId::Nearest, 0, 1),
        ];
        Ladder::new(ModelId::Xs, rungs, steps_down)
    }

    #[test]
    fn the_dearest_that_fits_runs_and_never_one_above_the_one_asked_for() {
        assert_eq!(ladder(true).choose(820, 8), Choice::AsAsked(ModelId::Xs));
        assert_eq!(
            ladder(true).choose(819, 8),
            Choice::SteppedDown(ModelId::Fill)
        );
        assert_eq!(
            ladder(true).choose(79, 8),
            Choice::SteppedDown(ModelId::Nearest)
        );
        assert_eq!(ladder(true).choose(7, 8), Choice::Stale);
        assert_eq!(
            ladder(true).choose(u64::MAX, 8),
            Choice::AsAsked(ModelId::Xs)
        );
    }

    #[test]
    fn without_stepping_down_it_is_the_one_asked_for_or_nothing() {
        assert_eq!(ladder(false).choose(820, 8), Choice::AsAsked(ModelId::Xs));
        assert_eq!(ladder(false).choose(819, 8), Choice::Stale);
        assert_eq!(ladder(false).rescue(ModelId::Xs, u64::MAX, 1), None);
    }

    #[test]
    fn a_sequence_that_falls_behind_goes_on_with_a_cheaper_model() {
        assert_eq!(ladder(true).rescue(ModelId::Xs, 45, 4), Some(ModelId::Fill));
        assert_eq!(
            ladder(true).rescue(ModelId::Xs, 39, 4),
            Some(ModelId::Nearest)
        );
        assert_eq!(ladder(true).rescue(ModelId::Xs, 3, 4), None);
    }

    #[test]
    fn predictions_follow_slowness_faster_than_speed() {
        let mut ladder = ladder(true);
        ladder.learn(rung(ModelId::Xs, 20, 300));
        assert_eq!(ladder.step_ns(ModelId::Xs), 200);
        ladder.learn(rung(ModelId::Xs, 20, 120));
        assert_eq!(ladder.step_ns(ModelId::Xs), 190);
    }
}

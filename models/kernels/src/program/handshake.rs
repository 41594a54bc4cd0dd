//! Every interleaving of the barrier's handshake, explored as a model: no thread passes before all
//! have arrived, and none sleeps for ever.
//!
//! The model takes the barrier's shared accesses one by one, each visible to all at once; the
//! fences of the real one see to that where it matters, between counting a sleeper and reading the
//! turn. Sleeping threads are never woken by chance here, so that a lost wake shows as a deadlock.

use std::collections::HashSet;

/// Where a thread stands in `Barrier::wait`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum At {
    Enter,
    Arrive,
    ResetArrived,
    NextTurn,
    WakeAll,
    Spin,
    CountSleeper,
    AskTurn,
    FallAsleep,
    Asleep,
    UncountSleeper,
    Done,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct State {
    arrived: usize,
    turn: usize,
    sleepers: usize,
    /// Per thread: where it is, the turn it read, and how often it has arrived and passed.
    threads: Vec<(At, usize, usize, usize)>,
}

/// What the kernel does when asked to let a thread sleep.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Kernel {
    /// Compares the word first, in one step with falling asleep.
    Compares,
    /// A faulty one, to show that the search finds what goes wrong.
    SleepsBlindly,
}

/// Rounds every thread goes through.
const ROUNDS: usize = 2;

impl State {
    fn start(count: usize) -> Self {
        Self {
            arrived: 0,
            turn: 0,
            sleepers: 0,
            threads: vec![(At::Enter, 0, 0, 0); count],
        }
    }

    /// The state after thread `index` has taken its next step; `None` where it cannot.
    fn after(&self, index: usize, kernel: Kernel) -> Option<Self> {
        let mut next = self.clone();
        let (at, turn, arrivals, _) = &mut next.threads[index];
        let changed = self.turn != *turn;
        *at = match *at {
            At::Enter => {
                *turn = self.turn;
                At::Arrive
            }
            At::Arrive => {
                next.arrived += 1;
                *arrivals += 1;
                if next.arrived == self.threads.len() {
                    At::ResetArrived
                } else {
                    At::Spin
                }
            }
            At::ResetArrived => {
                next.arrived = 0;
                At::NextTurn
            }
            At::NextTurn => {
                next.turn += 1;
                At::WakeAll
            }
            At::WakeAll => {
                if self.sleepers != 0 {
                    for (at, ..) in &mut next.threads {
                        if *at == At::Asleep {
                            *at = At::AskTurn;
                        }
                    }
                }
                return Some(next.passed(index));
            }
            // It may see the change in time or give up just before it.
            At::Spin if changed => return Some(next.passed(index)),
            At::Spin => At::CountSleeper,
            At::CountSleeper => {
                next.sleepers += 1;
                At::AskTurn
            }
            At::AskTurn if changed => At::UncountSleeper,
            At::AskTurn => At::FallAsleep,
            At::FallAsleep if changed && kernel == Kernel::Compares => At::AskTurn,
            At::FallAsleep => At::Asleep,
            At::UncountSleeper => {
                next.sleepers -= 1;
                return Some(next.passed(index));
            }
            At::Asleep | At::Done => return None,
        };
        Some(next)
    }

    /// Thread `index` leaves the barrier.
    fn passed(mut self, index: usize) -> Self {
        let (at, _, arrivals, passes) = &mut self.threads[index];
        *passes += 1;
        *at = if *passes == ROUNDS {
            At::Done
        } else {
            At::Enter
        };
        let passes = *passes;
        assert_eq!(*arrivals, passes);
        let late = self.threads.iter().find(|thread| thread.2 < passes);
        assert!(
            late.is_none(),
            "one passed before another arrived: {self:?}"
        );
        self
    }

    fn is_done(&self) -> bool {
        self.threads.iter().all(|thread| thread.0 == At::Done)
    }
}

/// States reached, and those of them in which nobody can go on though not all are done.
fn explore(count: usize, kernel: Kernel) -> (usize, Vec<State>) {
    let mut seen = HashSet::from([State::start(count)]);
    let mut open = vec![State::start(count)];
    let mut stuck = Vec::new();
    while let Some(state) = open.pop() {
        let steps = (0..count).filter_map(|index| state.after(index, kernel));
        let steps: Vec<State> = steps.collect();
        if steps.is_empty() && !state.is_done() {
            stuck.push(state);
        }
        for step in steps {
            if seen.insert(step.clone()) {
                open.push(step);
            }
        }
    }
    (seen.len(), stuck)
}

#[test]
fn no_interleaving_passes_early_or_sleeps_for_ever() {
    for count in [2, 3] {
        let (states, stuck) = explore(count, Kernel::Compares);
        assert!(states > 100, "{states} states of {count} threads");
        assert!(stuck.is_empty(), "{:?}", stuck[0]);
    }
}

#[test]
fn the_search_finds_a_kernel_that_does_not_compare() {
    let (_, stuck) = explore(2, Kernel::SleepsBlindly);
    assert!(
        stuck
            .iter()
            .any(|s| s.threads.iter().any(|t| t.0 == At::Asleep))
    );
}

//! The threads that work on one program together, the barrier between its operations, and how
//! they share one operation's work.
//!
//! The caller is the first of the crew; the others are spawned once, each bound to a processor
//! of its own. Who waits spins for a while and then sleeps, the caller too: on a busy machine the
//! thread it waits for may need its processor. Nothing here allocates or locks after the crew
//! stands.

use std::cell::UnsafeCell;
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicUsize, Ordering, fence};
use std::thread::{self, JoinHandle};

use rustix::thread::{CpuSet, futex, sched_getaffinity, sched_setaffinity};

/// Turns of the waiting loop before a thread gives up its processor.
const SPINS: u32 = 4000;

/// A counter on a cache line of its own.
#[repr(align(64))]
struct Apart<T>(T);

/// Parts of the share that one thread claims at a time.
const PARTS: usize = 8;

/// Who does which units of one operation. Every thread has a share, the same whenever it runs, so
/// that it finds in its caches what it wrote before; whoever has finished helps the others, so
/// that one thread's losing its processor does not hold up all.
pub(crate) struct Claims {
    units: usize,
    /// Parts claimed, per share.
    ///
    /// INVARIANT: zero whenever no thread works on the operation.
    taken: Vec<Apart<AtomicUsize>>,
}

impl Claims {
    pub(crate) fn new(units: usize, threads: usize) -> Self {
        Self {
            units,
            taken: (0..threads).map(|_| Apart(AtomicUsize::new(0))).collect(),
        }
    }

    /// Calls `work` with ranges of units until all are claimed; over all threads that call this
    /// between two barriers, every unit is handed out once.
    pub(crate) fn each(&self, thread: usize, mut work: impl FnMut(Range<usize>)) {
        let threads = self.taken.len();
        if threads == 1 {
            return work(0..self.units);
        }
        let start = |share| self.units * share / threads;
        for share in (thread..threads).chain(0..thread) {
            let (from, to) = (start(share), start(share + 1));
            let part = (to - from).div_ceil(PARTS).max(1);
            loop {
                // Relaxed: which thread works where orders nothing; the barriers do.
                let taken = self.taken[share].0.fetch_add(1, Ordering::Relaxed);
                let first = from + taken * part;
                if first >= to {
                    break;
                }
                work(first..to.min(first + part));
            }
        }
    }

    /// Makes everything claimable again; no thread works on the operation.
    pub(crate) fn reset(&self) {
        for taken in &self.taken {
            taken.0.store(0, Ordering::Relaxed);
        }
    }
}

/// A point all threads reach before any goes on.
pub(crate) struct Barrier {
    count: usize,
    arrived: Apart<AtomicUsize>,
    /// Counts the times all have arrived; the word sleepers sleep on.
    turn: Apart<AtomicU32>,
    /// Threads asleep, or about to be.
    sleepers: AtomicU32,
}

impl Barrier {
    fn new(count: usize) -> Self {
        Self {
            count,
            arrived: Apart(AtomicUsize::new(0)),
            turn: Apart(AtomicU32::new(0)),
            sleepers: AtomicU32::new(0),
        }
    }

    /// Returns once all threads have called it.
    pub(crate) fn wait(&self) {
        if self.count == 1 {
            return;
        }
        // The turn cannot change before this thread has arrived.
        let turn = self.turn.0.load(Ordering::Relaxed);
        // AcqRel: the last to arrive sees what all others wrote before they arrived.
        if self.arrived.0.fetch_add(1, Ordering::AcqRel) + 1 == self.count {
            self.arrived.0.store(0, Ordering::Relaxed);
            self.advance();
        } else {
            self.await_change(turn);
        }
    }

    /// Starts the next turn and wakes who sleeps.
    fn advance(&self) {
        // Release pairs with the Acquire in `await_change`.
        self.turn.0.fetch_add(1, Ordering::Release);
        // Pairs with the fence of a thread about to sleep: either the kernel finds the new turn
        // when it is asked to let that thread sleep, or the sleeper is counted here.
        fence(Ordering::SeqCst);
        if self.sleepers.load(Ordering::Relaxed) != 0 {
            // A wake that fails has nobody to wake.
            let _woken = futex::wake(
                &self.turn.0,
                futex::Flags::PRIVATE,
                i32::MAX.cast_unsigned(),
            );
        }
    }

    fn await_change(&self, turn: u32) {
        for _ in 0..SPINS {
            if self.turn.0.load(Ordering::Acquire) != turn {
                return;
            }
            std::hint::spin_loop();
        }
        self.sleepers.fetch_add(1, Ordering::Relaxed);
        fence(Ordering::SeqCst); // pairs with the fence in `advance`
        while self.turn.0.load(Ordering::Acquire) == turn {
            // Returns at once if the turn has changed; for any other reason the loop asks again.
            let _woken = futex::wait(&self.turn.0, futex::Flags::PRIVATE, turn, None);
        }
        self.sleepers.fetch_sub(1, Ordering::Relaxed);
    }
}

/// What one run of the crew calls: a function over data on the caller's stack.
#[derive(Clone, Copy)]
struct Job {
    data: *const (),
    call: unsafe fn(*const (), usize, &Barrier),
}

struct Shared {
    barrier: Barrier,
    /// INVARIANT: written by the caller alone, and only while every worker waits at the barrier.
    job: UnsafeCell<Option<Job>>,
    stop: AtomicBool,
}

// SAFETY: the barrier orders every write of `job` before its reads and after the last ones; the
// data a job points to is `Sync` and outlives the run (see `Crew::run`).
unsafe impl Send for Shared {}
// SAFETY: as above.
unsafe impl Sync for Shared {}

/// The caller and the workers beside it.
pub(crate) struct Crew {
    shared: Arc<Shared>,
    workers: Vec<JoinHandle<()>>,
}

/// Ends the process if a worker panics: the others would wait for it for ever.
struct AbortOnPanic;

impl Drop for AbortOnPanic {
    fn drop(&mut self) {
        if thread::panicking() {
            std::process::abort();
        }
    }
}

impl Crew {
    /// A crew of `count` threads, the caller's among them.
    pub(crate) fn new(count: usize) -> std::io::Result<Self> {
        let shared = Arc::new(Shared {
            barrier: Barrier::new(count),
            job: UnsafeCell::new(None),
            stop: AtomicBool::new(false),
        });
        let mut crew = Self {
            shared,
            workers: Vec::with_capacity(count.saturating_sub(1)),
        };
        for index in 1..count {
            let shared = Arc::clone(&crew.shared);
            let worker = thread::Builder::new()
                .name(format!("kernels-{index}"))
                .spawn(move || work(&shared, index));
            match worker {
                Ok(worker) => crew.workers.push(worker),
                Err(error) => {
                    crew.dismiss_unstarted(count);
                    return Err(error);
                }
            }
        }
        Ok(crew)
    }

    /// Lets the workers of an incomplete crew go: those missing are counted as arrived.
    fn dismiss_unstarted(&mut self, count: usize) {
        let missing = count - 1 - self.workers.len();
        let barrier = &self.shared.barrier;
        barrier.arrived.0.fetch_add(missing, Ordering::AcqRel);
    }

    /// Calls `f` on every thread with its index and the barrier; returns when all are done.
    pub(crate) fn run<F: Fn(usize, &Barrier) + Sync>(&mut self, f: &F) {
        unsafe fn call<F: Fn(usize, &Barrier)>(data: *const (), index: usize, barrier: &Barrier) {
            // SAFETY: `data` is the `f` of the run that is going on.
            unsafe { (*data.cast::<F>())(index, barrier) }
        }
        let guard = AbortOnPanic;
        if self.workers.is_empty() {
            f(0, &self.shared.barrier);
        } else {
            let job = Job {
                data: std::ptr::from_ref(f).cast(),
                call: call::<F>,
            };
            // SAFETY: every worker waits at the first barrier of `work`, before its read.
            unsafe { *self.shared.job.get() = Some(job) };
            self.shared.barrier.wait();
            f(0, &self.shared.barrier);
            self.shared.barrier.wait(); // no worker uses `f` beyond this point
        }
        drop(guard);
    }
}

impl Drop for Crew {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
        if !self.workers.is_empty() {
            self.shared.barrier.wait();
        }
        for worker in self.workers.drain(..) {
            // A worker that panicked has ended the process already.
            let _ended = worker.join();
        }
    }
}

fn work(shared: &Shared, index: usize) {
    let _guard = AbortOnPanic;
    bind(index);
    loop {
        shared.barrier.wait();
        if shared.stop.load(Ordering::Acquire) {
            return;
        }
        // SAFETY: the caller wrote the job before it arrived at the barrier just passed, and
        // writes no other before the one below.
        let job = unsafe { *shared.job.get() };
        if let Some(job) = job {
            // SAFETY: the caller waits at the barrier below, so the data is alive.
            unsafe { (job.call)(job.data, index, &shared.barrier) };
        }
        shared.barrier.wait();
    }
}

/// Binds this thread to the `index`-th of the processors it may use, from the last one down so
/// that the caller keeps the first; does nothing where there are too few or it is not allowed.
fn bind(index: usize) {
    let Ok(allowed) = sched_getaffinity(None) else {
        return;
    };
    let mut processors = (0..CpuSet::MAX_CPU)
        .rev()
        .filter(|cpu| allowed.is_set(*cpu));
    if let Some(cpu) = processors.nth(index - 1) {
        let mut one = CpuSet::new();
        one.set(cpu);
        // Unbound workers are slower, not wrong.
        let _bound = sched_setaffinity(None, &one);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_thread_passes_every_barrier_in_step() {
        let mut crew = Crew::new(3).unwrap();
        let counts: Vec<AtomicUsize> = (0..50).map(|_| AtomicUsize::new(0)).collect();
        for run in 1..=20 {
            crew.run(&|_, barrier: &Barrier| {
                for count in &counts {
                    count.fetch_add(1, Ordering::Relaxed);
                    barrier.wait();
                    assert_eq!(count.load(Ordering::Relaxed), 3 * run);
                    barrier.wait();
                }
            });
        }
    }

    #[test]
    fn claims_hand_out_every_unit_once() {
        for threads in 1..=4 {
            let mut crew = Crew::new(threads).unwrap();
            for units in [0, 1, 2, 3, 7, 16, 33, 256] {
                let claims = Claims::new(units, threads);
                let counts: Vec<AtomicUsize> = (0..units).map(|_| AtomicUsize::new(0)).collect();
                for run in 1..=3 {
                    crew.run(&|thread, _: &Barrier| {
                        claims.each(thread, |range| {
                            for unit in range {
                                counts[unit].fetch_add(1, Ordering::Relaxed);
                            }
                        });
                    });
                    claims.reset();
                    assert!(counts.iter().all(|c| c.load(Ordering::Relaxed) == run));
                }
            }
        }
    }

    #[test]
    fn a_thread_that_is_held_up_is_helped() {
        let mut crew = Crew::new(2).unwrap();
        let claims = Claims::new(64, 2);
        let done = AtomicUsize::new(0);
        crew.run(&|thread, _: &Barrier| {
            claims.each(thread, |range| {
                // The worker holds its first part until the caller has done everything else.
                let count = range.len();
                while thread == 1 && done.load(Ordering::Relaxed) < 60 {
                    std::hint::spin_loop();
                }
                done.fetch_add(count, Ordering::Relaxed);
            });
        });
        assert_eq!(done.load(Ordering::Relaxed), 64);
    }

    #[test]
    fn sleeping_workers_wake() {
        let mut crew = Crew::new(2).unwrap();
        let sum = AtomicUsize::new(0);
        for _ in 0..5 {
            thread::sleep(std::time::Duration::from_millis(5));
            crew.run(&|index, _: &Barrier| {
                sum.fetch_add(index + 1, Ordering::Relaxed);
            });
        }
        assert_eq!(sum.load(Ordering::Relaxed), 15);
    }
}

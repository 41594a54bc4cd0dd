//! The threads that work on one program together, and the barrier between its operations.
//!
//! The caller is the first of the crew; the others are spawned once, each bound to a processor
//! of its own, and wait by spinning for a while and then parking. Nothing here allocates or locks
//! after the crew stands.

use std::cell::UnsafeCell;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicUsize, Ordering, fence};
use std::sync::{Arc, OnceLock};
use std::thread::{self, JoinHandle, Thread};

use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

/// Turns of the waiting loop before a thread gives up its processor.
const SPINS: u32 = 4000;

/// A point all threads reach before any goes on.
pub(crate) struct Barrier {
    count: usize,
    arrived: AtomicUsize,
    turn: AtomicU32,
    /// Which workers sleep; index 0, the caller's, stays false.
    parked: Vec<AtomicBool>,
    /// The workers, from index 1.
    threads: OnceLock<Vec<Thread>>,
}

impl Barrier {
    fn new(count: usize) -> Self {
        Self {
            count,
            arrived: AtomicUsize::new(0),
            turn: AtomicU32::new(0),
            parked: (0..count).map(|_| AtomicBool::new(false)).collect(),
            threads: OnceLock::new(),
        }
    }

    /// Returns once all threads have called it; `index` is the caller's place in the crew.
    pub(crate) fn wait(&self, index: usize) {
        if self.count == 1 {
            return;
        }
        // The turn cannot change before this thread has arrived.
        let turn = self.turn.load(Ordering::Relaxed);
        // AcqRel: the last to arrive sees what all others wrote before they arrived.
        if self.arrived.fetch_add(1, Ordering::AcqRel) + 1 == self.count {
            self.arrived.store(0, Ordering::Relaxed);
            self.advance();
        } else {
            self.await_change(index, turn);
        }
    }

    /// Starts the next turn and wakes who sleeps.
    fn advance(&self) {
        // Release pairs with the Acquire in `await_change`.
        self.turn.fetch_add(1, Ordering::Release);
        // Pairs with the fence of a thread about to sleep: either it sees the new turn, or its
        // flag is seen here.
        fence(Ordering::SeqCst);
        let threads = self.threads.get().map_or(&[][..], Vec::as_slice);
        for (parked, thread) in self.parked.iter().skip(1).zip(threads) {
            if parked.swap(false, Ordering::Relaxed) {
                thread.unpark();
            }
        }
    }

    fn await_change(&self, index: usize, turn: u32) {
        for _ in 0..SPINS {
            if self.turn.load(Ordering::Acquire) != turn {
                return;
            }
            std::hint::spin_loop();
        }
        while self.turn.load(Ordering::Acquire) == turn {
            if index == 0 {
                thread::yield_now();
                continue;
            }
            self.parked[index].store(true, Ordering::Relaxed);
            fence(Ordering::SeqCst); // pairs with the fence in `advance`
            if self.turn.load(Ordering::Acquire) == turn {
                thread::park();
            }
            self.parked[index].store(false, Ordering::Relaxed);
        }
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
        let threads = crew.workers.iter().map(|w| w.thread().clone()).collect();
        crew.shared.barrier.threads.get_or_init(|| threads);
        Ok(crew)
    }

    /// Lets the workers of an incomplete crew go: those missing are counted as arrived.
    fn dismiss_unstarted(&mut self, count: usize) {
        let threads = self.workers.iter().map(|w| w.thread().clone()).collect();
        self.shared.barrier.threads.get_or_init(|| threads);
        let missing = count - 1 - self.workers.len();
        let barrier = &self.shared.barrier;
        barrier.arrived.fetch_add(missing, Ordering::AcqRel);
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
            self.shared.barrier.wait(0);
            f(0, &self.shared.barrier);
            self.shared.barrier.wait(0); // no worker uses `f` beyond this point
        }
        drop(guard);
    }
}

impl Drop for Crew {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
        if !self.workers.is_empty() {
            self.shared.barrier.wait(0);
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
        shared.barrier.wait(index);
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
        shared.barrier.wait(index);
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
            crew.run(&|index, barrier: &Barrier| {
                for count in &counts {
                    count.fetch_add(1, Ordering::Relaxed);
                    barrier.wait(index);
                    assert_eq!(count.load(Ordering::Relaxed), 3 * run);
                    barrier.wait(index);
                }
            });
        }
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

//! Threads that make batches ahead of the trainer, and hand them over in order.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, sync_channel};
use std::thread::JoinHandle;

use super::cutter::Cutter;
use super::{Batch, BatchError, Recipe};

/// Batches each thread keeps ready.
const AHEAD: usize = 2;

type Made = Result<Batch, BatchError>;

/// Hands out batches from a given number on; thread `i` of `n` makes every `n`-th.
pub struct Loader {
    lanes: Vec<Receiver<Made>>,
    threads: Vec<JoinHandle<()>>,
    next: u64,
}

impl Loader {
    /// Starts `threads` threads (at least one) at batch `first`.
    pub fn new(recipe: Arc<Recipe>, first: u64, threads: usize) -> Self {
        let threads_count = threads.max(1) as u64;
        let mut loader = Self {
            lanes: Vec::new(),
            threads: Vec::new(),
            next: 0,
        };
        for offset in 0..threads_count {
            let (sender, receiver) = sync_channel::<Made>(AHEAD);
            let recipe = Arc::clone(&recipe);
            loader.lanes.push(receiver);
            loader.threads.push(std::thread::spawn(move || {
                let mut cutter = match Cutter::new(recipe.stage.crop, recipe.depth_max_m) {
                    Ok(cutter) => cutter,
                    Err(error) => {
                        let _ = sender.send(Err(error.into()));
                        return;
                    }
                };
                for number in (first + offset..).step_by(threads_count as usize) {
                    let made = recipe.make(number, &mut cutter);
                    let is_last = made.is_err();
                    // The receiver is gone when nobody wants batches any more.
                    if sender.send(made).is_err() || is_last {
                        return;
                    }
                }
            }));
        }
        loader
    }

    /// The next batch; waits for it.
    ///
    /// # Errors
    /// [`BatchError`], when it could not be made.
    pub fn next_batch(&mut self) -> Made {
        let lane = (self.next % self.lanes.len() as u64) as usize;
        self.next += 1;
        self.lanes[lane].recv().unwrap_or(Err(BatchError::Ended))
    }
}

impl Drop for Loader {
    fn drop(&mut self) {
        self.lanes.clear(); // threads end at their next hand-over
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

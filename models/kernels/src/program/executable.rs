//! What a program runs, whatever it was compiled for.

use super::crew::Barrier;
use super::profile::Watch;
use crate::layout::Frame;

/// Operations of one number format, compiled for one instruction set.
pub(crate) trait Executable: Send + Sync {
    /// Works on this thread's share of every operation of `pass`.
    ///
    /// # Safety
    /// The processor has the instructions; `frame` holds the arena the operations were placed
    /// in, this thread's scratch, and slices as long as described; all threads of the barrier
    /// call this with the same pass.
    unsafe fn run(&self, pass: usize, frame: &Frame, thread: usize, barrier: &Barrier);

    /// As [`Executable::run`], with a barrier around every operation and the time between them
    /// taken down.
    ///
    /// # Safety
    /// As for `run`.
    unsafe fn run_watched(&self, pass: usize, frame: &Frame, thread: usize, watch: &Watch<'_>);

    /// Makes `pass` ready to run again; no thread runs it.
    fn reset(&self, pass: usize);

    /// The operations of `pass`, in order.
    fn operations(&self, pass: usize) -> Vec<usize>;

    fn variant_count(&self) -> usize;

    fn weight_bytes(&self) -> usize;
}

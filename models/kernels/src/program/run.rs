//! A finished program, and its runs.

use thiserror::Error;

use super::builder::Needs;
use super::crew::{Barrier, Crew};
use super::executable::Executable;
use super::profile::{OpProfile, Times};
use crate::isa::Isa;
use crate::layout::{Frame, SLOTS};
use crate::memory::Memory;

/// Why a program could not run on the slices it was given.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum RunError {
    /// There is no such pass.
    #[error("pass {actual} asked of a program of {count}")]
    Pass {
        /// The pass asked for.
        actual: usize,
        /// Passes there are.
        count: usize,
    },
    /// No convolution has that many biases.
    #[error("variant {actual} asked of a program of {count}")]
    Variant {
        /// The variant asked for.
        actual: usize,
        /// Variants there are.
        count: usize,
    },
    /// A slice the pass needs is missing or of the wrong length.
    #[error("{kind} {index} has {actual} values, wanted {wanted}")]
    Slice {
        /// Whether it is an input or an output.
        kind: &'static str,
        /// Its place in the list.
        index: usize,
        /// Its length; 0 where it is missing.
        actual: usize,
        /// The length wanted.
        wanted: usize,
    },
}

/// Kernels in order, with their weights, their arena and their threads.
pub struct Program {
    pub(super) executable: Box<dyn Executable>,
    pub(super) arena: Memory,
    pub(super) scratch_start: usize,
    pub(super) scratch_bytes: usize,
    pub(super) crew: Crew,
    pub(super) isa: Isa,
    /// Per pass: the slices needed, and their lengths.
    pub(super) needs: Vec<Needs>,
    /// Per operation, what profiles say but for the time.
    pub(super) costs: Vec<OpProfile>,
}

/// The frame as seen by one thread; it is handed to the crew.
struct Shared<'a> {
    frame: Frame,
    executable: &'a dyn Executable,
}

// SAFETY: the pointers of the frame are used by the operations alone, which split the rows
// between the threads and keep a barrier between dependent operations.
unsafe impl Sync for Shared<'_> {}

impl Shared<'_> {
    /// The frame with the scratch at `scratch` bytes from the arena's start.
    fn of_thread(&self, scratch: usize) -> Frame {
        let mut frame = self.frame;
        // SAFETY: the arena ends with one scratch per thread of the crew.
        frame.scratch = unsafe { frame.arena.add(scratch) };
        frame
    }
}

impl Program {
    /// Runs one pass. `variant` chooses among the biases of convolutions that have several.
    ///
    /// Only the slices the pass reads or writes must have their length; others may be empty. A
    /// refused call has changed nothing. Allocates nothing.
    pub fn run(
        &mut self,
        pass: usize,
        variant: usize,
        inputs: &[&[f32]],
        outputs: &mut [&mut [f32]],
    ) -> Result<(), RunError> {
        let frame = self.frame(pass, variant, inputs, outputs)?;
        let shared = Shared {
            frame,
            executable: &*self.executable,
        };
        let (start, bytes) = (self.scratch_start, self.scratch_bytes);
        let shared = &shared;
        self.crew.run(&|thread: usize, barrier: &Barrier| {
            let frame = shared.of_thread(start + thread * bytes);
            // SAFETY: the arena is the one the operations were placed in, the slices have been
            // checked, and the instructions were when the program was built.
            unsafe { shared.executable.run(pass, &frame, thread, barrier) };
        });
        self.executable.reset(pass);
        Ok(())
    }

    /// Runs one pass `repeats` times, at least once, with a barrier around every operation;
    /// returns the operations in order with the shortest time of each. State advances as it does
    /// in as many runs. This allocates; [`Program::run`] is not slowed by it.
    pub fn profile(
        &mut self,
        pass: usize,
        variant: usize,
        inputs: &[&[f32]],
        outputs: &mut [&mut [f32]],
        repeats: usize,
    ) -> Result<Vec<OpProfile>, RunError> {
        let frame = self.frame(pass, variant, inputs, outputs)?;
        let shared = Shared {
            frame,
            executable: &*self.executable,
        };
        let operations = shared.executable.operations(pass);
        let times = Times::new(operations.len());
        let (start, bytes) = (self.scratch_start, self.scratch_bytes);
        let (shared, times_ref) = (&shared, &times);
        for _ in 0..repeats.max(1) {
            self.crew.run(&|thread: usize, barrier: &Barrier| {
                let frame = shared.of_thread(start + thread * bytes);
                let watch = times_ref.watch(barrier);
                // SAFETY: as in `run`.
                unsafe {
                    shared.executable.run_watched(pass, &frame, thread, &watch);
                }
            });
            shared.executable.reset(pass);
        }
        let of = |(&operation, seconds): (&usize, f64)| OpProfile {
            pass,
            seconds,
            ..self.costs[operation].clone()
        };
        Ok(operations.iter().zip(times.seconds()).map(of).collect())
    }

    /// Checks a call and says where its slices are.
    fn frame(
        &mut self,
        pass: usize,
        variant: usize,
        inputs: &[&[f32]],
        outputs: &mut [&mut [f32]],
    ) -> Result<Frame, RunError> {
        let Some(needs) = self.needs.get(pass) else {
            let count = self.needs.len();
            return Err(RunError::Pass {
                actual: pass,
                count,
            });
        };
        let count = self.executable.variant_count();
        if variant >= count {
            return Err(RunError::Variant {
                actual: variant,
                count,
            });
        }
        let check = |kind, index: usize, actual: usize, wanted: usize| {
            if actual == wanted {
                return Ok(());
            }
            Err(RunError::Slice {
                kind,
                index,
                actual,
                wanted,
            })
        };
        let mut frame = Frame {
            arena: self.arena.as_mut_ptr(),
            scratch: std::ptr::null_mut(),
            inputs: [std::ptr::null(); SLOTS],
            outputs: [std::ptr::null_mut(); SLOTS],
            variant,
        };
        for &(index, wanted) in &needs.inputs {
            let slice = inputs.get(index).copied().unwrap_or_default();
            check("input", index, slice.len(), wanted)?;
            frame.inputs[index] = slice.as_ptr();
        }
        for &(index, wanted) in &needs.outputs {
            let actual = outputs.get(index).map_or(0, |slice| slice.len());
            check("output", index, actual, wanted)?;
            frame.outputs[index] = outputs[index].as_mut_ptr();
        }
        Ok(frame)
    }

    /// The instructions the program was compiled for.
    pub fn isa(&self) -> Isa {
        self.isa
    }

    /// Bytes of the arena, working memory of the threads included.
    pub fn arena_bytes(&self) -> usize {
        self.arena.len()
    }

    /// Bytes of the packed weights.
    pub fn weight_bytes(&self) -> usize {
        self.executable.weight_bytes()
    }

    /// Fills the arena with what is not a number, state kept between passes included. A test
    /// shows that nothing is read before it is written.
    pub fn poison(&mut self) {
        self.arena.fill(0xff);
    }
}

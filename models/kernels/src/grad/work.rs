//! Units of work side by side on a pool of threads, each with scratch memory of its own.

use std::cell::RefCell;

use rayon::prelude::*;

use crate::isa::Isa;
#[cfg(target_arch = "x86_64")]
use crate::simd::{Avx2, Avx512};
use crate::simd::{Kernel, Portable, Simd};

thread_local! {
    static SCRATCH: RefCell<Vec<f32>> = const { RefCell::new(Vec::new()) };
}

/// Lends the thread's scratch memory; at least `len` values, which mean nothing.
pub(super) fn with_scratch<R>(len: usize, work: impl FnOnce(&mut [f32]) -> R) -> R {
    SCRATCH.with(|scratch| match scratch.try_borrow_mut() {
        Ok(mut scratch) => {
            if scratch.len() < len {
                scratch.resize(len, 0.0);
            }
            work(&mut scratch[..len])
        }
        // A thread that waits may take up another unit in the meantime.
        Err(_) => work(&mut vec![0.0; len]),
    })
}

/// Results of `work` for every index below `count`, in order.
pub(super) fn each<R: Send>(count: usize, work: impl Fn(usize) -> R + Sync) -> Vec<R> {
    if count <= 1 || rayon::current_num_threads() == 1 {
        (0..count).map(work).collect()
    } else {
        (0..count).into_par_iter().map(&work).collect()
    }
}

/// Runs `kernel` on the instructions of `isa`.
///
/// # Panics
/// If the processor lacks them.
pub(super) fn run<K: Kernel>(isa: Isa, kernel: K) {
    assert!(isa.is_available(), "this processor has no {isa}");
    // SAFETY: the processor has the instructions; the kernels of this module ask for nothing else.
    unsafe {
        match isa {
            Isa::Portable => Portable::vectorize(kernel),
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => Avx2::vectorize(kernel),
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 | Isa::Avx512Bf16 => Avx512::<false>::vectorize(kernel),
            #[cfg(not(target_arch = "x86_64"))]
            _ => unreachable!("not available"),
        }
    }
}

/// Values to be written by several units, each its own.
pub(super) struct Fresh {
    values: Vec<f32>,
    base: *mut f32,
    len: usize,
}

// SAFETY: the memory is reached through `part` alone, whose callers keep their parts apart.
unsafe impl Sync for Fresh {}

impl Fresh {
    /// Room for `len` values.
    pub(super) fn new(len: usize) -> Self {
        let mut values = Vec::with_capacity(len);
        Self {
            base: values.as_mut_ptr(),
            values,
            len,
        }
    }

    /// The values from `start` on, which may not be read before they are written.
    ///
    /// # Safety
    /// No other part in use at the same time overlaps this one.
    #[allow(clippy::mut_from_ref, reason = "parts are kept apart by the callers")]
    pub(super) unsafe fn part(&self, start: usize, len: usize) -> &mut [f32] {
        assert!(start <= self.len && len <= self.len - start);
        // SAFETY: the part lies inside the allocation; the caller keeps it to itself.
        unsafe { std::slice::from_raw_parts_mut(self.base.add(start), len) }
    }

    /// The values.
    ///
    /// # Safety
    /// All of them have been written.
    pub(super) unsafe fn into_values(mut self) -> Vec<f32> {
        // SAFETY: as many values were allocated, and the caller has written them.
        unsafe { self.values.set_len(self.len) };
        self.values
    }
}

//! Memory aligned to cache lines, for the arena and the weights.
//!
//! Large stretches lie on large pages where the system grants them: a network streams through its
//! features, and with small pages the processor spends a part of its time looking addresses up.

use std::alloc::{Layout, alloc, dealloc, handle_alloc_error};
use std::ptr::NonNull;

use rustix::mm::{Advice, madvise};

/// One cache line.
const LINE: usize = 64;
/// One large page of x86-64 and of most others.
const LARGE_PAGE: usize = 2 << 20;

/// A fixed stretch of zeroed memory that starts on a cache line.
pub(crate) struct Memory {
    /// INVARIANT: allocated with `layout`, all of it initialised, owned by this value alone.
    start: NonNull<u8>,
    layout: Layout,
}

// SAFETY: the memory is owned and holds plain bytes.
unsafe impl Send for Memory {}
// SAFETY: shared references only read the address; what lies there is handed out as pointers,
// whose users keep their own order.
unsafe impl Sync for Memory {}

impl Memory {
    /// At least `len` bytes of zeros.
    pub(crate) fn zeroed(len: usize) -> Self {
        let (align, unit) = if len >= LARGE_PAGE {
            (LARGE_PAGE, LARGE_PAGE)
        } else {
            (LINE, LINE)
        };
        let bytes = len.max(1).next_multiple_of(unit);
        let layout = Layout::from_size_align(bytes, align)
            .expect("a program's features and weights are bounded far below the address space");
        // SAFETY: the size is not zero.
        let Some(start) = NonNull::new(unsafe { alloc(layout) }) else {
            handle_alloc_error(layout)
        };
        if align == LARGE_PAGE {
            // SAFETY: the range was just allocated; the advice changes no contents. Without it
            // all works, a little slower.
            let _advised = unsafe { madvise(start.as_ptr().cast(), bytes, Advice::LinuxHugepage) };
        }
        // SAFETY: the range was just allocated. Writing it now faults every page in.
        unsafe { start.as_ptr().write_bytes(0, bytes) };
        Self { start, layout }
    }

    /// Values of a plain number type, in order.
    pub(crate) fn from_values<T: Copy + Send + Sync + 'static>(values: &[T]) -> Self {
        let bytes = size_of_val(values);
        let mut memory = Self::zeroed(bytes);
        // SAFETY: the destination holds at least `bytes` bytes and does not overlap the source.
        unsafe {
            let from = values.as_ptr().cast::<u8>();
            std::ptr::copy_nonoverlapping(from, memory.as_mut_ptr(), bytes);
        }
        memory
    }

    pub(crate) fn as_ptr(&self) -> *const u8 {
        self.start.as_ptr()
    }

    pub(crate) fn as_mut_ptr(&mut self) -> *mut u8 {
        self.start.as_ptr()
    }

    pub(crate) fn len(&self) -> usize {
        self.layout.size()
    }

    /// Fills everything with one byte.
    pub(crate) fn fill(&mut self, byte: u8) {
        // SAFETY: the whole range is this value's own.
        unsafe { self.start.as_ptr().write_bytes(byte, self.layout.size()) };
    }
}

impl Drop for Memory {
    fn drop(&mut self) {
        // SAFETY: allocated with this layout, and nobody else frees it.
        unsafe { dealloc(self.start.as_ptr(), self.layout) };
    }
}

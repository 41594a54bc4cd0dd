//! Memory aligned to cache lines, for the arena and the weights.

/// One cache line.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct Line([u8; 64]);

/// A fixed stretch of zeroed memory that starts on a cache line.
pub(crate) struct Memory(Vec<Line>);

impl Memory {
    /// At least `len` bytes of zeros.
    pub(crate) fn zeroed(len: usize) -> Self {
        Self(vec![Line([0; 64]); len.div_ceil(64)])
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
        self.0.as_ptr().cast()
    }

    pub(crate) fn as_mut_ptr(&mut self) -> *mut u8 {
        self.0.as_mut_ptr().cast()
    }

    pub(crate) fn len(&self) -> usize {
        64 * self.0.len()
    }

    /// Fills everything with one byte.
    pub(crate) fn fill(&mut self, byte: u8) {
        self.0.fill(Line([byte; 64]));
    }
}

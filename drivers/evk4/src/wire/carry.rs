//! Words of `N` bytes out of chunks split anywhere.

/// The bytes of a word whose rest is yet to come.
///
/// INVARIANT: `len < N`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Carry<const N: usize> {
    bytes: [u8; N],
    len: usize,
}

impl<const N: usize> Carry<N> {
    pub(super) const fn new() -> Self {
        Self {
            bytes: [0; N],
            len: 0,
        }
    }

    /// Hands over every word completed by `bytes`, and keeps what is left.
    #[inline]
    pub(super) fn words(&mut self, bytes: &[u8], mut take: impl FnMut([u8; N])) {
        let mut bytes = bytes;
        if self.len > 0 {
            let (head, rest) = bytes.split_at(bytes.len().min(N - self.len));
            self.keep(head);
            bytes = rest;
            if self.len < N {
                return;
            }
            self.len = 0;
            take(self.bytes);
        }
        let (words, tail) = bytes.as_chunks::<N>();
        for &word in words {
            take(word);
        }
        self.keep(tail);
    }

    /// Forgets an incomplete word, and says how many bytes that was.
    pub(super) fn drop_rest(&mut self) -> u64 {
        core::mem::take(&mut self.len) as u64
    }

    fn keep(&mut self, tail: &[u8]) {
        for (slot, &byte) in self.bytes[self.len..].iter_mut().zip(tail) {
            *slot = byte;
        }
        self.len += tail.len();
    }
}

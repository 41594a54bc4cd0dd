//! A reader that tells how much was read through it.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use super::InspectError;

/// Reads through to `inner` and reports every successful read's length.
pub struct Watched<'a, R = File> {
    inner: R,
    watcher: &'a dyn Fn(u64),
}

impl<'a> Watched<'a> {
    /// Opens a file; `watcher` gets the length of every read, bytes.
    ///
    /// # Errors
    /// When the file cannot be opened.
    pub fn open(path: &Path, watcher: &'a dyn Fn(u64)) -> Result<Self, InspectError> {
        let inner = File::open(path).map_err(InspectError::io(path, 0))?;
        Ok(Self { inner, watcher })
    }
}

impl<R: Read> Read for Watched<'_, R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let len = self.inner.read(buffer)?;
        (self.watcher)(len as u64);
        Ok(len)
    }
}

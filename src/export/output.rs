//! A file that appears under its name only once it is whole.

use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use super::ExportError;

/// Bytes gathered before they are written.
const BUFFER_LEN: usize = 256 << 10;

/// Writes to `NAME.part` and renames it at the end; dropped before, it removes what it wrote.
///
/// Errors are kept until [`finish`](Self::finish), so that rows can be written from a decoder's
/// sink; after the first one nothing more is written.
#[derive(Debug)]
pub(super) struct Output {
    path: PathBuf,
    part: PathBuf,
    file: BufWriter<File>,
    failed: Option<std::io::Error>,
    is_whole: bool,
}

impl Output {
    /// Starts the file.
    pub(super) fn create(path: &Path) -> Result<Self, ExportError> {
        let part = part_of(path);
        let file = File::create(&part).map_err(ExportError::output(&part))?;
        Ok(Self {
            path: path.to_owned(),
            part,
            file: BufWriter::with_capacity(BUFFER_LEN, file),
            failed: None,
            is_whole: false,
        })
    }

    /// Appends bytes.
    #[inline]
    pub(super) fn put(&mut self, bytes: &[u8]) {
        if self.failed.is_none()
            && let Err(error) = self.file.write_all(bytes)
        {
            self.failed = Some(error);
        }
    }

    /// Whether writing has failed, so that there is no point in going on.
    pub(super) const fn has_failed(&self) -> bool {
        self.failed.is_some()
    }

    /// Writes `header` over the file's beginning, where a placeholder of its length was written.
    pub(super) fn replace_header(&mut self, header: &[u8]) {
        let file = &mut self.file;
        let replace = || {
            file.seek(SeekFrom::Start(0))?;
            file.write_all(header)
        };
        if self.failed.is_none()
            && let Err(error) = { replace }()
        {
            self.failed = Some(error);
        }
    }

    /// Gives the file its name.
    pub(super) fn finish(mut self) -> Result<(), ExportError> {
        if let Some(error) = self.failed.take() {
            return Err(ExportError::output(&self.path)(error));
        }
        self.file.flush().map_err(ExportError::output(&self.path))?;
        fs::rename(&self.part, &self.path).map_err(ExportError::output(&self.path))?;
        self.is_whole = true;
        Ok(())
    }
}

impl Drop for Output {
    fn drop(&mut self) {
        if !self.is_whole {
            // What cannot be removed is at least not under the target's name.
            let _kept = fs::remove_file(&self.part);
        }
    }
}

/// Where a file is written until it is whole.
pub(super) fn part_of(path: &Path) -> PathBuf {
    let mut name = OsString::from(path);
    name.push(".part");
    PathBuf::from(name)
}

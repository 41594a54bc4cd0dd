//! What kind of file a path is, by its first bytes.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use super::InspectError;

/// A file that other software writes and Noctule reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// A Prophesee RAW file.
    Raw,
    /// A packet capture, pcap or pcapng.
    Capture,
    /// A recording directory.
    Recording,
}

/// First bytes of captures: pcap in microseconds and in nanoseconds, either byte order, and pcapng.
const CAPTURE_MAGICS: [[u8; 4]; 5] = [
    [0xa1, 0xb2, 0xc3, 0xd4],
    [0xd4, 0xc3, 0xb2, 0xa1],
    [0xa1, 0xb2, 0x3c, 0x4d],
    [0x4d, 0x3c, 0xb2, 0xa1],
    [0x0a, 0x0d, 0x0d, 0x0a],
];

impl Kind {
    /// Looks at a path.
    ///
    /// # Errors
    /// When it cannot be read, is empty, or is of no known kind.
    pub fn of(path: &Path) -> Result<Self, InspectError> {
        if path.is_dir() {
            if path.join("meta.json").is_file() {
                return Ok(Self::Recording);
            }
            let path = path.to_owned();
            return Err(InspectError::NoRecording { path });
        }
        let found = first_bytes(path)?;
        if found.first() == Some(&b'%') {
            return Ok(Self::Raw);
        }
        if CAPTURE_MAGICS.iter().any(|magic| found == magic) {
            return Ok(Self::Capture);
        }
        let path = path.to_owned();
        Err(if found.is_empty() {
            InspectError::Empty { path }
        } else {
            InspectError::Unknown { path, found }
        })
    }
}

/// The first four bytes, or all there are.
fn first_bytes(path: &Path) -> Result<Vec<u8>, InspectError> {
    let mut found = Vec::new();
    File::open(path)
        .and_then(|file| file.take(4).read_to_end(&mut found))
        .map_err(InspectError::io(path, 0))?;
    Ok(found)
}

//! Datagrams into a capture file other tools can open.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use noctule_sensor::{Realtime, Stamp};

use super::link;

/// Little-endian capture with nanosecond stamps.
const MAGIC_NANOS: u32 = 0xa1b2_3c4d;
const SNAP_LEN: u32 = 262_144;
const LINK_ETHERNET: u32 = 1;
const SECOND_NS: u64 = 1_000_000_000;

/// Writes UDP payloads as Ethernet frames into a classic pcap with nanosecond stamps.
#[derive(Debug)]
pub struct Writer<W: Write> {
    out: W,
    dst_port: u16,
    written: u64,
}

impl Writer<BufWriter<File>> {
    /// Creates the file, or empties it; datagrams will go to UDP port `dst_port`.
    ///
    /// # Errors
    /// When the file cannot be made or written.
    pub fn create(path: impl AsRef<Path>, dst_port: u16) -> io::Result<Self> {
        Self::new(BufWriter::new(File::create(path)?), dst_port)
    }
}

impl<W: Write> Writer<W> {
    /// Writes the file header; datagrams will go to UDP port `dst_port`.
    ///
    /// # Errors
    /// When `out` cannot be written.
    pub fn new(mut out: W, dst_port: u16) -> io::Result<Self> {
        let version = (2u16, 4u16);
        out.write_all(&MAGIC_NANOS.to_le_bytes())?;
        out.write_all(&version.0.to_le_bytes())?;
        out.write_all(&version.1.to_le_bytes())?;
        // Time zone and accuracy, which nobody uses.
        out.write_all(&[0; 8])?;
        out.write_all(&SNAP_LEN.to_le_bytes())?;
        out.write_all(&LINK_ETHERNET.to_le_bytes())?;
        Ok(Self {
            out,
            dst_port,
            written: 0,
        })
    }

    /// Writes one datagram, received at `t`.
    ///
    /// # Errors
    /// When the file cannot be written, `t` is after the year 2106, or the payload is longer than
    /// a UDP datagram holds; nothing is written in the last two cases.
    pub fn datagram(&mut self, t: Stamp<Realtime>, payload: &[u8]) -> io::Result<()> {
        let bad = |what: String| io::Error::new(io::ErrorKind::InvalidInput, what);
        let id = self.written.to_le_bytes();
        let id = u16::from_le_bytes([id[0], id[1]]);
        let head = link::wrap(payload, self.dst_port, id).ok_or_else(|| {
            let (len, most) = (payload.len(), link::PAYLOAD_MAX);
            bad(format!(
                "payload is {len} bytes, a datagram holds at most {most}"
            ))
        })?;
        let second = u32::try_from(t.as_nanos() / SECOND_NS)
            .map_err(|_| bad(format!("stamp {t} does not fit a capture file")))?;
        // Below 1e9 and below 66,000: both fit.
        let nanos = u32::try_from(t.as_nanos() % SECOND_NS).unwrap_or(0);
        let len = u32::try_from(head.len() + payload.len()).unwrap_or(0);
        for field in [second, nanos, len, len] {
            self.out.write_all(&field.to_le_bytes())?;
        }
        self.out.write_all(&head)?;
        self.out.write_all(payload)?;
        self.written += 1;
        Ok(())
    }

    /// Datagrams written so far.
    #[must_use]
    pub fn written(&self) -> u64 {
        self.written
    }

    /// Hands everything to the operating system and gives back the writer below.
    ///
    /// # Errors
    /// When it cannot be written; dropping a `Writer` instead may lose that error.
    pub fn finish(mut self) -> io::Result<W> {
        self.out.flush()?;
        Ok(self.out)
    }
}

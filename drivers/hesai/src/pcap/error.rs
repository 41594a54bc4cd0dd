//! What is wrong with a capture file, and where.

use std::io;

use thiserror::Error;

/// Why a capture cannot be read on; datagrams before it are good.
#[derive(Debug, Error)]
pub enum CaptureError {
    /// The file could not be read.
    #[error("byte {offset}: cannot read")]
    Io {
        /// Where in the file.
        offset: u64,
        /// Why.
        source: io::Error,
    },
    /// Four bytes that tell the format or the byte order, and do not.
    #[error("byte {offset}: {found:#010x} begins neither pcap nor pcapng")]
    Magic {
        /// Where they stand.
        offset: u64,
        /// What they are, read as a little-endian number.
        found: u32,
    },
    /// The file ends inside a header, record or block.
    #[error("byte {offset}: file ends after {actual} of the {needed} bytes of {what}")]
    Truncated {
        /// Where what is cut short begins.
        offset: u64,
        /// What is cut short.
        what: &'static str,
        /// Bytes it needs.
        needed: usize,
        /// Bytes there.
        actual: usize,
    },
    /// A length no capture has.
    #[error("byte {offset}: {what} is {len} bytes long, needs {min} to {max}")]
    Length {
        /// Where it begins.
        offset: u64,
        /// What has that length.
        what: &'static str,
        /// What it says.
        len: u64,
        /// Least length.
        min: u64,
        /// Greatest length.
        max: u64,
    },
    /// Frames of a kind that is not understood.
    #[error("byte {offset}: link type {link} is not one this reader knows")]
    LinkType {
        /// Where it says so.
        offset: u64,
        /// The tcpdump registry's number.
        link: u16,
    },
    /// A pcapng packet of an interface that was not described.
    #[error("byte {offset}: packet of interface {interface}, of which there are {known}")]
    Interface {
        /// Where the packet's block begins.
        offset: u64,
        /// What it says.
        interface: u32,
        /// Interfaces described so far.
        known: usize,
    },
}

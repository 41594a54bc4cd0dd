//! Capture files, in and out: UDP datagrams with the time the host received them.
//!
//! Reads pcap (micro- and nanosecond, either byte order) and pcapng through any [`std::io::Read`],
//! one record in memory at a time.

mod error;
mod input;
mod link;
mod ng;
mod reader;
mod writer;

pub use error::CaptureError;
pub use reader::{Datagram, Reader, Skipped};
pub use writer::Writer;

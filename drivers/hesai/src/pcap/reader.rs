//! UDP datagrams out of a capture file, one at a time.

use std::io::Read;

use noctule_sensor::{Realtime, Stamp};

use super::input::{Input, RECORD_MAX};
use super::link::{self, Frame};
use super::ng::Section;
use super::{CaptureError, ng};

/// One UDP datagram of a capture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Datagram<'a> {
    /// When the host received it.
    pub t: Stamp<Realtime>,
    /// UDP port it was sent to.
    pub dst_port: u16,
    /// What it carries.
    pub payload: &'a [u8],
    /// Where in the file the payload begins.
    pub file_offset: u64,
}

/// Records of a capture that are no datagrams to hand out, by kind.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Skipped {
    /// Datagrams to other ports than the one asked for.
    pub other_port: u64,
    /// Frames that are not UDP over IP.
    pub not_udp: u64,
    /// Pieces of IP datagrams.
    pub fragments: u64,
    /// Frames cut short when they were captured, or with lengths that contradict one another.
    pub cut: u64,
}

impl Skipped {
    /// All kinds together.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.other_port + self.not_udp + self.fragments + self.cut
    }
}

/// Reads pcap and pcapng, whatever their byte order and stamps.
#[derive(Debug)]
pub struct Reader<R> {
    input: Input<R>,
    format: Format,
    port: Option<u16>,
    skipped: Skipped,
    ended: bool,
}

#[derive(Debug)]
enum Format {
    Classic { link: u16, nanos_per_tick: u64 },
    Ng(Section),
}

const MICROS: u32 = 0xa1b2_c3d4;
const NANOS: u32 = 0xa1b2_3c4d;
const SECOND_NS: u64 = 1_000_000_000;

/// A frame in the input's record.
struct Record {
    t_ns: u64,
    link: u16,
    frame: core::ops::Range<usize>,
}

impl<R: Read> Reader<R> {
    /// Reads the file's header. Wrap files in a [`std::io::BufReader`].
    ///
    /// # Errors
    /// When it is no capture, ends too early, or holds frames of an unknown kind.
    pub fn new(inner: R) -> Result<Self, CaptureError> {
        let mut input = Input::new(inner);
        if !input.take(4, "a file header")? {
            let (offset, what) = (0, "a file header");
            return Err(CaptureError::Truncated {
                offset,
                what,
                needed: 24,
                actual: 0,
            });
        }
        let format = match input.u32(0) {
            ng::SECTION_HEADER => Format::Ng(Section::open(&mut input)?),
            _ => classic(&mut input)?,
        };
        Ok(Self {
            input,
            format,
            port: None,
            skipped: Skipped::default(),
            ended: false,
        })
    }

    /// Hands out datagrams to that port only, from now on; `None` for all ports.
    pub fn set_port(&mut self, port: Option<u16>) {
        self.port = port;
    }

    /// Records passed over so far.
    #[must_use]
    pub fn skipped(&self) -> Skipped {
        self.skipped
    }

    /// The next datagram; `None` at the end of the file, and after an error.
    ///
    /// # Errors
    /// What is wrong with the file and where; it cannot be read on.
    pub fn next_datagram(&mut self) -> Result<Option<Datagram<'_>>, CaptureError> {
        while !self.ended {
            let record = match self.record() {
                Ok(Some(record)) => record,
                Ok(None) => break,
                Err(error) => {
                    self.ended = true;
                    return Err(error);
                }
            };
            let Record { t_ns, link, frame } = record;
            match link::parse(link, &self.input.record[frame.clone()]) {
                Frame::Datagram { dst_port, payload } => {
                    if self.port.is_some_and(|port| port != dst_port) {
                        self.skipped.other_port += 1;
                        continue;
                    }
                    let payload = frame.start + payload.start..frame.start + payload.end;
                    let after = self.input.record.len() - payload.start;
                    return Ok(Some(Datagram {
                        t: Stamp::from_nanos(t_ns),
                        dst_port,
                        payload: &self.input.record[payload],
                        file_offset: self.input.offset - u64::try_from(after).unwrap_or(0),
                    }));
                }
                Frame::Fragment => self.skipped.fragments += 1,
                Frame::NotUdp => self.skipped.not_udp += 1,
                Frame::Cut => self.skipped.cut += 1,
            }
        }
        self.ended = true;
        Ok(None)
    }

    fn record(&mut self) -> Result<Option<Record>, CaptureError> {
        let (link, nanos_per_tick) = match &mut self.format {
            Format::Ng(section) => {
                let packet = section.next(&mut self.input)?;
                return Ok(packet.map(|ng::Packet { t_ns, link, frame }| Record {
                    t_ns,
                    link,
                    frame,
                }));
            }
            Format::Classic {
                link,
                nanos_per_tick,
            } => (*link, *nanos_per_tick),
        };
        let input = &mut self.input;
        let start = input.offset;
        if !input.take(16, "a record header")? {
            return Ok(None);
        }
        let (second, ticks, len) = (input.u32(0), input.u32(4), input.u32(8));
        let t_ns = u64::from(second) * SECOND_NS + u64::from(ticks) * nanos_per_tick;
        let len = usize::try_from(len).unwrap_or(usize::MAX);
        if len > RECORD_MAX {
            return Err(CaptureError::Length {
                offset: start,
                what: "a record",
                len: u64::from(input.u32(8)),
                min: 0,
                max: u64::try_from(RECORD_MAX).unwrap_or(u64::MAX),
            });
        }
        if !input.take(len, "a record")? && len > 0 {
            let (offset, what) = (input.offset, "a record");
            return Err(CaptureError::Truncated {
                offset,
                what,
                needed: len,
                actual: 0,
            });
        }
        Ok(Some(Record {
            t_ns,
            link,
            frame: 0..len,
        }))
    }
}

/// Reads the rest of a classic file header, whose magic `input` holds.
fn classic<R: Read>(input: &mut Input<R>) -> Result<Format, CaptureError> {
    let magic = input.u32(0);
    input.big_endian = matches!(magic.swap_bytes(), MICROS | NANOS);
    let nanos_per_tick = match input.u32(0) {
        MICROS => 1000,
        NANOS => 1,
        _ => {
            return Err(CaptureError::Magic {
                offset: 0,
                found: magic,
            });
        }
    };
    let what = "a file header";
    let rest = input.take_more(20, what);
    if !matches!(rest, Ok(true)) {
        let actual = input.record.len();
        return Err(match rest {
            Err(error @ CaptureError::Io { .. }) => error,
            _ => CaptureError::Truncated {
                offset: 0,
                what,
                needed: 24,
                actual,
            },
        });
    }
    // The upper bits say whether frames end in a checksum; it lies behind the IP datagram.
    let link = input.u32(20).to_le_bytes();
    let link = u16::from_le_bytes([link[0], link[1]]);
    if !link::is_known(link) {
        return Err(CaptureError::LinkType { offset: 20, link });
    }
    Ok(Format::Classic {
        link,
        nanos_per_tick,
    })
}

//! Capture files: what is written reads back, in every dialect, and damage is located.
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::unwrap_used,
    reason = "made-up data, cut to size on purpose; a failure is a failed test"
)]

use noctule_hesai::pcap::{CaptureError, Reader, Skipped, Writer};
use noctule_sensor::{Realtime, Stamp};
use proptest::prelude::*;

const PORT: u16 = 2368;

fn stamps() -> impl Iterator<Item = Stamp<Realtime>> {
    (0..).map(|n| Stamp::from_nanos(1_700_000_000_123_456_000 + n * 333_333_000))
}

fn written(payloads: &[Vec<u8>]) -> Vec<u8> {
    let mut writer = Writer::new(Vec::new(), PORT).unwrap();
    for (payload, t) in payloads.iter().zip(stamps()) {
        writer.datagram(t, payload).unwrap();
    }
    assert_eq!(writer.written(), u64::try_from(payloads.len()).unwrap());
    writer.finish().unwrap()
}

type Found = Vec<(u64, u16, Vec<u8>)>;

/// Every datagram, and what ended the file.
fn read(bytes: &[u8]) -> (Found, Option<CaptureError>) {
    let mut found = Vec::new();
    let mut reader = match Reader::new(bytes) {
        Ok(reader) => reader,
        Err(error) => return (found, Some(error)),
    };
    loop {
        match reader.next_datagram() {
            Ok(Some(d)) => {
                let at = usize::try_from(d.file_offset).unwrap();
                assert_eq!(
                    &bytes[at..at + d.payload.len()],
                    d.payload,
                    "offset leads there"
                );
                found.push((d.t.as_nanos(), d.dst_port, d.payload.to_vec()));
            }
            Ok(None) => return (found, None),
            Err(error) => {
                assert!(
                    matches!(reader.next_datagram(), Ok(None)),
                    "an error ends the file"
                );
                return (found, Some(error));
            }
        }
    }
}

fn payloads() -> Vec<Vec<u8>> {
    (0..5u8).map(|n| vec![n; 100 + usize::from(n)]).collect()
}

fn expected(payloads: &[Vec<u8>]) -> Found {
    let stamped = payloads.iter().zip(stamps());
    stamped
        .map(|(payload, t)| (t.as_nanos(), PORT, payload.clone()))
        .collect()
}

#[test]
fn what_is_written_reads_back() {
    let (found, error) = read(&written(&payloads()));
    assert_eq!(found, expected(&payloads()));
    assert!(error.is_none());
}

/// Rewrites a nanosecond, little-endian file of the writer's in another classic dialect.
fn dialect(bytes: &[u8], nanos: bool, big_endian: bool) -> Vec<u8> {
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
    let put = |out: &mut Vec<u8>, value: u32| {
        out.extend(if big_endian {
            value.to_be_bytes()
        } else {
            value.to_le_bytes()
        });
    };
    let mut out = Vec::new();
    put(&mut out, if nanos { 0xa1b2_3c4d } else { 0xa1b2_c3d4 });
    out.extend(if big_endian {
        [0, 2, 0, 4]
    } else {
        [2, 0, 4, 0]
    });
    (8..24).step_by(4).for_each(|at| put(&mut out, word(at)));
    let mut at = 24;
    while at < bytes.len() {
        put(&mut out, word(at));
        put(
            &mut out,
            if nanos {
                word(at + 4)
            } else {
                word(at + 4) / 1000
            },
        );
        put(&mut out, word(at + 8));
        put(&mut out, word(at + 12));
        let len = word(at + 8) as usize;
        out.extend(&bytes[at + 16..at + 16 + len]);
        at += 16 + len;
    }
    out
}

#[test]
fn both_magics_and_both_byte_orders_say_the_same() {
    let file = written(&payloads());
    assert_eq!(dialect(&file, true, false), file);
    for (nanos, big_endian) in [(true, true), (false, false), (false, true)] {
        let (found, error) = read(&dialect(&file, nanos, big_endian));
        assert_eq!(
            found,
            expected(&payloads()),
            "nanos {nanos}, big-endian {big_endian}"
        );
        assert!(error.is_none());
    }
}

/// Writes pcapng blocks in one byte order.
struct Ng {
    out: Vec<u8>,
    big_endian: bool,
}

impl Ng {
    fn words(&self, words: &[u32]) -> Vec<u8> {
        let order = |w: &u32| {
            if self.big_endian {
                w.to_be_bytes()
            } else {
                w.to_le_bytes()
            }
        };
        words.iter().flat_map(order).collect()
    }

    fn halves(&self, halves: &[u16]) -> Vec<u8> {
        let order = |h: &u16| {
            if self.big_endian {
                h.to_be_bytes()
            } else {
                h.to_le_bytes()
            }
        };
        halves.iter().flat_map(order).collect()
    }

    fn block(&mut self, kind: u32, body: &[u8]) {
        let padded = body.len().next_multiple_of(4);
        let len = u32::try_from(padded + 12).unwrap();
        let (head, tail) = (self.words(&[kind, len]), self.words(&[len]));
        self.out.extend(head);
        self.out.extend(body);
        self.out.resize(self.out.len() + padded - body.len(), 0);
        self.out.extend(tail);
    }

    fn section(&mut self) {
        let body = [
            self.words(&[0x1a2b_3c4d]),
            self.halves(&[1, 0]),
            vec![0xff; 8],
        ]
        .concat();
        self.block(0x0a0d_0d0a, &body);
    }

    /// An Ethernet interface whose ticks are as option 9 says.
    fn interface(&mut self, resolution: Option<u8>) {
        let mut body = [self.halves(&[1, 0]), self.words(&[0])].concat();
        if let Some(resolution) = resolution {
            body.extend([self.halves(&[9, 1]), vec![resolution, 0, 0, 0]].concat());
            body.extend(self.halves(&[0, 0]));
        }
        self.block(1, &body);
    }

    fn packet(&mut self, interface: u32, ticks: u64, frame: &[u8]) {
        let len = u32::try_from(frame.len()).unwrap();
        let (high, low) = ((ticks >> 32) as u32, ticks as u32);
        let body = [&self.words(&[interface, high, low, len, len])[..], frame].concat();
        self.block(6, &body);
    }
}

/// The frames of the writer's file.
fn frames(payloads: &[Vec<u8>]) -> Vec<Vec<u8>> {
    let file = written(payloads);
    let mut at = 24;
    let mut frames = Vec::new();
    for payload in payloads {
        let len = 42 + payload.len();
        frames.push(file[at + 16..at + 16 + len].to_vec());
        at += 16 + len;
    }
    frames
}

fn ng(big_endian: bool) -> Vec<u8> {
    let mut ng = Ng {
        out: Vec::new(),
        big_endian,
    };
    ng.section();
    ng.interface(None);
    ng.interface(Some(9));
    ng.block(5, &[0; 12]); // statistics: passed over
    let resolutions = [1_000, 1];
    for (n, (frame, t)) in frames(&payloads()).iter().zip(stamps()).enumerate() {
        let interface = n % 2;
        ng.packet(
            interface as u32,
            t.as_nanos() / resolutions[interface],
            frame,
        );
    }
    ng.out
}

#[test]
fn pcapng_reads_in_both_byte_orders_with_a_clock_per_interface() {
    for big_endian in [false, true] {
        let (found, error) = read(&ng(big_endian));
        assert_eq!(found, expected(&payloads()), "big-endian {big_endian}");
        assert!(error.is_none());
    }
    // A second section starts over, in its own byte order.
    let both = [ng(true), ng(false)].concat();
    assert_eq!(
        read(&both).0,
        [expected(&payloads()), expected(&payloads())].concat()
    );
}

#[test]
fn a_binary_clock_and_an_unknown_interface() {
    let mut ng = Ng {
        out: Vec::new(),
        big_endian: false,
    };
    ng.section();
    ng.interface(Some(0x80 | 30));
    let frame = &frames(&payloads())[0];
    ng.packet(0, 3 << 29, frame);
    ng.packet(7, 0, frame);
    let (found, error) = read(&ng.out);
    assert_eq!(found[0].0, 1_500_000_000);
    assert!(matches!(
        error,
        Some(CaptureError::Interface {
            interface: 7,
            known: 1,
            ..
        })
    ));
}

#[test]
fn a_file_cut_anywhere_gives_what_is_there_and_says_where_it_ends() {
    for file in [written(&payloads()), ng(false)] {
        let whole = read(&file).0;
        for len in 0..file.len() {
            let (found, error) = read(&file[..len]);
            assert_eq!(found, whole[..found.len()], "{len}");
            match error {
                None => assert!(found.len() < whole.len(), "{len}"),
                Some(CaptureError::Truncated {
                    offset,
                    needed,
                    actual,
                    ..
                }) => {
                    let end = usize::try_from(offset).unwrap() + actual;
                    assert!(end == len && actual < needed, "{len}: {offset} + {actual}");
                }
                Some(error) => panic!("{len}: {error}"),
            }
        }
    }
}

#[test]
fn other_ports_are_counted_and_so_is_the_rest() {
    let mut file = written(&payloads());
    let first = 24 + 16;
    file[first + 12] = 0x08;
    file[first + 13] = 0x06; // ARP
    let second = first + 42 + 100 + 16;
    file[second + 20] = 0x20; // more fragments
    let mut reader = Reader::new(&file[..]).unwrap();
    reader.set_port(Some(PORT + 1));
    assert!(reader.next_datagram().unwrap().is_none());
    let skipped = Skipped {
        other_port: 3,
        not_udp: 1,
        fragments: 1,
        cut: 0,
    };
    assert_eq!((reader.skipped(), reader.skipped().total()), (skipped, 5));
}

#[test]
fn what_is_no_capture_is_refused_with_what_it_is() {
    let error = |bytes: &[u8]| Reader::new(bytes).unwrap_err().to_string();
    assert_eq!(
        error(b""),
        "byte 0: file ends after 0 of the 24 bytes of a file header"
    );
    assert_eq!(
        error(b"PNG!rest of the file"),
        "byte 0: 0x21474e50 begins neither pcap nor pcapng"
    );
    let mut wifi = written(&[]);
    wifi[20] = 105;
    assert_eq!(
        error(&wifi),
        "byte 20: link type 105 is not one this reader knows"
    );
    let mut huge = written(&payloads());
    huge[24 + 11] = 0x7f;
    let message = read(&huge).1.unwrap().to_string();
    assert_eq!(
        message,
        "byte 24: a record is 2130706574 bytes long, needs 0 to 16777216"
    );
}

#[test]
fn a_writer_refuses_what_the_format_cannot_hold() {
    let mut writer = Writer::new(Vec::new(), PORT).unwrap();
    assert!(writer.datagram(Stamp::ZERO, &vec![0; 65_508]).is_err());
    assert!(writer.datagram(Stamp::MAX, &[]).is_err());
    writer.datagram(Stamp::ZERO, &vec![0; 65_507]).unwrap();
    assert_eq!(writer.written(), 1);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    #[test]
    fn random_bytes_end_without_a_panic(mut bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        let _read = read(&bytes);
        for magic in [0xa1b2_c3d4u32, 0x4d3c_b2a1, 0x0a0d_0d0a] {
            if bytes.len() >= 4 {
                bytes[..4].copy_from_slice(&magic.to_le_bytes());
            }
            let _read = read(&bytes);
        }
    }

    #[test]
    fn flipped_bits_end_without_a_panic(
        ng_file in any::<bool>(),
        flips in prop::collection::vec((any::<prop::sample::Index>(), 0..8u8), 1..6),
    ) {
        let mut file = if ng_file { ng(true) } else { written(&payloads()) };
        for (at, bit) in flips {
            let at = at.index(file.len());
            file[at] ^= 1 << bit;
        }
        let _read = read(&file);
    }
}

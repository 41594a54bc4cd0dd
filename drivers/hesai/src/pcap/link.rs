//! From a captured frame to the UDP payload inside it, and the frame around a payload.

use std::ops::Range;

/// What a frame turned out to be.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Frame {
    /// A whole UDP datagram: destination port and where its payload lies.
    Datagram {
        dst_port: u16,
        payload: Range<usize>,
    },
    /// A piece of an IP datagram.
    Fragment,
    /// Something else than UDP over IP.
    NotUdp,
    /// Headers or payload go on after the captured bytes.
    Cut,
}

/// Link types (the tcpdump registry) that can carry IP datagrams and are read here.
const ETHERNET: u16 = 1;
const RAW_OLD: u16 = 12;
const RAW: u16 = 101;
const LINUX_SLL: u16 = 113;
const IPV4: u16 = 228;
const IPV6: u16 = 229;
const LINUX_SLL2: u16 = 276;
const NULL: u16 = 0;

mod ethertype {
    pub const IPV4: u16 = 0x0800;
    pub const IPV6: u16 = 0x86dd;
    /// 802.1Q, 802.1ad, and its older number for stacked tags.
    pub const VLAN: [u16; 3] = [0x8100, 0x88a8, 0x9100];
}

const UDP: u8 = 17;
/// Most VLAN tags stacked on one frame.
const TAGS_MAX: usize = 4;

/// Whether frames of that link type are understood.
pub(super) fn is_known(link: u16) -> bool {
    [
        ETHERNET, RAW_OLD, RAW, LINUX_SLL, IPV4, IPV6, LINUX_SLL2, NULL,
    ]
    .contains(&link)
}

/// Looks through the headers of `frame`.
pub(super) fn parse(link: u16, frame: &[u8]) -> Frame {
    let found = match link {
        ETHERNET => ethernet(frame, 12),
        // The protocol field; a VLAN tag may follow it as in an Ethernet frame.
        LINUX_SLL => ethernet(frame, 14),
        LINUX_SLL2 => be16(frame, 0).and_then(|kind| network(frame, kind, 20)),
        // 4 bytes of address family in the capturing host's order.
        NULL => by_version(frame, 4),
        _ => by_version(frame, 0),
    };
    found.unwrap_or(Frame::Cut)
}

fn be16(frame: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_be_bytes([*frame.get(at)?, *frame.get(at + 1)?]))
}

/// From the EtherType at `at` on, skipping VLAN tags.
fn ethernet(frame: &[u8], mut at: usize) -> Option<Frame> {
    for _ in 0..=TAGS_MAX {
        let kind = be16(frame, at)?;
        if !ethertype::VLAN.contains(&kind) {
            return network(frame, kind, at + 2);
        }
        at += 4;
    }
    Some(Frame::NotUdp)
}

fn network(frame: &[u8], kind: u16, at: usize) -> Option<Frame> {
    match kind {
        ethertype::IPV4 => ipv4(frame, at),
        ethertype::IPV6 => ipv6(frame, at),
        // A tag after a Linux cooked header of version 2.
        _ if ethertype::VLAN.contains(&kind) => ethernet(frame, at + 2),
        _ => Some(Frame::NotUdp),
    }
}

fn by_version(frame: &[u8], at: usize) -> Option<Frame> {
    match frame.get(at)? >> 4 {
        4 => ipv4(frame, at),
        6 => ipv6(frame, at),
        _ => Some(Frame::NotUdp),
    }
}

fn ipv4(frame: &[u8], at: usize) -> Option<Frame> {
    let header = usize::from(frame.get(at)? & 0x0f) * 4;
    if frame.get(at)? >> 4 != 4 || header < 20 {
        return Some(Frame::NotUdp);
    }
    // More fragments, or an offset.
    if be16(frame, at + 6)? & 0x3fff != 0 {
        return Some(Frame::Fragment);
    }
    if *frame.get(at + 9)? != UDP {
        return Some(Frame::NotUdp);
    }
    udp(frame, at + header)
}

fn ipv6(frame: &[u8], at: usize) -> Option<Frame> {
    const FRAGMENT: u8 = 44;
    match *frame.get(at + 6)? {
        UDP => udp(frame, at + 40),
        FRAGMENT => Some(Frame::Fragment),
        _ => Some(Frame::NotUdp),
    }
}

fn udp(frame: &[u8], at: usize) -> Option<Frame> {
    let dst_port = be16(frame, at + 2)?;
    let len = usize::from(be16(frame, at + 4)?);
    if len < 8 {
        return Some(Frame::NotUdp);
    }
    let payload = at + 8..at + len;
    (payload.end <= frame.len()).then_some(Frame::Datagram { dst_port, payload })
}

/// Bytes that [`wrap`] puts before a payload.
pub(super) const WRAP_LEN: usize = 14 + 20 + 8;
/// Longest payload an IPv4 datagram holds.
pub(super) const PAYLOAD_MAX: usize = 65_535 - 20 - 8;

/// Who sends to whom in frames made here: the sensor's factory address to everyone.
const SOURCE: [u8; 4] = [192, 168, 1, 201];
const DESTINATION: [u8; 4] = [255; 4];
const SOURCE_PORT: u16 = 10_000;

/// Ethernet, IPv4 and UDP headers for `payload`, checksums included; `None` if it is too long.
pub(super) fn wrap(payload: &[u8], dst_port: u16, id: u16) -> Option<[u8; WRAP_LEN]> {
    let udp_len = u16::try_from(payload.len() + 8).ok()?;
    let ip_len = udp_len.checked_add(20)?;
    let mut head = [0; WRAP_LEN];
    head[..6].fill(0xff);
    // A locally administered address.
    head[6..12].copy_from_slice(&[0x02, 0, 0, 0, 0, 0x01]);
    head[12..14].copy_from_slice(&ethertype::IPV4.to_be_bytes());
    let ip = &mut head[14..34];
    ip[0] = 0x45;
    ip[2..4].copy_from_slice(&ip_len.to_be_bytes());
    ip[4..6].copy_from_slice(&id.to_be_bytes());
    ip[6] = 0x40; // don't fragment
    ip[8] = 64;
    ip[9] = UDP;
    ip[12..16].copy_from_slice(&SOURCE);
    ip[16..20].copy_from_slice(&DESTINATION);
    let sum = checksum(sum_be(ip));
    ip[10..12].copy_from_slice(&sum.to_be_bytes());
    head[34..36].copy_from_slice(&SOURCE_PORT.to_be_bytes());
    head[36..38].copy_from_slice(&dst_port.to_be_bytes());
    head[38..40].copy_from_slice(&udp_len.to_be_bytes());
    let pseudo = sum_be(&SOURCE) + sum_be(&DESTINATION) + u64::from(UDP) + u64::from(udp_len);
    // Zero would say that there is no checksum.
    let sum = match checksum(pseudo + sum_be(&head[34..42]) + sum_be(payload)) {
        0 => 0xffff,
        sum => sum,
    };
    head[40..42].copy_from_slice(&sum.to_be_bytes());
    Some(head)
}

/// Sum of the bytes as big-endian 16-bit words, an odd last byte padded with zero.
fn sum_be(bytes: &[u8]) -> u64 {
    let words = bytes.chunks(2);
    words
        .map(|w| u64::from(w[0]) << 8 | u64::from(w.get(1).copied().unwrap_or(0)))
        .sum()
}

/// One's complement of the one's-complement sum (RFC 1071).
fn checksum(mut sum: u64) -> u16 {
    while sum > 0xffff {
        sum = (sum >> 16) + (sum & 0xffff);
    }
    !u16::try_from(sum).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    const PAYLOAD: &[u8] = b"returns";

    fn plain() -> Vec<u8> {
        [&wrap(PAYLOAD, 2368, 1).unwrap()[..], PAYLOAD].concat()
    }

    fn found(link: u16, frame: &[u8]) -> Option<(u16, &[u8])> {
        match parse(link, frame) {
            Frame::Datagram { dst_port, payload } => Some((dst_port, &frame[payload])),
            _ => None,
        }
    }

    #[test]
    fn a_wrapped_payload_unwraps_and_its_checksums_verify() {
        let frame = plain();
        assert_eq!(found(1, &frame), Some((2368, PAYLOAD)));
        assert_eq!(checksum(sum_be(&frame[14..34])), 0);
        let pseudo = sum_be(&frame[26..34]) + 17 + sum_be(&frame[38..40]);
        assert_eq!(checksum(pseudo + sum_be(&frame[34..])), 0);
        assert_eq!(wrap(&vec![0; PAYLOAD_MAX + 1], 1, 1), None);
    }

    #[test]
    fn tags_and_other_links_are_looked_through() {
        let frame = plain();
        let ip = &frame[14..];
        let tag = [0x81, 0x00, 0x00, 0x05];
        let outer = [0x88, 0xa8, 0x00, 0x09];
        let tagged = [&frame[..12], &tag, &frame[12..]].concat();
        let stacked = [&frame[..12], &outer, &tag, &frame[12..]].concat();
        let cooked = [&[0; 14][..], &[0x08, 0x00], ip].concat();
        let cooked2 = [&[0x08, 0x00][..], &[0; 18], ip].concat();
        let loopback = [&[2, 0, 0, 0][..], ip].concat();
        for (link, frame) in [
            (ETHERNET, &tagged[..]),
            (ETHERNET, &stacked),
            (RAW, ip),
            (IPV4, ip),
            (LINUX_SLL, &cooked),
            (LINUX_SLL2, &cooked2),
            (NULL, &loopback),
        ] {
            assert_eq!(
                found(link, frame),
                Some((2368, PAYLOAD)),
                "link type {link}"
            );
        }
    }

    #[test]
    fn ipv6_is_udp_too() {
        let frame = plain();
        let mut ip = [0; 40];
        ip[0] = 0x60;
        ip[6] = UDP;
        let v6 = [&frame[..12], &[0x86, 0xdd], &ip, &frame[34..]].concat();
        assert_eq!(found(ETHERNET, &v6), Some((2368, PAYLOAD)));
    }

    #[test]
    fn what_is_no_whole_datagram_is_told_apart() {
        let frame = plain();
        let with = |at: usize, byte: u8| {
            let mut frame = frame.clone();
            frame[at] = byte;
            parse(ETHERNET, &frame)
        };
        assert_eq!(with(20, 0x20), Frame::Fragment);
        assert_eq!(with(21, 0x01), Frame::Fragment);
        assert_eq!(with(23, 6), Frame::NotUdp);
        assert_eq!(with(13, 0x06), Frame::NotUdp);
        assert_eq!(with(14, 0x41), Frame::NotUdp);
        assert_eq!(with(38, 0xff), Frame::Cut);
        for len in 0..frame.len() {
            assert_eq!(parse(ETHERNET, &frame[..len]), Frame::Cut, "{len}");
        }
        let endless = [0x81, 0x00].repeat(40);
        assert_eq!(parse(ETHERNET, &endless), Frame::NotUdp);
    }

    #[test]
    fn padding_after_the_datagram_is_not_payload() {
        let padded = [plain(), vec![0; 20]].concat();
        assert_eq!(found(ETHERNET, &padded), Some((2368, PAYLOAD)));
    }
}

//! Fields of an example as bytes: small, exact, quick to read back.
//!
//! Events take three bytes instead of eight; smooth fields are differenced along rows and deflated.

use std::io::{Read, Write};

use flate2::Compression;
use flate2::read::ZlibDecoder;
use flate2::write::ZlibEncoder;
use noctule_raster::PackedEvent;

use super::example::{DEPTH_CODES_PER_M, depth_code};

/// Largest gap between two events that one byte holds, microseconds; more takes escapes.
const GAP_MAX: u32 = 126;
/// A byte that advances time by [`GAP_MAX`] + 1 and carries no event.
const ESCAPE: u8 = 127;

/// Events in order of time, as gap-and-polarity bytes and then two bytes of cell each.
///
/// Layout: the count as u32, the number of gap bytes as u32, the gap bytes (gap in bits 0..7,
/// polarity in bit 7), then x and y of each event as one byte each.
pub(super) fn pack_events(events: &[PackedEvent]) -> Vec<u8> {
    let mut gaps = Vec::with_capacity(events.len() + events.len() / 8);
    let mut cells = Vec::with_capacity(2 * events.len());
    let mut now = 0u32;
    for event in events {
        let mut gap = event.t_us.saturating_sub(now);
        now = now.max(event.t_us);
        while gap > GAP_MAX {
            gaps.push(ESCAPE);
            gap -= GAP_MAX + 1;
        }
        gaps.push(gap as u8 | u8::from(event.is_on()) << 7);
        cells.extend_from_slice(&[event.x() as u8, event.y() as u8]);
    }
    let mut bytes = Vec::with_capacity(8 + gaps.len() + cells.len());
    bytes.extend_from_slice(&(events.len() as u32).to_le_bytes());
    bytes.extend_from_slice(&(gaps.len() as u32).to_le_bytes());
    bytes.extend_from_slice(&gaps);
    bytes.extend_from_slice(&cells);
    bytes
}

/// The inverse of [`pack_events`]; `None` for bytes it cannot have written.
pub(super) fn unpack_events(bytes: &[u8]) -> Option<Vec<PackedEvent>> {
    let word = |at: usize| Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?));
    let (count, gap_count) = (word(0)? as usize, word(4)? as usize);
    let gaps = bytes.get(8..8usize.checked_add(gap_count)?)?;
    let cells = bytes.get(8 + gap_count..)?;
    if cells.len() != count.checked_mul(2)? {
        return None;
    }
    let mut cells = cells.chunks_exact(2);
    let mut events = Vec::with_capacity(count);
    let mut now = 0u32;
    for &gap in gaps {
        if gap == ESCAPE {
            now = now.checked_add(GAP_MAX + 1)?;
            continue;
        }
        now = now.checked_add(u32::from(gap & 0x7f))?;
        let cell = cells.next()?;
        let (x, y) = (u16::from(cell[0]), u16::from(cell[1]));
        events.push(PackedEvent::new(now, x, y, gap & 0x80 != 0).ok()?);
    }
    cells.next().is_none().then_some(events)
}

fn deflate(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = ZlibEncoder::new(Vec::new(), Compression::fast());
    encoder
        .write_all(bytes)
        .and_then(|()| encoder.finish())
        .expect("a vector takes every byte")
}

/// Exactly `len` bytes, or `None`.
fn inflate(bytes: &[u8], len: usize) -> Option<Vec<u8>> {
    let mut out = Vec::with_capacity(len);
    let limit = len as u64 + 1;
    ZlibDecoder::new(bytes)
        .take(limit)
        .read_to_end(&mut out)
        .ok()?;
    (out.len() == len).then_some(out)
}

/// Smooth bytes: each as the difference from the one before it.
pub(super) fn pack_smooth(bytes: &[u8]) -> Vec<u8> {
    let mut last = 0u8;
    let differences: Vec<u8> = bytes
        .iter()
        .map(|&byte| byte.wrapping_sub(std::mem::replace(&mut last, byte)))
        .collect();
    deflate(&differences)
}

/// The inverse of [`pack_smooth`] for `len` bytes.
pub(super) fn unpack_smooth(bytes: &[u8], len: usize) -> Option<Vec<u8>> {
    let mut values = inflate(bytes, len)?;
    let mut last = 0u8;
    for value in &mut values {
        last = last.wrapping_add(*value);
        *value = last;
    }
    Some(values)
}

/// Depth truth: codes as differences from the one before, low bytes first, then high bytes.
pub(super) fn pack_depth(depth_m: &[f32]) -> Vec<u8> {
    let mut last = 0u16;
    let differences: Vec<[u8; 2]> = depth_m
        .iter()
        .map(|&depth| {
            let code = depth_code(depth);
            code.wrapping_sub(std::mem::replace(&mut last, code))
                .to_le_bytes()
        })
        .collect();
    let mut planes: Vec<u8> = differences.iter().map(|pair| pair[0]).collect();
    planes.extend(differences.iter().map(|pair| pair[1]));
    deflate(&planes)
}

/// The inverse of [`pack_depth`] for `len` depths, metres.
pub(super) fn unpack_depth(bytes: &[u8], len: usize) -> Option<Vec<f32>> {
    let planes = inflate(bytes, 2 * len)?;
    let (low, high) = planes.split_at(len);
    let mut last = 0u16;
    Some(
        low.iter()
            .zip(high)
            .map(|(&low, &high)| {
                last = last.wrapping_add(u16::from_le_bytes([low, high]));
                f32::from(last) / DEPTH_CODES_PER_M
            })
            .collect(),
    )
}

/// A mask, eight pixels to a byte.
pub(super) fn pack_mask(mask: &[bool]) -> Vec<u8> {
    let byte = |bits: &[bool]| {
        bits.iter()
            .enumerate()
            .fold(0u8, |byte, (i, &bit)| byte | u8::from(bit) << i)
    };
    deflate(&mask.chunks(8).map(byte).collect::<Vec<_>>())
}

/// The inverse of [`pack_mask`] for `len` pixels.
pub(super) fn unpack_mask(bytes: &[u8], len: usize) -> Option<Vec<bool>> {
    let packed = inflate(bytes, len.div_ceil(8))?;
    Some(
        (0..len)
            .map(|i| packed[i / 8] >> (i % 8) & 1 != 0)
            .collect(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn fields_come_back_as_they_were(
            gaps in prop::collection::vec((0u32..1000, 0u16..256, 0u16..256, any::<bool>()), 0..200),
            bytes in prop::collection::vec(any::<u8>(), 0..300),
            mask in prop::collection::vec(any::<bool>(), 0..300),
            codes in prop::collection::vec(any::<u16>(), 0..300),
        ) {
            let mut now = 0;
            let events: Vec<PackedEvent> = gaps
                .iter()
                .map(|&(gap, x, y, on)| {
                    now += gap;
                    PackedEvent::new(now, x, y, on).expect("small")
                })
                .collect();
            prop_assert_eq!(unpack_events(&pack_events(&events)), Some(events));
            prop_assert_eq!(unpack_smooth(&pack_smooth(&bytes), bytes.len()), Some(bytes));
            prop_assert_eq!(unpack_mask(&pack_mask(&mask), mask.len()), Some(mask));
            let depth: Vec<f32> = codes.iter().map(|&c| f32::from(c) / DEPTH_CODES_PER_M).collect();
            prop_assert_eq!(unpack_depth(&pack_depth(&depth), depth.len()), Some(depth));
        }

        #[test]
        fn any_bytes_are_refused_or_read(bytes in prop::collection::vec(any::<u8>(), 0..64)) {
            let _ = unpack_events(&bytes);
            prop_assert_eq!(unpack_smooth(&bytes, 1000), None);
            prop_assert_eq!(unpack_depth(&bytes, 1000), None);
            prop_assert_eq!(unpack_mask(&bytes, 10_000), None);
        }
    }

    #[test]
    fn depth_is_kept_to_a_millimetre_and_saturates() {
        assert_eq!(depth_code(0.0), 0);
        assert_eq!(depth_code(1e-6), 1, "a depth is never nothing");
        assert_eq!(depth_code(1e6), u16::MAX);
        let back = f32::from(depth_code(33.3333)) / DEPTH_CODES_PER_M;
        assert!((back - 33.3333).abs() < 1e-3, "{back}");
    }
}

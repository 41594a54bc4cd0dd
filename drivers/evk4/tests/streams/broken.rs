//! Whatever the bytes, decoding ends, does not depend on chunks, and every word is accounted for.

use noctule_evk4::{Decoder, Evt3Decoder, Format, Geometry};
use noctule_sensor::Stamp;
use proptest::collection::vec;
use proptest::prelude::*;

use crate::model::{Items, decode_evt3};
use crate::round_trip::{encode, timeline};

const FORMATS: [Format; 4] = [
    Format::Evt2,
    Format::Evt21,
    Format::Evt21Legacy,
    Format::Evt3,
];

/// Sizes that every kind of bounds check meets: a real one, odd ones, more than 11 bits, none.
fn geometry() -> impl Strategy<Value = Geometry> {
    prop_oneof![
        Just((1280, 720)),
        Just((640, 480)),
        (1_u16..2100, 1_u16..2100),
        Just((4000, 4000)),
        Just((65_535, 65_535)),
        Just((0, 0)),
    ]
    .prop_map(|(width, height)| Geometry { width, height })
}

/// EVT3 words of which most make sense together, so that deep states are reached.
fn likely_words() -> impl Strategy<Value = Vec<u8>> {
    let word = prop_oneof![
        4 => (0_u16..0x1000).prop_map(|v| vec![0x2000 | v]),
        3 => (0_u16..0x400).prop_map(|v| vec![v]),
        2 => (0_u16..0x1000).prop_map(|v| vec![0x6000 | v]),
        2 => (0_u16..40).prop_map(|v| vec![0x8000 | (v * 103) & 0xfff]),
        2 => (0_u16..0x500, 0_u16..2, any::<[u16; 3]>()).prop_map(|(base, on, [a, b, c])| vec![
            0x3000 | on << 11 | base,
            0x4000 | a & 0xfff,
            0x4000 | b & 0xfff,
            0x5000 | c & 0xfff,
        ]),
        1 => any::<[u16; 3]>().prop_map(|[a, b, c]| vec![
            0x4000 | a & 0xfff,
            0x4000 | b & 0xfff,
            0x5000 | c & 0xfff,
        ]),
        1 => (0_u16..0x1000).prop_map(|v| vec![0xa000 | v]),
        1 => any::<u16>().prop_map(|v| vec![v]),
    ];
    vec(word, 0..200).prop_map(|words| {
        let words = words.into_iter().flatten();
        words.flat_map(u16::to_le_bytes).collect()
    })
}

fn decode_in(decoder: &mut Decoder, bytes: &[u8], cuts: &[usize]) -> Items {
    let (mut items, mut rest) = (Items::default(), bytes);
    for &cut in cuts.iter().cycle() {
        if rest.is_empty() {
            break;
        }
        let (chunk, after) = rest.split_at(cut.min(rest.len()));
        decoder.decode(chunk, &mut items);
        rest = after;
    }
    decoder.finish();
    items
}

fn check_conservation(decoder: &Decoder, format: Format, bytes: &[u8]) {
    let (words, errors) = (decoder.words(), decoder.errors());
    assert_eq!(words.accounted(errors), words.words, "{words:?} {errors:?}");
    let word_len = format.word_len() as u64;
    let taken = words.words * word_len + errors.trailing_bytes;
    assert_eq!(taken, bytes.len() as u64, "{format:?}");
}

fn check_against_model(bytes: &[u8], geometry: Geometry, cuts: &[usize]) {
    let model = decode_evt3(bytes, geometry.width.into(), geometry.height.into());
    let mut decoder = Decoder::new(Format::Evt3, geometry);
    let items = decode_in(&mut decoder, bytes, cuts);
    assert_eq!(items, model.items);
    assert_eq!(decoder.errors(), &model.errors);
    assert_eq!(decoder.words().decoded, model.decoded);
    assert_eq!(decoder.words().out_of_bounds, model.out_of_bounds_words);
    check_conservation(&decoder, Format::Evt3, bytes);
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(300) })]

    #[test]
    fn random_bytes_are_taken_by_every_decoder_in_any_chunking(
        bytes in vec(any::<u8>(), 0..600),
        cuts in vec(1_usize..40, 1..8),
        geometry in geometry(),
    ) {
        for format in FORMATS {
            let mut whole = Decoder::new(format, geometry);
            let expected = decode_in(&mut whole, &bytes, &[usize::MAX]);
            check_conservation(&whole, format, &bytes);
            let mut cut = Decoder::new(format, geometry);
            prop_assert_eq!(decode_in(&mut cut, &bytes, &cuts), expected);
            prop_assert_eq!(cut.errors(), whole.errors());
            prop_assert_eq!(cut.words(), whole.words());
            prop_assert_eq!(cut.rate(), whole.rate());
            prop_assert_eq!(cut.watermark(), whole.watermark());
        }
    }

    #[test]
    fn likely_words_decode_as_the_model_says(
        bytes in likely_words(),
        cuts in vec(1_usize..40, 1..8),
        long_cuts in vec(1_usize..400, 1..8),
        geometry in geometry(),
    ) {
        check_against_model(&bytes, geometry, &[usize::MAX]);
        check_against_model(&bytes, geometry, &cuts);
        check_against_model(&bytes, geometry, &long_cuts);
    }

    #[test]
    fn flipped_bits_decode_as_the_model_says(
        steps in timeline(),
        flips in vec((any::<prop::sample::Index>(), 0_u8..8), 1..12),
        geometry in geometry(),
    ) {
        let mut bytes = encode(&steps);
        prop_assume!(!bytes.is_empty());
        for (at, bit) in flips {
            let at = at.index(bytes.len());
            bytes[at] ^= 1 << bit;
        }
        check_against_model(&bytes, geometry, &[usize::MAX]);
    }

    #[test]
    fn a_gap_anywhere_costs_no_more_than_what_it_cut(
        steps in timeline(),
        cut in any::<(prop::sample::Index, prop::sample::Index)>(),
    ) {
        let bytes = encode(&steps);
        let geometry = Geometry { width: 2048, height: 2048 };
        let mut all = Items::default();
        Evt3Decoder::new(geometry).decode(&bytes, &mut all);
        let (from, to) = (cut.0.index(bytes.len() + 1), cut.1.index(bytes.len() + 1));
        let (from, to) = (from.min(to) & !1, from.max(to) & !1);
        let (mut decoder, mut found) = (Evt3Decoder::new(geometry), Items::default());
        decoder.decode(&bytes[..from], &mut found);
        let before = found.0.len();
        prop_assert_eq!(&found.0[..], &all.0[..before]);
        decoder.gap();
        prop_assert_eq!(decoder.watermark(), None);
        // The host's clock stands in for what an undisturbed decoder knows at that point.
        let mut host = Evt3Decoder::new(geometry);
        host.decode(&bytes[..to], &mut Items::default());
        decoder.expect_near(host.watermark().unwrap_or_default());
        decoder.decode(&bytes[to..], &mut found);
        let after = &found.0[before..];
        prop_assert_eq!(after, &all.0[all.0.len() - after.len()..]);
        // Row and base follow every repeated TIME_HIGH, so nothing is taken without them.
        prop_assert_eq!(decoder.errors().missing_y, 0);
        prop_assert_eq!(decoder.errors().missing_vect_base, 0);
    }
}

#[test]
fn an_odd_byte_is_trailing_at_the_end_and_at_a_gap() {
    let geometry = Geometry {
        width: 640,
        height: 480,
    };
    for (format, odd) in [(Format::Evt3, 1), (Format::Evt2, 3), (Format::Evt21, 7)] {
        let mut decoder = Decoder::new(format, geometry);
        decoder.decode(&vec![0; odd], &mut Items::default());
        assert!(decoder.errors().is_clean());
        decoder.gap();
        assert_eq!(decoder.errors().trailing_bytes, odd as u64, "{format:?}");
        decoder.decode(&vec![0; odd], &mut Items::default());
        decoder.finish();
        assert_eq!(
            decoder.errors().trailing_bytes,
            2 * odd as u64,
            "{format:?}"
        );
    }
}

#[test]
fn a_hint_at_the_end_of_time_saturates() {
    let geometry = Geometry {
        width: 640,
        height: 480,
    };
    for high in [0x8000_u16, 0x8fff, 0x8800] {
        let words = [high, 0x6fff, 0x0001, 0x2001].map(u16::to_le_bytes);
        let (mut decoder, mut found) = (Evt3Decoder::new(geometry), Vec::new());
        decoder.expect_near(Stamp::MAX);
        decoder.decode(words.as_flattened(), &mut found);
        let far = Stamp::MAX.offset_nanos(-20_000_000_000);
        assert!(found.len() == 1 && found[0].t > far, "{found:?}");
        assert!(decoder.watermark() > Some(far));
    }
}

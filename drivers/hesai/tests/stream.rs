//! Streams made by the encoder: exact round trips, loss, disorder, steps and damage.
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::unwrap_used,
    reason = "made-up data, cut to size on purpose; a failure is a failed test"
)]

use noctule_hesai::{
    Arrival, Correction, Decoder, FireTimes, Model, Options, Packet, Qt64Echoes, Qt64Encoder,
    ReturnMode, Returns,
};
use noctule_sensor::{Return, Stamp};
use proptest::prelude::*;

const EPOCH_NS: u64 = 1_700_000_000_000_000_000;
const PACKET_NS: u64 = 333_332;

/// Echoes that differ from firing to firing.
fn echoes(seed: usize) -> Qt64Echoes {
    let word = |c: usize| ((seed * 64 + c) * 2_654_435_761) >> 7;
    Qt64Echoes {
        distance: std::array::from_fn(|c| (1 + word(c) % 65_535) as u16),
        intensity: std::array::from_fn(|c| word(c) as u8),
    }
}

/// Packet `n` of a sensor turning at 600 rpm, dual return, in step with the clock.
fn packet(n: usize) -> Vec<u8> {
    let number = u32::try_from(n).unwrap().wrapping_sub(5);
    let mut encoder = Qt64Encoder::new(ReturnMode::FirstLast, 600, number).unwrap();
    let firing = |f: usize| (azimuth(f), [echoes(2 * f), echoes(2 * f + 1)]);
    let t = Stamp::from_nanos(EPOCH_NS + n as u64 * PACKET_NS);
    encoder
        .dual(t, &[firing(2 * n), firing(2 * n + 1)])
        .unwrap()
        .to_vec()
}

fn azimuth(firing: usize) -> u16 {
    u16::try_from(firing % 600 * 60).unwrap()
}

fn decoder(returns: Returns) -> Decoder {
    Decoder::new(Options {
        returns,
        ..Options::new(Model::Qt64)
    })
    .unwrap()
}

fn collect(decoder: &mut Decoder, payload: &[u8]) -> Vec<(Return, u32)> {
    let mut found = Vec::new();
    decoder
        .decode(payload, &mut |r: Return, sweep| found.push((r, sweep)))
        .unwrap();
    found
}

fn feed(decoder: &mut Decoder, packets: impl IntoIterator<Item = usize>) {
    for n in packets {
        decoder.decode(&packet(n), &mut |_: Return, _| {}).unwrap();
    }
}

/// The formula in double precision.
fn place(r: &Return, block_cdeg: u16, units: u16) -> [f64; 3] {
    let laser = Correction::nominal(Model::Qt64).lasers()[usize::from(r.channel)];
    let d = f64::from(units) * 0.004;
    let a = (f64::from(block_cdeg) / 100.0 + laser.azimuth_deg).to_radians();
    let e = laser.elevation_deg.to_radians();
    [d * e.cos() * a.sin(), d * e.cos() * a.cos(), d * e.sin()]
}

#[test]
fn what_is_encoded_decodes_exactly_in_dual_return() {
    let mut decoder = decoder(Returns::All);
    let fire = FireTimes::nominal(Model::Qt64);
    for n in 0..40 {
        let found = collect(&mut decoder, &packet(n));
        assert_eq!(found.len(), 256);
        for (r, _) in found {
            let (c, block) = (usize::from(r.channel), usize::from(r.block));
            let firing = 2 * n + block / 2;
            let sent = echoes(2 * firing + block % 2);
            assert_eq!(r.intensity, sent.intensity[c]);
            // The packet's time is in whole microseconds.
            let start = (EPOCH_NS + n as u64 * PACKET_NS) / 1000 * 1000;
            let t = start + 35_710 + 166_666 * (block as u64 / 2);
            assert_eq!(r.t.as_nanos(), t + fire.channel_ns()[c] as u64);
            let truth = place(&r, azimuth(firing), sent.distance[c]);
            let d = f64::from(sent.distance[c]) * 0.004;
            for (a, b) in [r.x_m, r.y_m, r.z_m].into_iter().zip(truth) {
                assert!((f64::from(a) - b).abs() < 1e-6 + 2e-7 * d, "{a} {b}");
                assert!(
                    d > 60.0 || (f64::from(a) - b).abs() < 1e-5,
                    "{a} {b} at {d}"
                );
            }
            let units = (truth.iter().map(|v| v * v).sum::<f64>().sqrt() / 0.004).round();
            assert_eq!(units, f64::from(sent.distance[c]));
        }
    }
}

#[test]
fn single_return_has_four_firings_a_packet() {
    for mode in [
        ReturnMode::First,
        ReturnMode::Second,
        ReturnMode::Strongest,
        ReturnMode::Last,
    ] {
        let mut encoder = Qt64Encoder::new(mode, 600, 0).unwrap();
        let firings = std::array::from_fn(|f| (azimuth(f), echoes(f)));
        let bytes = encoder
            .single(Stamp::from_nanos(EPOCH_NS), &firings)
            .unwrap();
        let mut decoder = decoder(Returns::Unique);
        let found = collect(&mut decoder, &bytes);
        assert_eq!(found.len(), 256);
        for (r, _) in found {
            let block = u64::from(r.block);
            let fire = FireTimes::nominal(Model::Qt64).channel_ns()[usize::from(r.channel)] as u64;
            assert_eq!(r.t.as_nanos(), EPOCH_NS + 35_710 + 166_666 * block + fire);
        }
        assert_eq!(
            (decoder.counts().returns, decoder.counts().points),
            (256, 256)
        );
    }
}

#[test]
fn every_dual_mode_pairs_its_blocks_and_equal_echoes_count_once() {
    for byte in [0x39, 0x3a, 0x3b, 0x3c, 0x3e] {
        let mode = ReturnMode::from_byte(byte).unwrap();
        let mut encoder = Qt64Encoder::new(mode, 600, 0).unwrap();
        let mut second = echoes(1);
        second.distance[7] += 1;
        let firings = [(0, [echoes(1), second]), (60, [echoes(2), echoes(2)])];
        let bytes = encoder.dual(Stamp::from_nanos(EPOCH_NS), &firings).unwrap();
        let mut decoder = decoder(Returns::Unique);
        let found = collect(&mut decoder, &bytes);
        assert_eq!(found.len(), 129);
        let first_blocks: Vec<_> = found.iter().filter(|(r, _)| r.block % 2 == 0).collect();
        assert_eq!(first_blocks.len(), 1);
        assert_eq!(first_blocks[0].0.channel, 7);
        assert_eq!(
            (decoder.counts().returns, decoder.counts().points),
            (256, 129)
        );
    }
}

#[test]
fn a_microsecond_field_of_a_whole_second_is_the_next_second() {
    let mut bytes = packet(0);
    bytes[1056..1060].copy_from_slice(&1_000_000u32.to_le_bytes());
    let packet = Packet::new(Model::Qt64, &bytes).unwrap();
    assert_eq!(packet.time_ns(), EPOCH_NS + 1_000_000_000);
    bytes[1056..1060].copy_from_slice(&1_000_001u32.to_le_bytes());
    assert_eq!(
        Packet::new(Model::Qt64, &bytes).unwrap_err().key(),
        "micros"
    );
}

#[test]
fn packets_without_numbers_and_with_bytes_appended_decode_alike() {
    let mut numbered = decoder(Returns::All);
    let expected: Vec<_> = (0..700)
        .map(|n| collect(&mut numbered, &packet(n)))
        .collect();
    let mut plain = decoder(Returns::All);
    let mut longer = decoder(Returns::All);
    for (n, expected) in expected.iter().enumerate() {
        let mut bytes = packet(n);
        assert_eq!(
            &collect(&mut longer, &[&bytes[..], &[7; 33]].concat()),
            expected
        );
        bytes[11] = 0;
        bytes.truncate(1068);
        assert_eq!(&collect(&mut plain, &bytes), expected);
    }
    assert_eq!(plain.counts(), numbered.counts());
    assert_eq!(longer.counts(), numbered.counts());
}

#[test]
fn the_year_may_count_from_1900_or_2000() {
    let (early, mut late) = (packet(0), packet(0));
    assert_eq!(early[1062], 123);
    late[1062] = 23;
    let time = |bytes: &[u8]| Packet::new(Model::Qt64, bytes).unwrap().time_ns();
    assert_eq!(time(&early), time(&late));
}

#[test]
fn sweeps_are_cut_per_channel_wherever_configured() {
    for cut_azimuth_cdeg in [0, 1, 9_000, 35_999] {
        let options = Options {
            cut_azimuth_cdeg,
            returns: Returns::All,
            ..Options::new(Model::Qt64)
        };
        let mut decoder = Decoder::new(options).unwrap();
        let mut last = [None::<(u32, i32)>; 64];
        let mut cuts = 0;
        for n in 0..900 {
            for (r, sweep) in collect(&mut decoder, &packet(n)) {
                let from_cut =
                    (i32::from(r.azimuth_cdeg) - i32::from(cut_azimuth_cdeg)).rem_euclid(36_000);
                let last = &mut last[usize::from(r.channel)];
                if let Some((before, azimuth)) = *last {
                    let wrapped = from_cut < azimuth;
                    assert_eq!(sweep, before + u32::from(wrapped), "channel {}", r.channel);
                    cuts += u32::from(wrapped);
                }
                *last = Some((sweep, from_cut));
            }
        }
        assert_eq!(cuts, 3 * 64, "cut at {cut_azimuth_cdeg}");
    }
}

#[test]
fn loss_disorder_and_doubles_are_told_apart_and_change_no_sweep() {
    let mut whole = decoder(Returns::All);
    let expected: Vec<_> = (0..1_300)
        .map(|n| collect(&mut whole, &packet(n)))
        .collect();
    let mut hurt = decoder(Returns::All);
    let mut order: Vec<usize> = (0..1_300).collect();
    order.swap(400, 402); // 402 401 400
    order.insert(410, 405); // once more
    order.drain(700..723); // 22 lost, and with them a seam
    let mut decoded = 0;
    for &n in &order {
        let found = collect(&mut hurt, &packet(n));
        if !found.is_empty() {
            assert_eq!(found, expected[n], "{n}");
            decoded += 1;
        }
    }
    let counts = hurt.counts();
    assert_eq!((counts.lost, counts.late, counts.duplicate), (23, 2, 1));
    assert_eq!((counts.packets, decoded), (1_278, 1_277));
    assert_eq!((counts.restarts, counts.clock_steps), (0, 0));
    assert_eq!(counts.sweeps, whole.counts().sweeps);
    assert!(counts.sweeps_complete < whole.counts().sweeps_complete);
}

#[test]
fn the_watermark_waits_for_a_late_packet_and_is_kept() {
    let mut decoder = decoder(Returns::All);
    let mut watermark = Stamp::ZERO;
    for n in [0, 1, 2, 5, 6, 4, 3, 7, 8, 30, 31] {
        let promised = watermark;
        decoder
            .decode(&packet(n), &mut |r: Return, _| {
                assert!(r.t >= promised, "packet {n}")
            })
            .unwrap();
        watermark = decoder.watermark().unwrap();
        assert!(watermark >= promised);
    }
    let info = |n| {
        Decoder::new(Options::new(Model::Qt64))
            .unwrap()
            .decode(&packet(n), &mut |_: Return, _| {})
    };
    assert_eq!(watermark, info(8).unwrap().last, "held before the gap");
    feed(&mut decoder, 32..60);
    assert_eq!(
        decoder.watermark(),
        Some(info(59).unwrap().last),
        "but not for ever"
    );
}

#[test]
fn a_clock_step_opens_an_epoch_and_costs_its_sweep() {
    let mut decoder = decoder(Returns::All);
    feed(&mut decoder, 0..450);
    let mut stepped = |n: usize, seconds: u64| {
        let mut bytes = packet(n);
        let date = EPOCH_NS / 1_000_000_000 + seconds;
        bytes[1062] = 0;
        bytes[1064..1068].copy_from_slice(&u32::try_from(date).unwrap().to_be_bytes());
        let micros = (n as u64 * PACKET_NS / 1000) as u32;
        bytes[1056..1060].copy_from_slice(&micros.to_le_bytes());
        decoder.decode(&bytes, &mut |_: Return, _| {}).unwrap()
    };
    assert_eq!(
        stepped(450, 0).epoch,
        0,
        "the other date encoding is no step"
    );
    let info = stepped(451, 37);
    assert_eq!((info.arrival, info.epoch), (Arrival::Next, 1));
    let infos: Vec<_> = (452..1_500).map(|n| stepped(n, 37).epoch).collect();
    assert!(infos.iter().all(|&epoch| epoch == 1));
    let counts = decoder.counts();
    assert_eq!(
        (counts.clock_steps, counts.lost, counts.restarts),
        (1, 0, 0)
    );
    // Sweeps 0 and 1 begin before the first packet, 2 holds the step, 5 and 6 do not end.
    assert_eq!((counts.sweeps, counts.sweeps_complete), (7, 2));
}

#[test]
fn turning_while_firing_moves_points_by_speed_and_time() {
    let mut still = decoder(Returns::All);
    let options = Options {
        returns: Returns::All,
        turn_while_firing: true,
        ..Options::new(Model::Qt64)
    };
    let mut turning = Decoder::new(options).unwrap();
    let fire = FireTimes::nominal(Model::Qt64);
    let (a, b) = (
        collect(&mut still, &packet(100)),
        collect(&mut turning, &packet(100)),
    );
    for ((still, _), (turned, _)) in a.iter().zip(&b) {
        let angle = |r: &Return| f64::from(r.x_m).atan2(f64::from(r.y_m)).to_degrees();
        let expected = 600.0 * 6e-9 * f64::from(fire.channel_ns()[usize::from(still.channel)]);
        let turned_deg = (angle(turned) - angle(still) + 540.0).rem_euclid(360.0) - 180.0;
        assert!(
            (turned_deg - expected).abs() < 1e-4,
            "{turned_deg} for {expected}"
        );
        assert_eq!((still.z_m, still.t), (turned.z_m, turned.t));
    }
}

#[test]
fn the_optical_centre_keeps_distances_and_shifts_beams() {
    let options = Options {
        returns: Returns::All,
        optical_centre_m: Some(Options::QT64_CENTRE_M),
        ..Options::new(Model::Qt64)
    };
    let mut centred = Decoder::new(options).unwrap();
    let (a, b) = (
        collect(&mut decoder(Returns::All), &packet(3)),
        collect(&mut centred, &packet(3)),
    );
    let o = Options::QT64_CENTRE_M.map(f64::from);
    for ((plain, _), (r, _)) in a.iter().zip(&b) {
        let p = [plain.x_m, plain.y_m, plain.z_m].map(f64::from);
        let d = p.iter().map(|v| v * v).sum::<f64>().sqrt();
        let u = p.map(|v| v / d);
        let along: f64 = u.iter().zip(o).map(|(u, o)| u * o).sum();
        let s = (along * along - o.iter().map(|o| o * o).sum::<f64>() + d * d).sqrt() - along;
        for (found, (u, o)) in [r.x_m, r.y_m, r.z_m].iter().zip(u.iter().zip(o)) {
            assert!((f64::from(*found) - (s * u + o)).abs() < 1e-5 + 2e-7 * d);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(512))]

    #[test]
    fn random_bytes_of_every_length_are_counted_not_feared(
        start in 0..8usize,
        bytes in prop::collection::vec(any::<u8>(), 0..1_400),
    ) {
        let mut bytes = bytes;
        let starts: [&[u8]; 8] = [
            &[0xee, 0xff, 3, 1, 0, 0, 64, 4, 1, 4, 2, 1],
            &[0xee, 0xff, 3, 2, 0, 0, 128, 2, 1, 4, 2, 0x1d],
            &[0xee, 0xff, 6, 1, 0, 0, 32, 8, 1, 4, 2, 1],
            &[0xee, 0xff, 6, 1, 0, 0, 16, 8, 1, 4, 2, 1],
            &[0xee, 0xff, 6, 1, 0, 0, 32, 6, 1, 5, 3, 1],
            &[0xee, 0xff, 64, 6, 0, 4],
            &[0xff, 0xee],
            &[],
        ];
        let given = starts[start].len().min(bytes.len());
        bytes[..given].copy_from_slice(&starts[start][..given]);
        for model in Model::ALL {
            let mut decoder = Decoder::new(Options::new(model)).unwrap();
            let mut returns = 0;
            let result = decoder.decode(&bytes, &mut |_: Return, _| returns += 1u64);
            let counts = decoder.counts();
            prop_assert_eq!(counts.packets + counts.rejected.total(), 1);
            prop_assert_eq!(result.is_ok(), counts.packets == 1);
            prop_assert_eq!(returns, counts.points);
        }
    }

    #[test]
    fn a_packet_cut_short_is_rejected_as_short(len in 0..1_072usize) {
        let mut decoder = decoder(Returns::All);
        let error = decoder.decode(&packet(3)[..len], &mut |_: Return, _| {}).unwrap_err();
        prop_assert_eq!(error.key(), "short");
    }

    #[test]
    fn damaged_streams_conserve_their_packets(
        flips in prop::collection::vec((0..60usize, any::<prop::sample::Index>(), 0..8u8), 0..40),
        order in prop::collection::vec(0..60usize, 1..120),
    ) {
        let mut packets: Vec<_> = (0..60).map(|n| packet(n * 11)).collect();
        for (n, at, bit) in flips {
            let at = at.index(packets[n].len());
            packets[n][at] ^= 1 << bit;
        }
        let mut decoder = decoder(Returns::All);
        let mut returns = 0;
        for &n in &order {
            let _counted = decoder.decode(&packets[n], &mut |_: Return, _| returns += 1u64);
        }
        let counts = decoder.counts();
        prop_assert_eq!(counts.packets + counts.rejected.total(), order.len() as u64);
        prop_assert_eq!(counts.returns, returns);
        prop_assert!(counts.points <= counts.returns);
        prop_assert!(counts.sweeps_complete <= counts.sweeps);
        prop_assert!(counts.late + counts.duplicate <= counts.packets);
    }
}

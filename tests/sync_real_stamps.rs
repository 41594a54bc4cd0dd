//! The envelope fit on host stamps of real event cameras: fitted to the even packets, judged by
//! the odd ones. The captures are found through `NOCTULE_DATA`; without it these tests say so and
//! rest on the simulated clocks of `sync_clocks`.
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::print_stdout,
    clippy::unwrap_used,
    reason = "simulated instants are positive and small; a test may stop where it stands"
)]

use std::path::{Path, PathBuf};

use noctule::sync::{EnvelopeConfig, EnvelopeFit};
use noctule_evk4::{Decoder, EventSink, RawHeader};
use noctule_sensor::{ClockMap, Event, Evk4, Realtime, Stamp, TriggerEdge};

/// One transfer: newest sensor time in it, and when the host had it.
#[derive(Clone, Copy)]
struct Packet {
    newest: Stamp<Evk4>,
    driver: Stamp<Realtime>,
}

#[derive(Default)]
struct Newest {
    event: Option<Stamp<Evk4>>,
    edges: Vec<TriggerEdge>,
}

impl EventSink for Newest {
    fn event(&mut self, event: Event) {
        self.event = self.event.max(Some(event.t));
    }

    fn trigger(&mut self, edge: TriggerEdge) {
        self.event = self.event.max(Some(edge.t));
        self.edges.push(edge);
    }
}

fn captures() -> Option<PathBuf> {
    let dir = std::env::var_os("NOCTULE_DATA").map(|d| PathBuf::from(d).join("events"));
    if dir.is_none() {
        eprintln!("SKIPPED: NOCTULE_DATA is not set, no real packet stamps to fit");
    }
    dir
}

/// Reads `name.raw` packet by packet as `name.packets.csv` cuts it.
fn read(dir: &Path, name: &str) -> (Vec<Packet>, Vec<TriggerEdge>) {
    let raw = std::fs::read(dir.join(format!("{name}.raw"))).expect("the capture is there");
    let rows = std::fs::read_to_string(dir.join(format!("{name}.packets.csv"))).unwrap();
    let (header, _) = RawHeader::parse(&raw).unwrap();
    let mut decoder = Decoder::new(header.format, header.geometry);
    let mut sink = Newest::default();
    let mut packets = Vec::new();
    for row in rows.lines().skip(1) {
        let field: Vec<u64> = row.split(',').map(|f| f.parse().unwrap()).collect();
        let (offset, len) = (field[1] as usize, field[2] as usize);
        decoder.decode(&raw[offset..offset + len], &mut sink);
        if let Some(newest) = sink.event {
            packets.push(Packet {
                newest,
                driver: Stamp::from_nanos(field[3]),
            });
        }
    }
    (packets, sink.edges)
}

/// Buckets short enough for captures of a second and a half.
fn short_capture() -> EnvelopeConfig {
    EnvelopeConfig {
        bucket_ns: 100_000_000,
        bucket_count_min: 4,
        buckets_settled: 6,
        // These drivers hand over a packet every 4 to 12 ms, the first ones late.
        step_ns: 10_000_000,
        ..EnvelopeConfig::usb()
    }
}

fn fit_even(packets: &[Packet]) -> EnvelopeFit<Evk4, Realtime> {
    let mut fit = EnvelopeFit::new(short_capture());
    for packet in packets.iter().step_by(2) {
        fit.observe(packet.newest, packet.driver);
    }
    fit
}

/// Odd packets' arrival after the envelope, sorted, nanoseconds.
fn residuals(packets: &[Packet], map: &ClockMap<Evk4, Realtime>) -> Vec<i64> {
    let odd = packets.iter().skip(1).step_by(2);
    let mut residuals: Vec<i64> = odd
        .map(|p| p.driver.diff_nanos(map.apply(p.newest)))
        .collect();
    residuals.sort_unstable();
    residuals
}

fn report(name: &str, packets: &[Packet]) -> (Vec<i64>, ClockMap<Evk4, Realtime>) {
    let fit = fit_even(packets);
    let map = *fit.map().expect("the even packets make a map");
    let sorted = residuals(packets, &map);
    let at = |share: usize| sorted[(sorted.len() * share / 100).min(sorted.len() - 1)] as f64 / 1e3;
    println!(
        "{name}: {} packets, rate {} ppb, bound {:.1} us + {} ppb, epochs {}; odd packets after \
         the envelope: min {:.1}, p1 {:.1}, p50 {:.1}, p99 {:.1}, max {:.1} us",
        packets.len(),
        map.rate_ppb,
        map.uncertainty_ns as f64 / 1e3,
        map.growth_ppb,
        fit.epoch(),
        at(0),
        at(1),
        at(50),
        at(99),
        at(100),
    );
    assert_eq!(fit.epoch(), 0, "one capture, one epoch: {:?}", fit.counts());
    (sorted, map)
}

/// 640x480, trigger out looped to trigger in, an edge every 500 us, host stamps of the driver.
#[test]
fn looped_trigger_keeps_its_period_in_sensor_time_and_in_host_time() {
    let Some(dir) = captures() else { return };
    let (packets, edges) = read(&dir, "vga_trigger_loop_a");
    let (sorted, map) = report("vga_trigger_loop_a", &packets);
    assert!(sorted[0] > -1_000_000 && sorted[sorted.len() / 2] < 20_000_000);
    assert_eq!(edges.len(), 2650);
    let mut spacings: Vec<i64> = edges
        .windows(2)
        .map(|w| w[1].t.diff_nanos(w[0].t))
        .collect();
    spacings.sort_unstable();
    let (first, last) = (edges[0].t, edges[edges.len() - 1].t);
    let turns = (edges.len() - 1) as f64;
    let sensor_us = last.diff_nanos(first) as f64 / turns / 1e3;
    let host_us = map.apply(last).diff_nanos(map.apply(first)) as f64 / turns / 1e3;
    println!(
        "looped trigger: mean spacing {sensor_us:.4} us on the sensor's clock (min {}, max {} us), \
         {host_us:.4} us on the host's",
        spacings[0] / 1000,
        spacings[spacings.len() - 1] / 1000
    );
    assert!((sensor_us - 500.0).abs() < 0.01, "{sensor_us}");
    // 200 ppm is the bound on any oscillator's skew.
    assert!((host_us - sensor_us).abs() < 0.1 + map.growth_ppb as f64 * 500e-9);
}

/// 1280x720, two trigger words, a packet every 12 ms.
#[test]
fn host_stamps_of_an_hd_camera_lie_close_to_their_envelope() {
    let Some(dir) = captures() else { return };
    let (packets, edges) = read(&dir, "hd720_trigger2");
    assert_eq!(edges.len(), 2);
    let (sorted, _) = report("hd720_trigger2", &packets);
    assert!(sorted[0] > -1_000_000 && sorted[sorted.len() / 2] < 20_000_000);
}

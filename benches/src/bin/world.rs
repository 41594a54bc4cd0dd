//! The world's renderer beside a plain one that casts every pixel's ray at every object, and how
//! many training samples a core makes per second, in one run.
//!
//! Times are CPU seconds of this process on one thread (`/proc/self/stat`), so that a busy machine
//! does not disturb them.

#![allow(clippy::print_stdout, reason = "a report")]

use std::fs;

use std::time::{Duration, Instant};

use noctule_world::{
    DriveOptions, Frame, Horizon, Optics, Sample, Scene, Snapshot, Tier, record_drive, render,
};

/// CPU seconds of this process so far, in ticks of 10 ms.
fn cpu_s() -> f64 {
    let stat = fs::read_to_string("/proc/self/stat").expect("Linux tells about this process");
    let fields: Vec<&str> = stat[stat.rfind(')').expect("the name is in brackets") + 2..]
        .split(' ')
        .collect();
    let ticks: f64 = fields[11].parse::<f64>().expect("user ticks")
        + fields[12].parse::<f64>().expect("system ticks");
    ticks / 100.0
}

/// CPU milliseconds of one call, over enough calls for the clock's resolution.
fn time_ms(mut work: impl FnMut()) -> f64 {
    work();
    let (start, mut calls) = (cpu_s(), 0);
    while cpu_s() - start < 1.0 {
        work();
        calls += 1;
    }
    (cpu_s() - start) * 1e3 / f64::from(calls)
}

/// Depth of every pixel, one ray at a time against every object.
fn plain_depth(snapshot: &Snapshot, optics: &Optics) -> Vec<f32> {
    let size = optics.size;
    (0..size * size)
        .map(|i| {
            let (x, y) = ((i % size) as f32, (i / size) as f32);
            let ray = [optics.slope(x), optics.slope(y), 1.0];
            snapshot
                .cast([0.0; 3], ray, 0.2)
                .map_or(0.0, |(depth, _)| depth)
        })
        .collect()
}

fn main() {
    let threads = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .expect("one thread starts");
    threads.install(|| {
        println!("one 256x256 render, one thread, CPU ms (mean of 8 seeds)");
        let optics = Optics::new(256);
        let (mut tiled, mut plain, mut worst) = (0.0, 0.0, 0.0_f32);
        for seed in 101..109 {
            let scene = Scene::new(seed, 2.0, true);
            let snapshot = Snapshot::new(&scene, 1.1, Horizon::CAMERA);
            let mut frame = Frame::new(256);
            tiled += time_ms(|| render(&scene, &snapshot, &optics, &mut frame)) / 8.0;
            let mut depth = Vec::new();
            plain += time_ms(|| depth = plain_depth(&snapshot, &optics)) / 8.0;
            let differ = frame
                .depth
                .iter()
                .zip(&depth)
                .map(|(a, b)| (a - b).abs() / b.max(1.0));
            worst = worst.max(differ.fold(0.0, f32::max));
        }
        println!("  tiled, depth and light      {tiled:8.2}");
        println!(
            "  plain single ray, depth only{plain:8.2}   ratio {:.1}",
            plain / tiled
        );
        println!("  largest relative difference of depth {worst:.1e}");
        println!("one sample, 256x256, 8 steps: exposure, events, LiDAR, truth (8 seeds)");
        for tier in Tier::ALL {
            let start = cpu_s();
            let frames: usize = (101..109)
                .map(|seed| Sample::render(seed, tier, 256).sub_frames + 9)
                .sum();
            let seconds = (cpu_s() - start) / 8.0;
            let letter = tier.letter();
            println!(
                "  tier {letter}: {seconds:.3} CPU s, {:.2} samples/s/core, {} renders each",
                1.0 / seconds,
                frames / 8
            );
        }
    });
    record();
}

/// A whole drive at full size, on all threads.
fn record() {
    let dir = std::env::temp_dir().join(format!("noctule-bench-world-{}", std::process::id()));
    let options = DriveOptions::new(101, Tier::B, Duration::from_secs(2));
    let (cpu, wall) = (cpu_s(), Instant::now());
    let summary = record_drive(&options, &dir, |_| {});
    let (cpu, wall) = (cpu_s() - cpu, wall.elapsed().as_secs_f64());
    let removed = fs::remove_dir_all(&dir);
    let summary = summary.expect("the temporary folder can be written");
    removed.expect("what was written can be removed");
    println!("a drive of 2 s, tier B, 512x512, with truth: {cpu:.1} CPU s, {wall:.1} s elapsed");
    let (frames, events, exposures) = (summary.frames, summary.events, summary.exposures);
    println!("  {frames} frames, {events} events, {exposures} exposures");
}

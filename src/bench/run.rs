//! Closing of an exposure to bundle sent, under load, beside a copy of the bundle.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use noctule_recording::Recording;

use super::load::{EventLoad, LoadError, write_load};
use super::report::{HostBench, HostRow};
use crate::bus::{BusError, Ipc, Owner, Ports};
use crate::config::Config;
use crate::host::{BusOutlet, HostReport};
use crate::ingest::Pace;
use crate::latency::{Latency, monotonic_ns};
use crate::replay::{HostOptions, Prepared, ReplayError, run_host};

/// Copies timed for the baseline, before and after every rate.
const COPIES: usize = 40;

/// Why the benchmark could not run.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    /// The load.
    #[error(transparent)]
    Load(#[from] LoadError),
    /// The host.
    #[error(transparent)]
    Replay(#[from] ReplayError),
    /// The bus.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// The recording made.
    #[error(transparent)]
    Recording(#[from] noctule_recording::RecordingError),
    /// A folder.
    #[error("{path}: {cause}")]
    Folder {
        /// Which.
        path: String,
        /// Why.
        cause: std::io::Error,
    },
}

/// Runs the real host at real-time pace on loads of these rates, into shared memory that somebody
/// reads. `scratch` is a folder with room for the load; it is emptied after each rate.
///
/// # Errors
/// When a part fails.
pub fn bench_host(
    config: &Config,
    rates_mev_s: &[u32],
    seconds: u32,
    source: Option<&Path>,
    scratch: &Path,
    say: &dyn Fn(&str),
) -> Result<HostBench, BenchError> {
    let bundle_bytes = config.bundle_layout().bytes();
    let from = vec![1_u8; bundle_bytes];
    let mut to = vec![0_u8; bundle_bytes];
    let mut copy = Latency::default();
    let mut reports = Vec::new();
    for &rate_mev_s in rates_mev_s {
        let dir = scratch.join(format!("{rate_mev_s}-mev-s"));
        let folder = |cause| BenchError::Folder {
            path: dir.display().to_string(),
            cause,
        };
        std::fs::create_dir_all(scratch).map_err(folder)?;
        say(&format!("making {seconds} s of {rate_mev_s} Mev/s"));
        write_load(
            EventLoad {
                rate_mev_s,
                seconds,
            },
            source,
            &dir,
        )?;
        say(&format!("running the host at {rate_mev_s} Mev/s"));
        time_copies(&from, &mut to, &mut copy);
        let report = run_rate(config, &dir);
        time_copies(&from, &mut to, &mut copy);
        std::fs::remove_dir_all(&dir).map_err(folder)?;
        reports.push((rate_mev_s, report?));
    }
    let at = |percent| copy.percentile_us(percent).unwrap_or(f64::NAN);
    let (copy_p50_us, copy_p99_us) = (at(50.0), at(99.0));
    let rows = reports
        .iter()
        .map(|(rate, report)| row(*rate, report, copy_p50_us))
        .collect();
    Ok(HostBench {
        bundle_bytes,
        copy_p50_us,
        copy_p99_us,
        rows,
    })
}

fn time_copies(from: &[u8], to: &mut [u8], copy: &mut Latency) {
    for _ in 0..COPIES {
        let start = monotonic_ns();
        to.copy_from_slice(from);
        std::hint::black_box(&to);
        copy.record(start, monotonic_ns());
    }
}

fn run_rate(config: &Config, dir: &Path) -> Result<HostReport, BenchError> {
    let prepared = Prepared::new(Recording::open(dir)?, config)?;
    let owner = Owner::<Ipc>::create(config.instance(), config.limits())?;
    let (stop, done) = (AtomicBool::new(false), AtomicBool::new(false));
    thread::scope(|scope| {
        let reader = scope.spawn(|| read_bundles(config, &done));
        let outlet = BusOutlet::new(owner.ports().bundle_sender()?);
        let options = HostOptions {
            pace: Pace::REALTIME,
            piece_bytes: None,
        };
        let report = run_host(&prepared, config, outlet, options, &stop);
        done.store(true, Ordering::Relaxed);
        if let Ok(read) = reader.join() {
            read?;
        }
        Ok(report?)
    })
}

/// Takes every bundle, as inference would.
fn read_bundles(config: &Config, done: &AtomicBool) -> Result<(), BusError> {
    let ports = Ports::<Ipc>::open(config.instance(), "reader", config.limits())?;
    let receiver = ports.bundle_receiver()?;
    while !done.load(Ordering::Relaxed) {
        while receiver.receive()?.is_some() {}
        receiver.wait(Duration::from_millis(20))?;
    }
    Ok(())
}

fn row(rate_mev_s: u32, report: &HostReport, copy_p50_us: f64) -> HostRow {
    let stage = report
        .stages
        .iter()
        .find(|s| s.stage == "close -> bundle sent");
    let of = |pick: fn(&crate::latency::StageRow) -> Option<f64>| {
        stage.and_then(pick).unwrap_or(f64::NAN)
    };
    let (p50, p99) = (of(|s| s.p50_us), of(|s| s.p99_us));
    HostRow {
        rate_mev_s,
        bundles: report.bundles.sent,
        events: report.streams.iter().map(|s| s.received).sum(),
        events_rastered: report.raster.events,
        close_to_sent_p50_us: p50,
        close_to_sent_p99_us: p99,
        close_to_sent_max_us: of(|s| s.max_us),
        ratio_p50: p50 / copy_p50_us,
        ratio_p99: p99 / copy_p50_us,
        retimed: [report.raster.exact, report.raster.delta, report.raster.full],
    }
}

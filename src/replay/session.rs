//! A whole run: services, host, inference process, observer; and everything cleared away after.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use super::gate::GatedOutlet;
use super::host::{HostOptions, Prepared, ReplayError, run_host};
use super::report::RunReport;
use crate::bus::{Ipc, Owner, Ports};
use crate::config::Config;
use crate::frame::ModelId;
use crate::host::BusOutlet;
use crate::infer::InferReport;
use crate::observe::{Gate, Observed, Watch, watch};
use crate::supervise::Supervised;

/// How long the inference process may take to load and warm its models.
const READY_WITHIN: Duration = Duration::from_secs(120);
/// How often the supervisor looks.
const LOOK: Duration = Duration::from_millis(20);

/// What to run.
#[derive(Debug, Clone)]
pub struct SessionOptions {
    /// How the host runs.
    pub host: HostOptions,
    /// No dropping, one fixed model.
    pub lossless: bool,
    /// The model, over the configuration's.
    pub model: Option<ModelId>,
    /// Configuration file that the inference process is to read.
    pub config_path: Option<PathBuf>,
    /// The program to start as inference process: this one's path.
    pub program: PathBuf,
    /// Exposures kept for pictures and scores.
    pub keep: usize,
}

/// What a run left.
#[derive(Debug)]
pub struct Session {
    /// The report.
    pub report: RunReport,
    /// What the observer kept.
    pub observed: Observed,
}

impl Session {
    /// Runs a recording through two processes over shared memory; `progress` is called now and
    /// then with the bundles and depth maps seen so far.
    ///
    /// # Errors
    /// When any part fails; what was started is stopped and cleared away.
    pub fn run(
        prepared: &Prepared,
        config: &Config,
        options: &SessionOptions,
        stop: &Arc<AtomicBool>,
        progress: &dyn Fn(u64, u64),
    ) -> Result<Self, ReplayError> {
        let instance = config.instance();
        let owner = Owner::<Ipc>::create(instance.clone(), config.limits())?;
        let mut infer =
            Supervised::start("infer", options.program.clone(), infer_arguments(config, options))?;
        let gate = Arc::new(Gate::default());
        let (watching, host_done) = (AtomicBool::new(false), AtomicBool::new(false));
        let keep = Watch { keep: options.keep, digest: true, linger: Duration::from_millis(300) };

        let (host, observed, infer) = thread::scope(|scope| {
            let observer = scope.spawn(|| {
                let ports = Ports::<Ipc>::open(instance.clone(), "observer", config.limits())?;
                watch(&ports, keep, &gate, &watching, &host_done)
            });
            let host = scope.spawn(|| {
                let done = SetOnDrop(&host_done);
                let host = host_thread(prepared, config, options, &gate, stop, &watching);
                drop(done);
                host
            });
            let mut failed = None;
            while !host.is_finished() {
                if let Err(error) = infer.watch().inspect(|restarted| {
                    if *restarted {
                        owner.clean_dead();
                    }
                }) {
                    failed = Some(error);
                    stop.store(true, Ordering::Relaxed);
                    break;
                }
                progress(
                    gate.bundles_seen.load(Ordering::Relaxed),
                    gate.frames_seen.load(Ordering::Relaxed),
                );
                thread::sleep(LOOK);
            }
            let host = host.join().map_err(|_| ReplayError::Thread("host"))?;
            if failed.is_none() {
                wait_for_frames(&gate, config, options, stop);
            }
            let observed = observer.join().map_err(|_| ReplayError::Thread("observer"))?;
            if let Some(error) = failed {
                return Err(error.into());
            }
            Ok::<_, ReplayError>((host?, observed?, infer))
        })?;

        let restarts = infer.restarts();
        let mut inferred = InferReport::default();
        for life in infer.finish::<InferReport>() {
            inferred.add(&life);
        }
        owner.clean_dead();
        drop(owner);
        let report = RunReport::new(prepared, options.host.pace, host, inferred, restarts, &observed, instance.residue().len());
        Ok(Self { report, observed })
    }
}

struct SetOnDrop<'a>(&'a AtomicBool);

impl Drop for SetOnDrop<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Release);
    }
}

fn infer_arguments(config: &Config, options: &SessionOptions) -> Vec<String> {
    let mut arguments = vec!["infer".to_owned(), "--instance".to_owned(), config.instance.clone()];
    if let Some(path) = &options.config_path {
        arguments.extend(["--config".to_owned(), path.display().to_string()]);
    }
    if let Some(model) = options.model {
        arguments.extend(["--model".to_owned(), model.to_string()]);
    }
    if options.lossless {
        arguments.push("--lossless".to_owned());
    }
    arguments
}

/// The host, once somebody is there to receive.
fn host_thread(
    prepared: &Prepared,
    config: &Config,
    options: &SessionOptions,
    gate: &Arc<Gate>,
    stop: &Arc<AtomicBool>,
    watching: &AtomicBool,
) -> Result<crate::host::HostReport, ReplayError> {
    let ports = Ports::<Ipc>::open(config.instance(), "host", config.limits())?;
    let waited = Instant::now();
    while !(watching.load(Ordering::Acquire) && ports.bundle_receivers() >= 2) {
        if stop.load(Ordering::Relaxed) {
            break;
        }
        if waited.elapsed() > READY_WITHIN {
            return Err(ReplayError::NotReady(READY_WITHIN));
        }
        thread::sleep(LOOK);
    }
    let outlet = BusOutlet::new(ports.bundle_sender()?);
    let outlet = if options.lossless {
        GatedOutlet::gated(outlet, Arc::clone(gate), Arc::clone(stop))
    } else {
        GatedOutlet::open(outlet)
    };
    run_host(prepared, config, outlet, options.host, stop)
}

/// Leaves inference the time to end the last sequence; the observer lingers by itself.
fn wait_for_frames(gate: &Gate, config: &Config, options: &SessionOptions, stop: &AtomicBool) {
    let asked = Instant::now();
    let patience = if options.lossless { READY_WITHIN } else { config.budget.depth() };
    let all_done =
        || gate.finished.load(Ordering::Acquire) >= gate.bundles_seen.load(Ordering::Acquire);
    while !all_done() && asked.elapsed() < patience && !stop.load(Ordering::Relaxed) {
        thread::sleep(LOOK);
    }
}

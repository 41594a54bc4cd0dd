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
use crate::supervise::{SuperviseError, Supervised};

/// How long the inference process may take to load and warm its models.
const READY_WITHIN: Duration = Duration::from_secs(120);
/// Receivers of bundles: inference and the observer.
const RECEIVERS: usize = 2;
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
        let child = Supervised::start(
            "infer",
            options.program.clone(),
            infer_arguments(config, options),
        )?;
        let gate = Arc::new(Gate::default());
        let mut infer = Inference {
            child,
            owner: &owner,
            gate: &gate,
            returning: false,
        };
        let (watching, all_done) = (AtomicBool::new(false), AtomicBool::new(false));
        let keep = Watch {
            keep: options.keep,
            digest: true,
            linger: Duration::from_millis(300),
        };

        let (host, observed) = thread::scope(|scope| {
            let done = SetOnDrop(&all_done);
            let observer = scope.spawn(|| {
                let ports = Ports::<Ipc>::open(instance.clone(), "observer", config.limits())?;
                watch(&ports, keep, &gate, &watching, &all_done)
            });
            let host =
                scope.spawn(|| host_thread(prepared, config, options, &gate, stop, &watching));
            let mut failed = None;
            while !host.is_finished() {
                if let Err(error) = infer.look_after(stop) {
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
                failed = wait_for_frames(&mut infer, config, options, stop).err();
            }
            drop(done);
            let observed = observer
                .join()
                .map_err(|_| ReplayError::Thread("observer"))?;
            if let Some(error) = failed {
                return Err(error.into());
            }
            Ok::<_, ReplayError>((host?, observed?))
        })?;

        let restarts = infer.child.restarts();
        let mut inferred = InferReport::default();
        for life in infer.child.finish::<InferReport>() {
            inferred.add(&life);
        }
        owner.clean_dead();
        drop(owner);
        let report = RunReport::new(
            prepared,
            options.host.pace,
            host,
            inferred,
            restarts,
            &observed,
            instance.residue().len(),
        );
        Ok(Self { report, observed })
    }
}

struct SetOnDrop<'a>(&'a AtomicBool);

impl Drop for SetOnDrop<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Release);
    }
}

/// The inference process under watch.
struct Inference<'a> {
    child: Supervised,
    owner: &'a Owner<Ipc>,
    gate: &'a Gate,
    /// It was started again and has not opened its ports yet.
    returning: bool,
}

impl Inference<'_> {
    /// Starts it again if it died.
    fn look_after(&mut self, stop: &AtomicBool) -> Result<(), SuperviseError> {
        // An interrupt from the keyboard ends the child too, and that is no accident.
        if stop.load(Ordering::Relaxed) {
            return Ok(());
        }
        if self.child.watch()? {
            self.owner.clean_dead();
            self.returning = true;
        }
        if self.returning && self.owner.ports().bundle_receivers() >= RECEIVERS {
            self.gate.give_up();
            self.returning = false;
        }
        Ok(())
    }
}

fn infer_arguments(config: &Config, options: &SessionOptions) -> Vec<String> {
    let mut arguments = vec![
        "infer".to_owned(),
        "--instance".to_owned(),
        config.instance.clone(),
    ];
    if let Some(path) = &options.config_path {
        arguments.extend(["--config".to_owned(), path.display().to_string()]);
    }
    if let Some(model) = options.model {
        arguments.extend(["--model".to_owned(), model.to_string()]);
    }
    if options.lossless {
        arguments.push("--lossless".to_owned());
    }
    arguments.extend(["--parent".to_owned(), std::process::id().to_string()]);
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
    while !(watching.load(Ordering::Acquire) && ports.bundle_receivers() >= RECEIVERS) {
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

/// Leaves inference the time to end the last sequence; a lossless run as long as frames come.
fn wait_for_frames(
    infer: &mut Inference<'_>,
    config: &Config,
    options: &SessionOptions,
    stop: &AtomicBool,
) -> Result<(), SuperviseError> {
    let gate = infer.gate;
    let patience = if options.lossless {
        READY_WITHIN
    } else {
        config.budget.depth()
    };
    let (mut since, mut frames) = (Instant::now(), 0);
    while !gate.is_finished() && since.elapsed() < patience && !stop.load(Ordering::Relaxed) {
        thread::sleep(LOOK);
        infer.look_after(stop)?;
        let seen = gate.frames_seen.load(Ordering::Relaxed);
        if options.lossless && seen > frames {
            (since, frames) = (Instant::now(), seen);
        }
    }
    Ok(())
}

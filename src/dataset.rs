//! A recording as a set of exposures with truth, for evaluation.
//!
//! The recording goes through the host as it would in a vehicle, without time running; what the
//! inference process would have got is kept in plain memory and paired with the truth beside the
//! recording.

use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::{Receiver, Sender, channel};

use noctule_depth::Size;
use noctule_learn::{EvalError, Scene, Scenes};
use noctule_raster::BINS;
use noctule_recording::{ExposureTruth, RecordingError, SampleTruth};
use noctule_world::STEPS;
use thiserror::Error;

use crate::bus::BusError;
use crate::config::Config;
use crate::frame::{Block, BundleHeader, BundleLayout, BundlePlanesMut};
use crate::host::{Outlet, Slot};
use crate::ingest::Pace;
use crate::observe::truth_at;
use crate::replay::{HostOptions, Prepared, ReplayError, run_host};

/// Most exposures kept; each takes 13 MiB at 256 x 256 pixels.
const EXPOSURES_MAX: usize = 512;

/// Why a recording cannot be evaluated on.
#[derive(Debug, Error)]
pub enum DatasetError {
    /// It could not be replayed.
    #[error(transparent)]
    Replay(#[from] ReplayError),
    /// Its truth could not be read.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The host makes other bundles than networks are evaluated on.
    #[error("bundles have {steps} steps of {bins} bins, networks want {STEPS} of {BINS}")]
    Shape {
        /// Their steps.
        steps: usize,
        /// Their bins.
        bins: usize,
    },
    /// It is longer than fits memory.
    #[error("the recording has more than {EXPOSURES_MAX} exposures with truth")]
    Long,
    /// No exposure of it has truth.
    #[error("none of the recording's {exposures} exposures has truth")]
    NoTruth {
        /// Exposures found.
        exposures: usize,
    },
}

type Bundle = (BundleHeader, Vec<Block>);

/// Exposures of one recording that truth is known for.
pub struct RecordedScenes {
    layout: BundleLayout,
    cap_m: f32,
    exposures: Vec<(Bundle, ExposureTruth, SampleTruth)>,
}

impl RecordedScenes {
    /// Runs the host over the recording at `path`.
    ///
    /// # Errors
    /// [`DatasetError`], when it cannot be replayed or has no truth.
    pub fn open(path: &Path, config: &Config, stop: &AtomicBool) -> Result<Self, DatasetError> {
        let prepared = Prepared::open(path, config)?;
        let layout = prepared.rig().layout;
        if (layout.steps, layout.bins) != (STEPS, BINS) {
            let BundleLayout { steps, bins, .. } = layout;
            return Err(DatasetError::Shape { steps, bins });
        }
        let (sender, receiver) = channel();
        let options = HostOptions {
            pace: Pace::Max,
            piece_bytes: None,
        };
        run_host(&prepared, config, Keep { layout, sender }, options, stop)?;
        let exposures = pair(&prepared, &receiver)?;
        Ok(Self {
            layout,
            cap_m: config.grid.depth_m_max,
            exposures,
        })
    }
}

/// The bundles that truth is known for, in order.
fn pair(
    prepared: &Prepared,
    bundles: &Receiver<Bundle>,
) -> Result<Vec<(Bundle, ExposureTruth, SampleTruth)>, DatasetError> {
    let recording = prepared.recording();
    let truths: Vec<ExposureTruth> = recording.exposures_truth()?.collect::<Result<_, _>>()?;
    let samples = recording.samples()?;
    let (mut exposures, mut seen) = (Vec::new(), 0);
    for bundle in bundles.try_iter() {
        seen += 1;
        let Some(truth) = truth_at(&bundle.0, &truths).filter(|t| samples.contains(&t.index))
        else {
            continue;
        };
        if exposures.len() == EXPOSURES_MAX {
            return Err(DatasetError::Long);
        }
        let sample = recording.sample_truth(truth.index)?;
        exposures.push((bundle, *truth, sample));
    }
    if exposures.is_empty() {
        return Err(DatasetError::NoTruth { exposures: seen });
    }
    Ok(exposures)
}

impl Scenes for RecordedScenes {
    fn count(&self) -> usize {
        self.exposures.len()
    }

    fn scene(&self, index: usize) -> Result<Scene, EvalError> {
        let ((header, payload), truth, sample) = &self.exposures[index];
        let name = format!("exposure {}", truth.index);
        let fault = |fault: String| EvalError::Scene {
            scene: name.clone(),
            fault,
        };
        let planes = self
            .layout
            .planes(payload)
            .map_err(|e| fault(e.to_string()))?;
        let size = Size::new(header.width as usize, header.height as usize);
        let mut scene = Scene {
            name: name.clone(),
            size: size.map_err(|e| fault(e.to_string()))?,
            blur: planes.image.to_vec(),
            voxel: planes.voxels.to_vec(),
            sparse: planes.sparse.to_vec(),
            ground: header.ground(),
            depth: Vec::new(),
            movers: Vec::new(),
            thin: Vec::new(),
            flow: Vec::new(),
            cap_m: self.cap_m,
        };
        add_truth(&mut scene, sample).map_err(|e| fault(e.to_string()))?;
        Ok(scene)
    }
}

/// Reads depth, masks and flow of every step.
fn add_truth(scene: &mut Scene, sample: &SampleTruth) -> Result<(), RecordingError> {
    let steps = u32::try_from(STEPS).unwrap_or(u32::MAX);
    for step in 1..=steps {
        scene.depth.extend(sample.gt(step)?.data);
        scene.movers.extend(sample.mover(step)?.data);
        scene.thin.extend(sample.thin(step)?.data);
        if step < steps {
            scene.flow.extend(sample.flow(step)?.data);
        }
    }
    Ok(())
}

/// Plain memory in place of the bus.
struct Keep {
    layout: BundleLayout,
    sender: Sender<Bundle>,
}

struct Plain(Vec<Block>);

impl Slot for Plain {
    fn planes(&mut self, layout: &BundleLayout) -> Option<BundlePlanesMut<'_>> {
        layout.planes_mut(&mut self.0).ok()
    }
}

impl Outlet for Keep {
    type Slot = Plain;

    fn lend(&mut self) -> Option<Plain> {
        Some(Plain(vec![Block::ZERO; self.layout.blocks()]))
    }

    fn send(&mut self, slot: Plain, header: BundleHeader) -> Result<BundleHeader, BusError> {
        // The receiver outlives the host's run.
        let _ = self.sender.send((header, slot.0));
        Ok(header)
    }

    fn now_ns(&self) -> u64 {
        crate::latency::monotonic_ns()
    }
}

//! The loop of the inference process.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use iceoryx2::service::Service;
use noctule_depth::Levelling;

use super::{Choice, Engines, InferError, InferReport, Ladder, Run, Rung};
use crate::bus::{Newest, Ports, Received, Receiver, Sender};
use crate::frame::{
    BundleHeader, BundleLayout, BundlePlanes, DepthHeader, InferStages, ModelId, flag,
};

/// How the process treats time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Options {
    /// Closing of the shutter to last depth map.
    pub deadline: Duration,
    /// Takes every bundle in order and runs the model asked for, however long it takes.
    pub lossless: bool,
}

/// Runs until `stop` is set; `now_ns` reads `CLOCK_MONOTONIC`.
///
/// # Errors
/// When the bus or a network fails; a bundle that cannot be read is counted instead.
pub fn run<S: Service>(
    ports: &Ports<S>,
    engines: &mut Engines,
    ladder: &mut Ladder,
    options: Options,
    now_ns: &dyn Fn() -> u64,
    stop: &AtomicBool,
) -> Result<InferReport, InferError> {
    let receiver = ports.bundle_receiver()?;
    let sender = ports.depth_sender()?;
    let mut process = Process {
        ladder,
        options,
        now_ns,
        sender,
        report: InferReport::default(),
        levelling: Levelling::new(),
        frame: 0,
    };
    while !stop.load(Ordering::Relaxed) {
        let Some(Newest { frame, passed_over }) = process.next(&receiver)? else {
            receiver.wait(Duration::from_millis(50))?;
            continue;
        };
        process.report.bundles_stale += passed_over;
        process.sequence(engines, &frame, stop)?;
    }
    process.report.bundles_received = receiver.received();
    process.report.bundles_lost = receiver.lost();
    Ok(process.report)
}

struct Process<'a, S: Service> {
    ladder: &'a mut Ladder,
    options: Options,
    now_ns: &'a dyn Fn() -> u64,
    sender: Sender<S, DepthHeader>,
    report: InferReport,
    levelling: Levelling,
    frame: u64,
}

impl<S: Service> Process<'_, S> {
    fn next(
        &self,
        receiver: &Receiver<S, BundleHeader>,
    ) -> Result<Option<Newest<S, BundleHeader>>, InferError> {
        if self.options.lossless {
            return Ok(receiver.receive()?.map(|frame| Newest {
                frame,
                passed_over: 0,
            }));
        }
        Ok(receiver.receive_newest()?)
    }

    /// Runs one bundle's sequence, each frame sent as soon as it is there.
    #[allow(
        clippy::drop_non_drop,
        reason = "without networks a run holds nothing to drop"
    )]
    fn sequence(
        &mut self,
        engines: &mut Engines,
        bundle: &Received<S, BundleHeader>,
        stop: &AtomicBool,
    ) -> Result<(), InferError> {
        let bundle_received_ns = (self.now_ns)();
        let header = *bundle.header();
        let Ok(layout) = header.layout() else {
            self.report.bundles_refused += 1;
            return Ok(());
        };
        if !engines.fits(&layout) {
            self.report.bundles_refused += 1;
            return Ok(());
        }
        let Ok(planes) = layout.planes(bundle.payload()) else {
            self.report.bundles_refused += 1;
            return Ok(());
        };
        let deadline_ns = self.deadline_ns(&header);
        let steps = u64::from(header.steps);
        let left_ns = deadline_ns.saturating_sub(bundle_received_ns);
        let (model, mut flags) = match self.ladder.choose(left_ns, steps) {
            Choice::AsAsked(model) => (model, header.flags),
            Choice::SteppedDown(model) => (model, header.flags | flag::STEPPED_DOWN),
            Choice::Stale => {
                self.report.bundles_stale += 1;
                return Ok(());
            }
        };
        self.report.sequences_stepped_down += u64::from(flags & flag::STEPPED_DOWN != 0);
        let sequence = Sequence {
            header,
            layout,
            planes,
            bundle_received_ns,
            started_ns: (self.now_ns)(),
        };
        self.report.model(model.name()).sequences += 1;
        let ground = header.ground();
        let mut run = engines.begin(model, &planes, ground.as_ref())?;
        let begun_ns = (self.now_ns)();
        let mut previous_ns = begun_ns;
        let mut slowest_ns = 0;
        for step in 0..header.steps {
            if stop.load(Ordering::Relaxed) {
                return Ok(());
            }
            match self.keep_up(run.model(), previous_ns, deadline_ns, header.steps - step) {
                Pace::Keep => {}
                Pace::StepDown(cheaper) => {
                    if flags & flag::STEPPED_DOWN == 0 {
                        self.report.sequences_stepped_down += 1;
                    }
                    flags |= flag::STEPPED_DOWN;
                    drop(run);
                    run = engines.begin(cheaper, &planes, ground.as_ref())?;
                }
                Pace::End => {
                    self.report.sequences_ended_early += 1;
                    break;
                }
            }
            let done_ns = self.step(&mut run, &sequence, step, flags, deadline_ns)?;
            if run.model() == model {
                slowest_ns = slowest_ns.max(done_ns - previous_ns);
            }
            previous_ns = done_ns;
        }
        self.ladder.learn(Rung {
            model,
            begin_ns: begun_ns - sequence.started_ns,
            step_ns: slowest_ns,
        });
        self.look_for_road(&sequence);
        Ok(())
    }

    /// Notes how far from its calibrated place the road lies, once the maps are out.
    fn look_for_road(&mut self, sequence: &Sequence<'_>) {
        let Sequence { header, layout, .. } = sequence;
        let first = sequence.planes.sparse.get(..layout.height * layout.width);
        let rows_down = header
            .ground()
            .zip(first)
            .and_then(|(told, sparse)| self.levelling.rows_down(&told, sparse, layout.width));
        if let Some(rows_down) = rows_down {
            self.report.road(rows_down);
        }
    }

    /// Whether to go on as before with `to_go` steps left.
    fn keep_up(&self, model: ModelId, now_ns: u64, deadline_ns: u64, to_go: u32) -> Pace {
        let left_ns = deadline_ns.saturating_sub(now_ns);
        if self.options.lossless || self.ladder.step_ns(model) <= left_ns {
            return Pace::Keep;
        }
        self.ladder
            .rescue(model, left_ns, to_go.into())
            .map_or(Pace::End, Pace::StepDown)
    }

    fn deadline_ns(&self, header: &BundleHeader) -> u64 {
        if self.options.lossless {
            return u64::MAX;
        }
        let budget = u64::try_from(self.options.deadline.as_nanos()).unwrap_or(u64::MAX);
        header.stages.close_received_ns.saturating_add(budget)
    }

    /// Computes and sends one step; returns when it was done.
    fn step(
        &mut self,
        run: &mut Run<'_>,
        sequence: &Sequence<'_>,
        step: u32,
        flags: u32,
        deadline_ns: u64,
    ) -> Result<u64, InferError> {
        let header = &sequence.header;
        let mut loan = self.sender.loan()?;
        let depth_layout = crate::frame::DepthLayout {
            height: sequence.layout.height,
            width: sequence.layout.width,
        };
        let (depth, confidence) = depth_layout.planes_mut(loan.payload_mut())?;
        run.step(&sequence.planes, step as usize, depth, confidence)?;
        let done_ns = (self.now_ns)();
        let late = done_ns > deadline_ns;
        *loan.header_mut() = DepthHeader {
            frame: self.frame,
            sequence: header.sequence,
            open_tai_ns: header.open_tai_ns,
            close_tai_ns: header.close_tai_ns,
            step_tai_ns: header.step_tai_ns[step as usize],
            uncertainty_ns: header.uncertainty_ns,
            step,
            steps: header.steps,
            height: header.height,
            width: header.width,
            model: run.model() as u32,
            flags: flags | if late { flag::LATE } else { 0 },
            host: header.stages,
            infer: InferStages {
                bundle_received_ns: sequence.bundle_received_ns,
                started_ns: sequence.started_ns,
                done_ns,
                sent_ns: (self.now_ns)(),
            },
            ..Default::default()
        };
        self.sender.send(loan)?;
        self.frame += 1;
        self.report.frames_sent += 1;
        self.report.frames_late += u64::from(late);
        self.report.model(run.model().name()).frames += 1;
        Ok(done_ns)
    }
}

/// How to go on with a sequence.
enum Pace {
    Keep,
    StepDown(ModelId),
    End,
}

struct Sequence<'a> {
    header: BundleHeader,
    layout: BundleLayout,
    planes: BundlePlanes<'a>,
    bundle_received_ns: u64,
    started_ns: u64,
}

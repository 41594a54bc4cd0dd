//! The observer's thread.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use iceoryx2::service::Service;

use super::record::{Kept, Observed};
use crate::bus::{BusError, Ports, Received, Receiver};
use crate::frame::{BundleHeader, DepthHeader};
use crate::latency::monotonic_ns;

/// Lets a lossless run send only as fast as everything is consumed, and tells how far a run is.
#[derive(Debug, Default)]
pub struct Gate {
    /// One past the last sequence let through.
    passed: AtomicU64,
    /// One past the last sequence whose bundle the observer has seen.
    begun: AtomicU64,
    /// One past the last sequence whose last depth map the observer has seen.
    finished: AtomicU64,
    /// Bundles the observer has seen.
    pub bundles_seen: AtomicU64,
    /// Depth frames the observer has seen: shows life.
    pub frames_seen: AtomicU64,
}

// Every Acquire pairs with the Release of whoever saw or sent the frame.
impl Gate {
    /// Whether everything that was let through has been seen and finished.
    #[must_use]
    pub fn is_clear(&self) -> bool {
        let passed = self.passed.load(Ordering::Acquire);
        self.begun.load(Ordering::Acquire) >= passed
            && self.finished.load(Ordering::Acquire) >= passed
    }

    /// Whether the last bundle seen is finished.
    #[must_use]
    pub fn is_finished(&self) -> bool {
        self.finished.load(Ordering::Acquire) >= self.begun.load(Ordering::Acquire)
    }

    /// The bundle of this number is about to be sent.
    pub fn passes(&self, sequence: u64) {
        self.passed.fetch_max(sequence + 1, Ordering::Release);
    }

    /// Stops waiting for what was let through so far: whoever had it is dead.
    pub fn give_up(&self) {
        self.finished
            .fetch_max(self.passed.load(Ordering::Acquire), Ordering::Release);
    }

    fn bundle(&self, sequence: u64) {
        self.begun.fetch_max(sequence + 1, Ordering::Release);
        self.bundles_seen.fetch_add(1, Ordering::Release);
    }
}

/// What to keep.
#[derive(Debug, Clone, Copy)]
pub struct Watch {
    /// Exposures kept for pictures and scores.
    pub keep: usize,
    /// Whether to hash every frame.
    pub digest: bool,
    /// How long after `stop` to wait for frames that are still to come.
    pub linger: Duration,
}

/// Watches until `stop` is set and nothing more comes.
///
/// # Errors
/// When the bus fails.
pub fn watch<S: Service>(
    ports: &Ports<S>,
    options: Watch,
    gate: &Gate,
    ready: &AtomicBool,
    stop: &AtomicBool,
) -> Result<Observed, BusError> {
    let bundles = ports.bundle_receiver()?;
    let depths = ports.depth_receiver()?;
    ready.store(true, Ordering::Release);
    let mut observer = Observer {
        options,
        observed: Observed::default(),
    };
    let mut quiet_since = None;
    loop {
        let mut idle = true;
        while let Some(bundle) = bundles.receive()? {
            observer.bundle(&bundle);
            gate.bundle(bundle.header().sequence);
            idle = false;
        }
        // A bundle is sent before its depth, so it is seen first, except across a restart.
        while let Some(depth) = depths.receive()? {
            if observer.depth(&depth) {
                gate.finished
                    .fetch_max(depth.header().sequence + 1, Ordering::Release);
            }
            gate.frames_seen.fetch_add(1, Ordering::Release);
            idle = false;
            if let Some(bundle) = bundles.receive()? {
                observer.bundle(&bundle);
                gate.bundle(bundle.header().sequence);
            }
        }
        if !idle {
            quiet_since = None;
            continue;
        }
        if stop.load(Ordering::Relaxed) {
            let now = monotonic_ns();
            let since = *quiet_since.get_or_insert(now);
            if Duration::from_nanos(now - since) > options.linger {
                break;
            }
        }
        depths.wait(Duration::from_millis(2))?;
    }
    Ok(observer.finish(&bundles, &depths))
}

struct Observer {
    options: Watch,
    observed: Observed,
}

impl Observer {
    fn bundle<S: Service>(&mut self, bundle: &Received<S, BundleHeader>) {
        let header = bundle.header();
        self.observed.bundles += 1;
        let Ok(layout) = header.layout() else { return };
        let Ok(planes) = layout.planes(bundle.payload()) else {
            return;
        };
        if self.options.digest {
            self.observed.digest.bundle(header, bundle.payload());
        }
        if self.observed.kept.len() < self.options.keep {
            let kept = Kept::new(*header, &layout, &planes);
            self.observed.kept.insert(header.sequence, kept);
        } else {
            self.observed.not_kept += 1;
        }
    }

    /// Takes a depth frame; whether it is the last of its sequence.
    fn depth<S: Service>(&mut self, frame: &Received<S, DepthHeader>) -> bool {
        let seen_ns = monotonic_ns();
        let header = frame.header();
        let observed = &mut self.observed;
        observed.frames += 1;
        observed.frames_late += u64::from(header.flags & crate::frame::flag::LATE != 0);
        observed.depth_hop.record(header.infer.sent_ns, seen_ns);
        if header.step == 0 {
            observed.sequences_begun += 1;
            observed
                .bundle_hop
                .record(header.host.sent_ns, header.infer.bundle_received_ns);
            observed
                .first_step
                .record(header.infer.started_ns, header.infer.done_ns);
            observed
                .close_to_first
                .record(header.host.close_received_ns, header.infer.sent_ns);
        }
        let last = header.step + 1 == header.steps;
        if last {
            observed.sequences_complete += 1;
            observed
                .close_to_last
                .record(header.host.close_received_ns, header.infer.sent_ns);
        }
        if self.options.digest {
            observed.digest.depth(header, frame.payload());
        }
        if let Ok(layout) = header.layout()
            && let Ok((depth, _)) = layout.planes(frame.payload())
            && let Some(kept) = observed.kept.get_mut(&header.sequence)
        {
            kept.depth.insert(header.step, (*header, depth.to_vec()));
        }
        last
    }

    fn finish<S: Service>(
        mut self,
        bundles: &Receiver<S, BundleHeader>,
        depths: &Receiver<S, DepthHeader>,
    ) -> Observed {
        self.observed.bundles_lost = bundles.lost();
        self.observed.frames_lost = depths.lost();
        self.observed
    }
}

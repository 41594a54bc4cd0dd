//! Nothing in `sync` allocates once it is built: every allocation of the thread is counted while
//! clocks, exposures and bundles run through a minute with faults.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use noctule::sync::{
    BundleCloser, BundleConfig, ClockReading, ExposureEvent, ExposureTracker, ImageStamp,
    Observation, StampedAt, Stream, Timeline, TimelineConfig, TrackerConfig,
};
use noctule_sensor::{Stamp, TriggerEdge};

mod sync_simulation;
use sync_simulation::{Chance, MS, S, host, ticks};

struct Counting;

thread_local! {
    /// Allocations of this thread: the test harness has its own, with its own.
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

fn count() {
    // A thread that is ending has no counter left, and nothing to count.
    let _ = ALLOCATIONS.try_with(|n| n.set(n.get() + 1));
}

// SAFETY: every call is handed on to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's promises are passed on.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        // SAFETY: the caller's promises are passed on.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

#[test]
fn nothing_allocates_after_construction() {
    let mut chance = Chance::new(1);
    let mut timeline = Timeline::new(TimelineConfig::free_running());
    let mut tracker = ExposureTracker::new(TrackerConfig::default());
    let mut closer = BundleCloser::new(BundleConfig::default());
    let mut said: Vec<ExposureEvent> = Vec::with_capacity(64);
    let mut bundles = 0_u64;
    let before = ALLOCATIONS.get();
    for millis in 1..60_000_u64 {
        let t = millis as f64 * MS;
        let now = host(t);
        // The counter falls back after half a minute.
        let shown = if t < 30.0 * S { t } else { t - 29.0 * S };
        said.clear();
        if millis % 1000 == 1 {
            let tai_offset_ns = 37_000_000_000;
            timeline.clocks(ClockReading {
                realtime: now,
                monotonic: host(t),
                tai_offset_ns,
            });
        }
        let arrival = host(t + chance.exponential(MS));
        let outcome = timeline.evk4_arrival(ticks(shown), arrival);
        if matches!(outcome, Observation::NewEpoch(_)) {
            tracker.clock_changed(&mut |e| said.push(e));
            closer.restarted(Stream::Events, now, &mut |_| bundles += 1);
        }
        let map = timeline.evk4_to_monotonic();
        let in_period = millis % 200;
        if (in_period == 50 || in_period == 150) && !chance.is(0.05) {
            let edge = TriggerEdge {
                t: ticks(shown),
                channel: 0,
                rising: in_period == 50,
            };
            tracker.edge(edge, map.as_ref(), &mut |e| said.push(e));
        }
        if in_period == 160 && !chance.is(0.05) {
            let image = ImageStamp {
                sequence: millis / 200,
                driver: host(t - 10.0 * MS + chance.normal(20e3)),
                stamped_at: StampedAt::End,
                exposure_ns: Some(100_000_000),
                arrival: now,
            };
            tracker.image(image, map.as_ref(), &mut |e| said.push(e));
        }
        tracker.advance(ticks(shown), map.as_ref(), &mut |e| said.push(e));
        for event in &said {
            if let ExposureEvent::Imaged {
                pair: Some(pair), ..
            } = event
            {
                timeline.strobe_pair(pair.edge, pair.driver);
            }
            let map = timeline.evk4_to_tai().map(|(map, _)| map);
            closer.exposure(event, map.as_ref(), now, &mut |_| bundles += 1);
        }
        closer.events_passed(ticks(shown), now, &mut |_| bundles += 1);
        timeline.lidar_arrival(Stamp::from_nanos((millis + 5) * 1_000_000), now);
        closer.lost(Stream::Lidar, 1);
    }
    let allocations = ALLOCATIONS.get() - before;
    assert!(bundles > 250, "{bundles}");
    assert_eq!(timeline.counts().evk4.backwards, 1);
    assert_eq!(allocations, 0);
}

//! A plan allocates while it is built and never again, on any of its threads.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering};

use candle_core::Device;
use noctule_erunet::{Config, Form, Ground, Plan, PlanOptions, Weights};

/// Level ground seen from 1.5 m.
const GROUND: Option<Ground> = Some(Ground {
    per_column: 0.0,
    per_row: 0.01,
    first: -0.3,
});

static ALLOCATIONS: AtomicUsize = AtomicUsize::new(0);

/// The system's allocator, counted over all threads.
struct Counting;

// SAFETY: every call is the system allocator's.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: passed on from the caller.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        // SAFETY: passed on from the caller.
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

#[test]
fn exposures_allocate_nothing() {
    let (height, width) = (64, 48);
    let area = height * width;
    let config = Config {
        form: Form::Choice,
        ..Config::tiny()
    };
    let weights = Weights::initial(&config, 1, &Device::Cpu).unwrap();
    let options = PlanOptions {
        threads: 2,
        ..PlanOptions::default()
    };
    let mut plan = Plan::new(&config, &weights, height, width, options).unwrap();
    let (blur, voxel) = (vec![0.5; 3 * area], vec![0.1; 5 * area]);
    // A road that lies elsewhere at every step, so that the ground is laid anew.
    let road = |step: usize| -> Vec<f32> {
        let ground = GROUND.unwrap().lowered(step as f32);
        let row = |row| vec![1.0 / ground.inverse_depth(0.0, row as f32); width];
        (0..height)
            .flat_map(row)
            .map(|depth| depth.max(0.0))
            .collect()
    };
    let roads: Vec<Vec<f32>> = (0..config.steps).map(road).collect();
    let (mut depth, mut trust) = (vec![0.0; area], vec![0.0; area]);
    let mut exposure = || {
        plan.begin(&blur, GROUND.as_ref()).unwrap();
        for sparse in &roads {
            plan.step(&voxel, sparse, &mut depth, &mut trust).unwrap();
        }
    };
    exposure();
    let before = ALLOCATIONS.load(Ordering::Relaxed);
    for _ in 0..5 {
        exposure();
    }
    assert_eq!(ALLOCATIONS.load(Ordering::Relaxed), before);
}

//! Completing a map and colouring it allocate nothing once the buffers exist.

#[allow(dead_code, reason = "truth is for other tests")]
mod street;

use noctule_depth::{Completer, Scale, depth_to_rgb};
use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering};
use street::{SIDE, Street};

struct Counting;

static ALLOCATIONS: AtomicUsize = AtomicUsize::new(0);

// SAFETY: every call is passed on to the system allocator unchanged; only a counter is added.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's promises are the system allocator's.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's promises are the system allocator's.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// The only test of this binary, so that no other thread's allocations are counted.
#[test]
fn a_warm_completer_never_allocates() {
    let mut completer = Completer::new(SIDE, SIDE).expect("a size");
    let (mut depth, mut aside) = (vec![0.0; SIDE * SIDE], vec![0.0; SIDE * SIDE]);
    let mut rgb = vec![0; 3 * SIDE * SIDE];
    let maps = [
        Street::new(1).sparse(),
        vec![0.0; SIDE * SIDE],
        Street::new(2).sparse(),
    ];
    let before = ALLOCATIONS.load(Ordering::Relaxed);
    assert!(before > 0, "the counter counts");
    for sparse in &maps {
        completer
            .nearest(sparse, &mut depth, &mut aside)
            .expect("sizes agree");
        completer
            .fill(sparse, &mut depth, &mut aside)
            .expect("sizes agree");
        depth_to_rgb(&depth, Scale::DRIVE, &mut rgb).expect("sizes agree");
    }
    assert_eq!(ALLOCATIONS.load(Ordering::Relaxed), before);
}

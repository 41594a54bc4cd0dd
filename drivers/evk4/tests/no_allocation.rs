//! Decoding allocates nothing, whatever the bytes.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use noctule_evk4::{Decoder, EventSink, Evt3Encoder, Format, Geometry};
use noctule_sensor::{Event, Stamp};

struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

// SAFETY: every call is passed on to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.with(|count| count.set(count.get() + 1));
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, ptr: *mut u8, layout: Layout) {
        // SAFETY: the caller keeps the contract of `dealloc`.
        unsafe { System.dealloc(ptr, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Runs `work` and counts what it allocates on this thread.
fn allocations(work: impl FnOnce()) -> u64 {
    let before = ALLOCATIONS.with(Cell::get);
    work();
    ALLOCATIONS.with(Cell::get) - before
}

struct Counted(u64);

impl EventSink for Counted {
    fn event(&mut self, _: Event) {
        self.0 += 1;
    }
}

fn recording() -> (Vec<u8>, u64) {
    let (mut encoder, mut bytes, mut count) = (Evt3Encoder::new(), Vec::new(), 0);
    for t_us in 0..20_000 {
        for i in 0..t_us % 7 {
            let event = Event {
                t: Stamp::from_micros(t_us * 11),
                x: u16::try_from((t_us * 37 + i) % 1280).expect("small"),
                y: u16::try_from(t_us % 720).expect("small"),
                on: t_us % 3 == 0,
            };
            encoder.event(event, &mut bytes).expect("in order");
            count += 1;
        }
    }
    encoder.flush(&mut bytes);
    (bytes, count)
}

#[test]
fn no_decoder_allocates() {
    let geometry = Geometry {
        width: 1280,
        height: 720,
    };
    let (bytes, count) = recording();
    assert!(allocations(|| drop(vec![0_u8; 10])) == 1, "the count works");
    for format in [
        Format::Evt2,
        Format::Evt21,
        Format::Evt21Legacy,
        Format::Evt3,
    ] {
        let mut found = Counted(0);
        let made = allocations(|| {
            let mut decoder = Decoder::new(format, geometry);
            for chunk in bytes.chunks(1001) {
                decoder.decode(chunk, &mut found);
            }
            decoder.gap();
            decoder.finish();
        });
        assert_eq!(made, 0, "{format:?}");
        assert!(
            format != Format::Evt3 || found.0 == count,
            "{} of {count}",
            found.0
        );
    }
}

#[test]
fn a_warm_encoder_allocates_nothing_of_its_own() {
    let (mut encoder, mut bytes) = (Evt3Encoder::new(), Vec::with_capacity(1 << 20));
    let mut burst = |encoder: &mut Evt3Encoder, t_us| {
        for x in 0..500 {
            let t = Stamp::from_micros(t_us);
            let event = Event {
                t,
                x: x * 7 % 1280,
                y: x % 9,
                on: x % 2 == 0,
            };
            encoder.event(event, &mut bytes).expect("in order");
        }
    };
    burst(&mut encoder, 1);
    let made = allocations(|| (2..100).for_each(|t_us| burst(&mut encoder, t_us)));
    assert_eq!(made, 0);
}

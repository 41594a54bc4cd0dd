//! What a program promises beyond its kernels: no allocation, no stale reads, the same bits on any
//! number of threads, and refusals that say why.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

mod oracle;

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering};

use noctule_kernels::{
    Activation, BuildError, Builder, Conv, Feature, Intake, Options, Passes, Precision, Program,
    RunError, Size, Store,
};
use oracle::{noise, size};

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

const SIZE: Size = size(19, 37);

fn conv<'a>(inputs: &'a [Feature], weight: &'a [f32], output: Feature) -> Conv<'a> {
    Conv {
        inputs,
        weight,
        bias: &[0.1; 20],
        kernel: 3,
        stride: 1,
        gain: None,
        residual: None,
        activation: Activation::LeakyRelu,
        store: Store::Direct,
        output,
    }
}

/// A chain of four layers with a state: pass 0 starts it, pass 1 adds the input to it.
fn chain(options: Options) -> Program {
    let mut builder = Builder::new();
    let (input, output) = (
        builder.input(20 * SIZE.area()),
        builder.output(20 * SIZE.area()),
    );
    let weight: Vec<f32> = noise(20 * 20 * 9, 8).iter().map(|w| w * 0.1).collect();
    let state = builder.state(20, SIZE);
    builder.set_passes(Passes::of(&[0, 1]));
    let mut x = builder.feature(20, SIZE);
    builder.set_label("take");
    builder.take(input, Intake::Planes, x);
    for place in 0..3 {
        let next = builder.feature(20, SIZE);
        builder.set_label(&format!("chain {place}"));
        builder.conv(&conv(&[x], &weight, next));
        x = next;
    }
    builder.set_passes(Passes::of(&[1]));
    let joined = builder.feature(20, SIZE);
    builder.set_label("add");
    builder.conv(&Conv {
        residual: Some(x),
        ..conv(&[state], &weight, joined)
    });
    builder.set_label("keep");
    builder.conv(&conv(&[joined], &weight, state));
    builder.set_passes(Passes::of(&[0]));
    builder.conv(&conv(&[x], &weight, state));
    builder.set_passes(Passes::of(&[0, 1]));
    builder.set_label("give");
    builder.give(state, output);
    builder.finish(options).unwrap()
}

/// Bits of the state after a start and three further passes.
fn follow(program: &mut Program) -> Vec<u32> {
    let x = noise(20 * SIZE.area(), 4);
    let mut out = vec![f32::NAN; x.len()];
    for pass in [0, 1, 1, 1] {
        program.run(pass, 0, &[&x], &mut [&mut out]).unwrap();
    }
    assert!(out.iter().all(|v| v.is_finite()));
    out.iter().map(|v| v.to_bits()).collect()
}

#[test]
fn threads_poison_and_repetition_change_no_bit_and_nothing_allocates() {
    for precision in [Precision::Single, Precision::Brain] {
        let options = |threads| Options {
            threads,
            precision,
            ..Options::default()
        };
        let mut program = chain(options(1));
        let wanted = follow(&mut program);
        program.poison();
        assert_eq!(follow(&mut program), wanted);
        for threads in [2, 3, 5] {
            let mut program = chain(options(threads));
            program.poison();
            assert_eq!(follow(&mut program), wanted, "{threads} threads");
        }
    }
    let mut program = chain(Options {
        threads: 3,
        ..Options::default()
    });
    let x = noise(20 * SIZE.area(), 4);
    let mut out = vec![0.0; x.len()];
    program.run(0, 0, &[&x], &mut [&mut out]).unwrap();
    let before = ALLOCATIONS.load(Ordering::Relaxed);
    for _ in 0..10 {
        program.run(1, 0, &[&x], &mut [&mut out]).unwrap();
    }
    // Other tests of this process allocate too; they are all in this one function.
    assert_eq!(ALLOCATIONS.load(Ordering::Relaxed), before);
    refusals();
    memory_is_shared();
    profiles_name_count_and_time_every_operation();
}

/// A profile runs what a run runs, and counts work without padding.
fn profiles_name_count_and_time_every_operation() {
    for threads in [1, 2] {
        let options = Options {
            threads,
            precision: Precision::Brain,
            ..Options::default()
        };
        let (mut program, mut other) = (chain(options), chain(options));
        let x = noise(20 * SIZE.area(), 4);
        let (mut out, mut wanted) = (vec![f32::NAN; x.len()], vec![f32::NAN; x.len()]);
        program.run(0, 0, &[&x], &mut [&mut out]).unwrap();
        let ops = program.profile(1, 0, &[&x], &mut [&mut out], 2).unwrap();
        for pass in [0, 1, 1] {
            other.run(pass, 0, &[&x], &mut [&mut wanted]).unwrap();
        }
        assert!(out == wanted);

        let names: Vec<_> = ops.iter().map(|op| op.name.as_str()).collect();
        let wanted = [
            "take", "chain 0", "chain 1", "chain 2", "add", "keep", "give",
        ];
        assert_eq!(names, wanted);
        assert!(ops.iter().all(|op| op.pass == 1 && op.seconds < 1.0));
        let number = 20 * SIZE.area() as u64;
        let add = &ops[4];
        assert_eq!(add.kind, "conv 3x3 20-20");
        assert_eq!(add.size, [SIZE.height, SIZE.width]);
        assert_eq!(add.macs, 20 * 9 * number);
        assert_eq!(add.feature_bytes, 3 * 2 * number);
        assert_eq!(add.weight_bytes, 2 * 20 * 20 * 9);
        assert_eq!((ops[0].macs, ops[0].feature_bytes), (0, (2 + 4) * number));
        assert!(add.seconds > 0.0 && ops[6].seconds > 0.0);
        // One multiply-add takes as long as the bytes of its operation, or longer.
        let bytes = (add.feature_bytes + add.weight_bytes) as f64;
        assert_eq!(add.bound(2.0, bytes), add.macs as f64);
        assert_eq!(add.bound(1e30, bytes), 1.0);
    }
}

fn memory_is_shared() {
    // Five features of 20 channels and a state; only two and the state are needed at a time.
    let feature_bytes = 2 * (SIZE.height + 2) * (SIZE.width + 2) * 16 * 4;
    let bytes = chain(Options::default()).arena_bytes();
    assert!(bytes < 4 * feature_bytes, "{bytes} {feature_bytes}");
}

fn refusals() {
    let mut program = chain(Options::default());
    let x = vec![0.0; 7];
    let mut out = vec![0.0; 20 * SIZE.area()];
    assert_eq!(
        program
            .run(0, 0, &[&x], &mut [&mut out])
            .unwrap_err()
            .to_string(),
        "input 0 has 7 values, wanted 14060"
    );
    let x = vec![0.0; 20 * SIZE.area()];
    assert_eq!(
        program.run(0, 0, &[&x], &mut []),
        Err(RunError::Slice {
            kind: "output",
            index: 0,
            actual: 0,
            wanted: 14060
        })
    );
    assert_eq!(
        program.run(2, 0, &[&x], &mut [&mut out]),
        Err(RunError::Pass {
            actual: 2,
            count: 2
        })
    );
    assert_eq!(
        program.run(0, 1, &[&x], &mut [&mut out]),
        Err(RunError::Variant {
            actual: 1,
            count: 1
        })
    );

    let fault = |describe: fn(&mut Builder, Feature, Feature)| {
        let mut builder = Builder::new();
        let input = builder.input(20 * SIZE.area());
        let (x, y) = (builder.feature(20, SIZE), builder.feature(20, SIZE));
        builder.take(input, Intake::Planes, x);
        describe(&mut builder, x, y);
        builder
            .finish(Options::default())
            .err()
            .unwrap()
            .to_string()
    };
    assert_eq!(
        fault(|b, x, y| b.conv(&conv(&[x], &[0.0; 5], y))),
        "operation 1: number of weights is 5, wanted 3600"
    );
    assert_eq!(
        fault(|b, x, _| b.conv(&conv(&[x], &[0.0; 3600], x))),
        "operation 1 reads and writes the same feature"
    );
    assert_eq!(
        fault(|b, x, y| b.conv(&conv(&[y], &[0.0; 3600], x))),
        "operation 1 reads feature 1 before it is written"
    );
    let wrong_stride = |b: &mut Builder, x, y| {
        b.conv(&Conv {
            stride: 3,
            ..conv(&[x], &[0.0; 3600], y)
        });
    };
    assert_eq!(
        fault(wrong_stride),
        "operation 1: stride is 3, allowed 1, 2"
    );
    let halved = |b: &mut Builder, x, y| {
        b.conv(&Conv {
            stride: 2,
            ..conv(&[x], &[0.0; 3600], y)
        });
    };
    assert!(fault(halved).starts_with("operation 1: output is Size"));
    let options = Options {
        threads: 0,
        ..Options::default()
    };
    assert_eq!(
        Builder::new().finish(options).err(),
        Some(BuildError::Range {
            what: "threads",
            actual: 0,
            allowed: "1 to 64"
        })
    );
}

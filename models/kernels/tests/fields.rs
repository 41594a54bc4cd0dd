//! Gates and guided adaptive receptive fields against double precision.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

mod oracle;

use noctule_kernels::{
    Activation, Between, Builder, Emit, Garf, Gate, Intake, Options, Size, reference,
};
use oracle::{assert_close, every_way, noise, size, wide};

#[test]
fn sparse_depth_becomes_share_and_mask() {
    for options in every_way() {
        let size = size(2, 3);
        let mut builder = Builder::new();
        let (input, output) = (builder.input(6), builder.output(12));
        let feature = builder.feature(2, size);
        builder.take(input, Intake::SparseDepth { range_m: 80.0 }, feature);
        builder.give(feature, output);
        let mut got = [f32::NAN; 12];
        let mut program = builder.finish(options).unwrap();
        let sparse = [0.0, 40.0, 80.0, 0.0, 10.0, 0.0];
        program.run(0, 0, &[&sparse], &mut [&mut got]).unwrap();
        assert_eq!(got[..6], [0.0, 0.5, 1.0, 0.0, 0.125, 0.0]);
        assert_eq!(got[6..], [0.0, 1.0, 1.0, 0.0, 1.0, 0.0]);
    }
}

#[test]
fn gates_weigh_what_they_keep() {
    for options in every_way() {
        for (inputs, kernel, shape) in [
            ([5, 20], 3, size(4, 9)),
            ([16, 1], 1, size(3, 33)),
            ([2, 2], 5, size(1, 1)),
            ([8, 33], 3, size(2, 16)),
            ([16, 24], 3, size(3, 47)),
        ] {
            gate(options, inputs, kernel, shape);
        }
    }
}

fn gate(options: Options, inputs: [usize; 2], kernel: usize, size: Size) {
    let area = size.area();
    let x: Vec<Vec<f32>> = inputs.iter().map(|c| noise(c * area, *c as u64)).collect();
    let weight = noise((inputs[0] + inputs[1]) * kernel * kernel, 3);
    let mut builder = Builder::new();
    let features = inputs.map(|channels| {
        let (input, feature) = (
            builder.input(channels * area),
            builder.feature(channels, size),
        );
        builder.take(input, Intake::Planes, feature);
        feature
    });
    let kept = builder.feature(inputs[0], size);
    let (scaled, given) = (builder.output(area), builder.output(inputs[0] * area));
    let plane = builder.plane(size);
    builder.gate(&Gate {
        inputs: &features,
        weight: &weight,
        bias: 0.3,
        kernel,
        plane: Some(plane),
        output: Some((scaled, Emit::Scaled(80.0))),
        kept: Some((features[0], kept)),
    });
    builder.give(kept, given);
    let (mut depth, mut got) = (vec![f32::NAN; area], vec![f32::NAN; inputs[0] * area]);
    let mut program = builder.finish(options).unwrap();
    program.poison();
    program
        .run(0, 0, &[&x[0], &x[1]], &mut [&mut depth, &mut got])
        .unwrap();
    let sums = reference::conv2d(&wide(&x.concat()), size, &wide(&weight), &[0.3], kernel, 1);
    let trust: Vec<f64> = sums.iter().map(|s| Activation::Sigmoid.exact(*s)).collect();
    let scaled: Vec<f64> = trust.iter().map(|c| 80.0 * c).collect();
    assert_close(&depth, &scaled, options, 1.0, "scaled gate");
    let kept: Vec<f64> = wide(&x[0])
        .iter()
        .enumerate()
        .map(|(i, x)| x * trust[i % area])
        .collect();
    assert_close(&got, &kept, options, 1.0, "kept feature");
}

#[test]
fn a_factor_scales_its_base_within_its_span() {
    for options in every_way() {
        for shape in [size(4, 9), size(3, 33), size(1, 1)] {
            factor(options, shape, false);
            factor(options, shape, true);
        }
    }
}

fn factor(options: Options, size: Size, moves: bool) {
    let area = size.area();
    let x: Vec<f32> = noise(5 * area, 8).iter().map(|v| 4.0 * v).collect();
    let weight = noise(5 * 9, 9);
    let base: Vec<f32> = noise(area, 10).iter().map(|v| 20.0 + 10.0 * v).collect();
    let mut builder = Builder::new();
    let (input, nearest) = (builder.input(5 * area), builder.input(area));
    let [drop, rise] = [11, 12].map(|seed| {
        noise(area, seed)
            .iter()
            .map(|v| 3.0 * v.abs())
            .collect::<Vec<f32>>()
    });
    let (lower, upper) = (builder.input(area), builder.input(area));
    let between = moves.then(|| Between {
        pick: builder.plane(size),
        drop: lower,
        rise: upper,
    });
    let feature = builder.feature(5, size);
    let output = builder.output(area);
    builder.take(input, Intake::Planes, feature);
    if let Some(between) = between {
        let weight: Vec<f32> = weight.iter().rev().copied().collect();
        builder.gate(&Gate {
            inputs: &[feature],
            weight: &weight,
            bias: 0.1,
            kernel: 3,
            plane: Some(between.pick),
            output: None,
            kept: None,
        });
    }
    builder.gate(&Gate {
        inputs: &[feature],
        weight: &weight,
        bias: -0.2,
        kernel: 3,
        plane: None,
        output: Some((
            output,
            Emit::Factor {
                base: nearest,
                span: 3.0,
                between,
            },
        )),
        kept: None,
    });
    let mut got = vec![f32::NAN; area];
    let mut program = builder.finish(options).unwrap();
    program.poison();
    let limits: [&[f32]; 2] = if moves { [&drop, &rise] } else { [&[]; 2] };
    let slices = [&x[..], &base, limits[0], limits[1]];
    program.run(0, 0, &slices, &mut [&mut got]).unwrap();
    let sums = reference::conv2d(&wide(&x), size, &wide(&weight), &[-0.2], 3, 1);
    let turned: Vec<f32> = weight.iter().rev().copied().collect();
    let picks = match moves {
        true => reference::conv2d(&wide(&x), size, &wide(&turned), &[0.1], 3, 1),
        false => Vec::new(),
    };
    let wanted: Vec<f64> = sums
        .iter()
        .enumerate()
        .map(|(i, z)| {
            let moved = match picks.get(i).map(|pick| (pick / 2.0).tanh()) {
                None => 0.0,
                Some(t) if t > 0.0 => t * f64::from(rise[i]),
                Some(t) => t * f64::from(drop[i]),
            };
            f64::from(base[i]) * (3.0 * (z / 3.0).tanh() + moved).exp()
        })
        .collect();
    assert_close(&got, &wanted, options, 1.0, "factor");
}

/// Shapes of one field.
#[derive(Debug, Clone, Copy)]
struct Field {
    size: Size,
    channels: usize,
    hidden: usize,
    filters: usize,
    atom_count: usize,
    side: usize,
}

#[test]
fn fields_equal_filtering_with_every_atom() {
    let base = Field {
        size: size(5, 17),
        channels: 24,
        hidden: 24,
        filters: 6,
        atom_count: 6,
        side: 3,
    };
    for options in every_way() {
        for filters in 1..=8 {
            field(options, Field { filters, ..base });
        }
        for width in [1, 2, 3, 4, 5, 14, 15, 28] {
            let field_of = |filters| Field {
                size: size(2, width),
                channels: 8,
                hidden: 4,
                filters,
                atom_count: 12,
                side: 5,
            };
            field(options, field_of(2));
        }
        let wide = Field {
            channels: 33,
            hidden: 20,
            filters: 4,
            atom_count: 18,
            side: 7,
            ..base
        };
        field(options, wide);
    }
}

/// Atoms with corners of zero, as those of a disc have.
fn atoms(shape: Field) -> Vec<f32> {
    let side = shape.side;
    let mut atoms = noise(shape.atom_count * side * side, 9);
    for atom in atoms.chunks_mut(side * side) {
        for corner in [0, side - 1, side * (side - 1), side * side - 1] {
            atom[corner] = 0.0;
        }
    }
    atoms
}

fn field(options: Options, shape: Field) {
    let Field {
        size,
        channels: d,
        hidden,
        filters,
        ..
    } = shape;
    let (area, coefficient_count) = (size.area(), filters * shape.atom_count);
    let (x, h) = (noise(d * area, 1), noise(hidden * area, 2));
    let atoms = atoms(shape);
    let (cw, cb) = (
        noise(coefficient_count * hidden, 3),
        noise(coefficient_count, 4),
    );
    let (mw, mb) = (noise(d * d * filters, 5), noise(d, 6));
    let trust_weight = noise(hidden, 7);

    let mut builder = Builder::new();
    let mut feature = |channels| {
        let (input, feature) = (
            builder.input(channels * area),
            builder.feature(channels, size),
        );
        builder.take(input, Intake::Planes, feature);
        feature
    };
    let (x_feature, h_feature) = (feature(d), feature(hidden));
    let (trust, target) = (builder.plane(size), builder.feature(d, size));
    let output = builder.output(d * area);
    builder.gate(&Gate {
        inputs: &[h_feature],
        weight: &trust_weight,
        bias: 0.0,
        kernel: 1,
        plane: Some(trust),
        output: None,
        kept: None,
    });
    builder.garf(&Garf {
        x: x_feature,
        hidden: h_feature,
        trust,
        atoms: &atoms,
        side: shape.side,
        filters,
        coefficients: (&cw, &cb),
        mix: (&mw, &mb),
        output: target,
    });
    builder.give(target, output);
    let mut got = vec![f32::NAN; d * area];
    let mut program = builder.finish(options).unwrap();
    program.poison();
    program.run(0, 0, &[&x, &h], &mut [&mut got]).unwrap();

    let (x, h) = (wide(&x), wide(&h));
    let mut a = reference::conv2d(&h, size, &wide(&cw), &wide(&cb), 1, 1);
    a.iter_mut().for_each(|a| *a = a.tanh());
    let filtered = reference::adaptive_filter(&x, size, &wide(&atoms), shape.side, &a);
    let refined = reference::conv2d(&filtered, size, &wide(&mw), &wide(&mb), 1, 1);
    let gate = reference::conv2d(&h, size, &wide(&trust_weight), &[0.0], 1, 1);
    let wanted: Vec<f64> = (0..d * area)
        .map(|i| x[i] + (1.0 - Activation::Sigmoid.exact(gate[i % area])) * refined[i])
        .collect();
    assert_close(&got, &wanted, options, 2.0, &format!("{shape:?}"));
}

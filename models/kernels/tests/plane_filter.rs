//! Adaptive filtering on planes and its gradients against the definition in double precision, on
//! every instruction set and on awkward sizes; and that threads change nothing.

use noctule_kernels::{Activation, Geometry, Isa, PlaneConv, PlaneFilter, Wanted};
use proptest::prelude::*;

fn pattern(len: usize, salt: usize) -> Vec<f32> {
    let value = |i: usize| ((i * 7919 + salt * 104_729 + 13) % 2003) as f32 / 1001.0 - 1.0;
    (0..len).map(value).collect()
}

/// The corners of the window are left out, as where no atom reaches them.
fn taps(reach: usize) -> Vec<(usize, usize)> {
    let side = 2 * reach + 1;
    let corner = |y: usize, x: usize| {
        let edge = |at: usize| at == 0 || at == side - 1;
        reach > 0 && edge(y) && edge(x)
    };
    (0..side)
        .flat_map(|y| (0..side).map(move |x| (y, x)))
        .filter(|(y, x)| !corner(*y, *x))
        .collect()
}

/// Calls `visit` with indices of output, input, coefficient and atom value of every product.
fn products(filter: &PlaneFilter<'_>, mut visit: impl FnMut(usize, usize, usize, usize)) {
    let PlaneFilter {
        batch,
        channels,
        filters,
        height,
        width,
        taps,
        reach,
        atoms,
        ..
    } = *filter;
    let (plane, count) = (height * width, atoms.len() / taps.len());
    for (n, c) in (0..batch).flat_map(|n| (0..channels).map(move |c| (n, c))) {
        for (m, pixel) in (0..filters).flat_map(|m| (0..plane).map(move |pixel| (m, pixel))) {
            for (tap, (down, right)) in taps.iter().enumerate() {
                let y = (pixel / width + down).wrapping_sub(reach);
                let x = (pixel % width + right).wrapping_sub(reach);
                if y >= height || x >= width {
                    continue;
                }
                for k in 0..count {
                    visit(
                        ((n * channels + c) * filters + m) * plane + pixel,
                        (n * channels + c) * plane + y * width + x,
                        ((n * filters + m) * count + k) * plane + pixel,
                        tap * count + k,
                    );
                }
            }
        }
    }
}

fn close(what: &str, got: &[f32], wanted: &[f64]) {
    assert_eq!(got.len(), wanted.len(), "{what}");
    let scale = wanted.iter().fold(1f64, |most, x| most.max(x.abs()));
    for (i, (g, w)) in got.iter().zip(wanted).enumerate() {
        let error = (f64::from(*g) - w).abs();
        assert!(
            error <= 1e-5 * scale,
            "{what}: value {i} is {g}, wanted {w} of {scale}"
        );
    }
}

fn check(filter: &PlaneFilter<'_>) {
    let results = filter.x.len() * filter.filters;
    let grad = pattern(results, 6);
    let mut out = vec![0f64; results];
    let (mut x_grad, mut coefficient_grad) = (
        vec![0f64; filter.x.len()],
        vec![0f64; filter.coefficients.len()],
    );
    products(filter, |o, i, a, k| {
        let (x, a_value) = (f64::from(filter.x[i]), f64::from(filter.coefficients[a]));
        let (atom, g) = (f64::from(filter.atoms[k]), f64::from(grad[o]));
        out[o] += x * a_value * atom;
        x_grad[i] += g * a_value * atom;
        coefficient_grad[a] += g * x * atom;
    });
    for isa in Isa::ALL.into_iter().filter(|isa| isa.is_available()) {
        let filter = PlaneFilter { isa, ..*filter };
        close("value", &filter.forward(), &out);
        let (x, coefficients) = filter.backward(&grad);
        close("gradient of x", &x, &x_grad);
        close("gradient of coefficients", &coefficients, &coefficient_grad);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn any_filter_and_its_gradients_are_the_definitions(
        (batch, channels, filters) in (1..3usize, 1..7usize, 1..5usize),
        (reach, count) in (0..4usize, 1..8usize),
        (height, width) in (1..20usize, 1..40usize),
    ) {
        let taps = taps(reach);
        let atoms = pattern(taps.len() * count, 1);
        let x = pattern(batch * channels * height * width, 2);
        let coefficients = pattern(batch * filters * count * height * width, 3);
        check(&PlaneFilter {
            batch,
            channels,
            filters,
            height,
            width,
            taps: &taps,
            reach,
            atoms: &atoms,
            x: &x,
            coefficients: &coefficients,
            isa: Isa::Portable,
        });
    }
}

/// Several stretches per picture, so that threads have something to share.
#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    let geometry = Geometry {
        batch: 3,
        inputs: 5,
        outputs: 6,
        kernel: 3,
        stride: 1,
        height: 70,
        width: 61,
    };
    let plane = 3 * 70 * 61;
    let (x, grad) = (pattern(5 * plane, 1), pattern(6 * plane, 2));
    let (weight, taps, atoms) = (pattern(6 * 45, 3), taps(2), pattern(21 * 12, 4));
    let coefficients = pattern(2 * 12 * plane, 5);
    let conv = PlaneConv {
        geometry,
        sources: &[(&x, 5)],
        weight: &weight,
        bias: None,
        residual: None,
        activation: Activation::Relu,
        isa: Isa::detect(),
    };
    let filter = PlaneFilter {
        batch: 3,
        channels: 5,
        filters: 2,
        height: 70,
        width: 61,
        taps: &taps,
        reach: 2,
        atoms: &atoms,
        x: &x,
        coefficients: &coefficients,
        isa: Isa::detect(),
    };
    let all = Wanted {
        sources: true,
        weight: true,
        residual: true,
    };
    let results = [1, 2, 5].map(|threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pool.expect("threads start").install(|| {
            let out = conv.forward();
            let grads = conv.backward(&out, &grad, all);
            let filtered = filter.forward();
            let (a, b) = filter.backward(&filtered);
            let parts = [
                out,
                grads.weight,
                grads.bias,
                grads.residual,
                filtered,
                a,
                b,
            ];
            let bits = |values: Vec<f32>| values.into_iter().map(f32::to_bits).collect();
            let parts = parts.into_iter().chain(grads.sources).map(bits);
            parts.collect::<Vec<Vec<u32>>>()
        })
    });
    assert!(results[0] == results[1] && results[1] == results[2]);
}

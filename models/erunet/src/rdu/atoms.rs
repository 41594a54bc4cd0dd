//! The fixed filters GARF combines: Fourier-Bessel functions on a disc.
//!
//! They are stored in every weights file; this table only starts new ones.

/// Side of the filters at each decoder level: wide where the map is small, and sparse returns
/// need a larger field; narrow at full size.
const SIZES: [&[usize]; 4] = [&[3], &[3, 5], &[3, 5], &[3, 5, 7]];

/// Order, zero of the Bessel function J of that order, and whether the angle enters as a sine.
#[allow(clippy::excessive_precision, reason = "the zeros as tabulated")]
const FUNCTIONS: [(u32, f64, bool); 6] = [
    (0, 2.404825557695773, false),
    (1, 3.831705970207512, false),
    (1, 3.831705970207512, true),
    (2, 5.135622301840683, false),
    (2, 5.135622301840683, true),
    (0, 5.520078110286311, false),
];

/// Number of filters at a decoder level and the side they are padded to.
pub(crate) fn bank_size(level: usize) -> (usize, usize) {
    let sizes = SIZES[level];
    (FUNCTIONS.len() * sizes.len(), sizes[sizes.len() - 1])
}

/// All filters of a decoder level, `[K, 1, k, k]` row by row, each of unit norm.
pub(crate) fn bank(level: usize) -> Vec<f32> {
    let (count, side) = bank_size(level);
    let mut bank = Vec::with_capacity(count * side * side);
    for &size in SIZES[level] {
        for function in FUNCTIONS {
            bank.extend(padded(&atom(size, function), size, side));
        }
    }
    bank
}

/// One function sampled on `size` x `size` points; zero outside the disc, unit norm.
#[allow(clippy::cast_precision_loss, reason = "offsets of a few pixels")]
fn atom(size: usize, (order, zero, is_sine): (u32, f64, bool)) -> Vec<f64> {
    let reach = (size / 2) as f64;
    let radius = reach + 0.5;
    let mut values = Vec::with_capacity(size * size);
    for row in 0..size {
        for column in 0..size {
            let (y, x) = (row as f64 - reach, column as f64 - reach);
            let rho = x.hypot(y) / radius;
            let angle = f64::from(order) * y.atan2(x);
            let around = if is_sine { angle.sin() } else { angle.cos() };
            values.push(if rho < 1.0 {
                bessel(order, zero * rho) * around
            } else {
                0.0
            });
        }
    }
    let norm = values.iter().map(|v| v * v).sum::<f64>().sqrt();
    values.iter().map(|v| v / norm).collect()
}

fn padded(atom: &[f64], size: usize, side: usize) -> Vec<f32> {
    let margin = (side - size) / 2;
    let mut out = vec![0.0; side * side];
    for (row, values) in atom.chunks_exact(size).enumerate() {
        for (column, &value) in values.iter().enumerate() {
            #[allow(
                clippy::cast_possible_truncation,
                reason = "rounding to single precision"
            )]
            let value = value as f32;
            out[(row + margin) * side + column + margin] = value;
        }
    }
    out
}

/// Bessel function of the first kind by its power series, good to rounding for `x` up to 6.
fn bessel(order: u32, x: f64) -> f64 {
    let half = x / 2.0;
    let mut term = half.powi(order.cast_signed());
    for i in 1..=order {
        term /= f64::from(i);
    }
    let mut sum = term;
    for j in 1..40 {
        term *= -half * half / (f64::from(j) * f64::from(j + order));
        sum += term;
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bessel_vanishes_at_its_tabulated_zeros() {
        for (order, zero, _) in FUNCTIONS {
            assert!(bessel(order, zero).abs() < 1e-14, "J{order}({zero})");
        }
        assert_eq!(bessel(0, 0.0), 1.0);
        // Abramowitz and Stegun, table 9.1.
        assert!((bessel(1, 1.0) - 0.440_050_585_744_933_5).abs() < 1e-15);
    }

    #[test]
    fn filters_have_unit_norm_and_stay_in_their_disc() {
        for (level, live) in [(0, 9), (1, 21), (2, 21), (3, 37)] {
            let (count, side) = bank_size(level);
            let bank = bank(level);
            assert_eq!(bank.len(), count * side * side);
            for atom in bank.chunks_exact(side * side) {
                let norm: f32 = atom.iter().map(|v| v * v).sum();
                assert!((norm - 1.0).abs() < 1e-6, "level {level}: {norm}");
            }
            let used = (0..side * side)
                .filter(|tap| bank.chunks_exact(side * side).any(|atom| atom[*tap] != 0.0));
            assert_eq!(used.count(), live, "level {level}");
        }
    }

    #[test]
    fn the_middle_of_a_small_filter_is_worked_out_by_hand() {
        // J0 at 0, at 2/3 and at sqrt(2) 2/3 of its first zero, over the norm of the nine.
        let z = FUNCTIONS[0].1;
        let (side, corner) = (bessel(0, z / 1.5), bessel(0, z / 1.5 * 2f64.sqrt()));
        let norm = (1.0 + 4.0 * side * side + 4.0 * corner * corner).sqrt();
        let atom = atom(3, FUNCTIONS[0]);
        assert!((atom[4] - 1.0 / norm).abs() < 1e-15);
        assert!((atom[0] - corner / norm).abs() < 1e-15);
        assert!((atom[1] - side / norm).abs() < 1e-15);
    }
}

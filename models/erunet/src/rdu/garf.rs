//! GARF: every pixel filters the depth feature with its own kernels, combined from fixed atoms
//! (paper, eq. 6).
//!
//! The kernels are built first and then applied, which costs M planes per tap instead of the K
//! planes per channel that filtering with every atom would.

use candle_core::{Device, Result, Tensor};
use noctule_kernels::Activation;

use super::atoms::bank_size;
use super::garf_cpu::FilterCpu;
use crate::config::Config;
use crate::conv::{Conv, ConvShape, is_plain};
use crate::params::{Init, Params, Role};

/// Guided adaptive receptive fields of one decoder level.
pub(super) struct Garf {
    coef1: Conv,
    coef2: Conv,
    mix: Conv,
    /// Offsets (row, column) into the padded picture of the taps some atom uses; J of them.
    taps: Vec<(usize, usize)>,
    /// What each atom holds at each of those taps, `[J, K]`.
    atoms_at_taps: Tensor,
    filters: usize,
    side: usize,
    /// The same as one operation.
    on_processor: FilterCpu,
}

impl Garf {
    pub(super) fn new(params: &Params<'_>, config: &Config, level: usize) -> Result<Self> {
        let (d, filters) = (config.d[level], config.filters);
        let (count, side) = bank_size(level);
        let shape = [count, 1, side, side];
        let atoms = params.tensor("atoms", &shape, Init::Atoms { level }, Role::Fixed)?;
        let (taps, atoms_at_taps) = live_taps(&atoms, count, side)?;
        let guided = d + config.guidance_width(level);
        let on_processor = FilterCpu {
            taps: taps.clone(),
            reach: side / 2,
            atoms: atoms_at_taps.flatten_all()?.to_vec1()?,
            filters,
        };
        Ok(Self {
            on_processor,
            coef1: Conv::new(&params.at("coef1"), ConvShape::k3(guided, d))?,
            coef2: Conv::new(&params.at("coef2"), ConvShape::k1(d, filters * count))?,
            mix: Conv::new(&params.at("mix"), ConvShape::k1(d * filters, d))?,
            taps,
            atoms_at_taps,
            filters,
            side,
        })
    }

    /// `x` `[N, d, h, w]`, `guidance` `[N, g + e, h, w]`; returns `F_ref` `[N, d, h, w]`.
    pub(super) fn forward(&self, x: &Tensor, guidance: &Tensor) -> Result<Tensor> {
        let tanh = Activation::Tanh;
        let hidden = self.coef1.apply(&[x, guidance], None, tanh)?;
        let coefficients = self.coef2.activated(&hidden, tanh)?; // [N, M*K, h, w]
        let filtered = if is_plain(x) {
            let op = self.on_processor.clone();
            x.contiguous()?.apply_op2(&coefficients.contiguous()?, op)?
        } else {
            self.filter(x, &self.kernels(&coefficients)?)?
        };
        self.mix.forward(&filtered)
    }

    /// Coefficients `[N, M*K, h, w]` (index m*K + k) to kernels `[N, M, J, h, w]`.
    fn kernels(&self, coefficients: &Tensor) -> Result<Tensor> {
        let (n, _, h, w) = coefficients.dims4()?;
        let (live, count) = self.atoms_at_taps.dims2()?;
        let flat = coefficients.reshape((n * self.filters, count, h * w))?;
        let atoms = self
            .atoms_at_taps
            .broadcast_as((n * self.filters, live, count))?;
        atoms
            .contiguous()?
            .matmul(&flat)?
            .reshape((n, self.filters, live, h, w))
    }

    /// Applies `kernels` to every channel in tensor operations, on any device, with gradients:
    /// `[N, d*M, h, w]`, index c*M + m.
    fn filter(&self, x: &Tensor, kernels: &Tensor) -> Result<Tensor> {
        let (n, d, h, w) = x.dims4()?;
        let reach = self.side / 2;
        let padded = x
            .pad_with_zeros(2, reach, reach)?
            .pad_with_zeros(3, reach, reach)?;
        let mut sum: Option<Tensor> = None;
        for (tap, &(row, column)) in self.taps.iter().enumerate() {
            let window = padded
                .narrow(2, row, h)?
                .narrow(3, column, w)?
                .unsqueeze(2)?;
            let weights = kernels.narrow(2, tap, 1)?.squeeze(2)?.unsqueeze(1)?; // [N, 1, M, h, w]
            let term = window.broadcast_mul(&weights)?; // [N, d, M, h, w]
            sum = Some(match sum {
                None => term,
                Some(sum) => (sum + term)?,
            });
        }
        sum.expect("there is always at least one tap")
            .reshape((n, d * self.filters, h, w))
    }
}

/// The taps at which any of `atoms` `[K, 1, k, k]` is not zero, and the atoms there, `[J, K]`.
///
/// Dropping the others is exact. Atoms that are zero throughout leave the middle tap.
fn live_taps(atoms: &Tensor, count: usize, side: usize) -> Result<(Vec<(usize, usize)>, Tensor)> {
    let rows: Vec<Vec<f32>> = atoms.reshape((count, side * side))?.to_vec2()?;
    let is_live = |tap: usize| rows.iter().any(|row| row[tap] != 0.0);
    let mut live: Vec<usize> = (0..side * side).filter(|&tap| is_live(tap)).collect();
    if live.is_empty() {
        live.push(side * side / 2);
    }
    let values: Vec<f32> = live
        .iter()
        .flat_map(|&tap| rows.iter().map(move |r| r[tap]))
        .collect();
    let values = Tensor::from_vec(values, (live.len(), count), &Device::Cpu)?;
    let taps = live.iter().map(|tap| (tap / side, tap % side)).collect();
    Ok((taps, values.to_device(atoms.device())?))
}

#[cfg(test)]
mod tests {
    use candle_core::Var;
    use candle_core::backprop::GradStore;

    use super::*;
    use crate::params::{Norms, Source};
    use crate::weights::Weights;

    /// A GARF of the small test network at `level`, started from `seed`.
    fn garf(level: usize, seed: u32) -> Garf {
        let config = Config::tiny();
        let weights = Weights::initial(&config, seed, &Device::Cpu).unwrap();
        let source = Source::Given(weights.tensors());
        let params = Params::root(&source, Norms::Keep).at(&format!("rdu.dec{level}.garf"));
        Garf::new(&params, &config, level).unwrap()
    }

    fn random(shape: &[usize]) -> Tensor {
        let len: usize = shape.iter().product();
        let values: Vec<f32> = (0..len)
            .map(|i| ((i * 37 + 11) % 101) as f32 / 50.5 - 1.0)
            .collect();
        Tensor::from_vec(values, shape, &Device::Cpu).unwrap()
    }

    /// The definition: filter with every atom, then combine (steps 2 and 3 of the paper's form).
    fn filter_with_every_atom(garf: &Garf, level: usize, x: &Tensor, a: &Tensor) -> Vec<f32> {
        let (count, side) = bank_size(level);
        let bank = crate::rdu::bank(level);
        let (n, d, h, w) = x.dims4().unwrap();
        let x: Vec<f32> = x.flatten_all().unwrap().to_vec1().unwrap();
        let a: Vec<f32> = a.flatten_all().unwrap().to_vec1().unwrap();
        let reach = side / 2;
        let pixel = |i: usize, c: usize, y: usize, z: usize| {
            let inside = (reach..h + reach).contains(&y) && (reach..w + reach).contains(&z);
            if inside {
                f64::from(x[((i * d + c) * h + y - reach) * w + z - reach])
            } else {
                0.0
            }
        };
        let mut out = Vec::new();
        for (i, c, m) in (0..n)
            .flat_map(|i| (0..d).map(move |c| (i, c)))
            .flat_map(|(i, c)| (0..garf.filters).map(move |m| (i, c, m)))
        {
            for (y, z) in (0..h).flat_map(|y| (0..w).map(move |z| (y, z))) {
                let mut sum = 0.0;
                for k in 0..count {
                    let weight = a[((i * garf.filters + m) * count + k) * h * w + y * w + z];
                    for tap in 0..side * side {
                        let atom = f64::from(bank[k * side * side + tap]);
                        sum +=
                            f64::from(weight) * atom * pixel(i, c, y + tap / side, z + tap % side);
                    }
                }
                #[allow(clippy::cast_possible_truncation, reason = "rounding to single")]
                out.push(sum as f32);
            }
        }
        out
    }

    #[test]
    fn kernels_first_equals_filtering_with_every_atom() {
        for level in 0..4 {
            let garf = garf(level, 3);
            let (count, _) = bank_size(level);
            let (d, h, w) = (Config::tiny().d[level], 4, 6);
            let x = random(&[2, d, h, w]);
            let a = random(&[2, garf.filters * count, h, w]);
            let kernels = garf.kernels(&a).unwrap();
            let composed = garf.filter(&x, &kernels).unwrap();
            let fused = x.apply_op2_no_bwd(&a, &garf.on_processor).unwrap();
            let wanted = filter_with_every_atom(&garf, level, &x, &a);
            for tensor in [composed, fused] {
                let got: Vec<f32> = tensor.flatten_all().unwrap().to_vec1().unwrap();
                assert_eq!(got.len(), wanted.len());
                for (g, w) in got.iter().zip(&wanted) {
                    assert!(
                        (g - w).abs() < 1e-5 * w.abs().max(1.0),
                        "level {level}: {g} {w}"
                    );
                }
            }
        }
    }

    /// The composed form has candle's gradients; sizes leave vectors and stretches incomplete.
    #[test]
    fn gradients_equal_those_of_the_composed_form() {
        for (level, h, w) in [(0, 5, 7), (1, 6, 19), (2, 33, 40), (3, 4, 3)] {
            let garf = garf(level, 3);
            let (count, _) = bank_size(level);
            let d = Config::tiny().d[level];
            let x = Var::from_tensor(&random(&[2, d, h, w])).unwrap();
            let a = Var::from_tensor(&random(&[2, garf.filters * count, h, w])).unwrap();
            let kernels = garf.kernels(&a).unwrap();
            let composed = garf.filter(&x, &kernels).unwrap();
            let fused = x.apply_op2(&a, garf.on_processor.clone()).unwrap();
            let [composed, fused] = [composed, fused].map(|y| {
                let weights = random(y.dims());
                (y * weights)
                    .unwrap()
                    .sum_all()
                    .unwrap()
                    .backward()
                    .unwrap()
            });
            for var in [&x, &a] {
                let read = |grads: &GradStore| {
                    let grad = grads.get(var).unwrap();
                    grad.flatten_all().unwrap().to_vec1::<f32>().unwrap()
                };
                for (g, w) in read(&fused).iter().zip(read(&composed)) {
                    assert!(
                        (g - w).abs() < 1e-4 * w.abs().max(1.0),
                        "level {level}: {g} {w}"
                    );
                }
            }
        }
    }
}

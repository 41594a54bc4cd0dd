//! A trained network's weights in the widths of a larger member, which then starts where the smaller
//! one has got to.
//!
//! Function-preserving growth as in Net2Net (Chen, Goodfellow and Shlens 2016), but that what is new starts
//! random and unheard: channels that were there keep their weights and give nothing to what the new
//! ones say, and a block that was not there adds nothing. The first steps of training open both.

use candle_core::{IndexOp, Tensor};

use crate::config::Config;
use crate::weights::{Weights, WeightsError};

impl Weights {
    /// These weights in the network of `config`, which computes what this one does but for rounding; what
    /// is new starts as [`Weights::initial`] has it from `seed`.
    ///
    /// # Errors
    /// [`WeightsError::Growth`], when the file carries no configuration, or `config` is narrower or
    /// shorter somewhere, of another form or variant, or counts steps, bins or metres differently.
    pub fn grown(&self, config: &Config, seed: u32) -> Result<Self, WeightsError> {
        let from = self.config().ok_or_else(|| {
            WeightsError::Growth("the file does not say which network it is of".into())
        })?;
        self.check(from)?;
        if let Some(obstacle) = obstacle(from, config) {
            let growth = format!("{} into {}: {obstacle}", from.name, config.name);
            return Err(WeightsError::Growth(growth));
        }
        let step = Growth { from, to: config };
        let start = Self::initial(config, seed, &self.device())?;
        let mut tensors = start.tensors().clone();
        for (name, fresh) in &mut tensors {
            match self.tensors().get(name) {
                Some(old) => *fresh = step.widened(name, old, fresh)?,
                None if is_last_word(name) => *fresh = fresh.zeros_like()?,
                None => {}
            }
        }
        Self::from_tensors(config, tensors, &self.device())
    }
}

/// Whether the tensor scales what a residual block adds.
fn is_last_word(name: &str) -> bool {
    name.ends_with("bn2.weight") || (name.starts_with("efr.") && name.ends_with("conv2.weight"))
}

/// What keeps one configuration from holding the other.
fn obstacle(from: &Config, to: &Config) -> Option<String> {
    if let Err(error) = to.validate() {
        return Some(error.to_string());
    }
    let same = |config: &Config| {
        let range_mm = (config.d_max * 1e3).round();
        let Config { variant, form, .. } = config;
        let counts = [config.steps, config.bins, config.freqs];
        format!("{variant:?}, {form:?}, {counts:?} steps, bins and frequencies, {range_mm} mm")
    };
    if same(from) != same(to) {
        return Some(format!("{} is not {}", same(from), same(to)));
    }
    let sizes = |config: &Config| -> Vec<(&'static str, Vec<usize>)> {
        vec![
            ("c", config.c.to_vec()),
            ("n_sp", config.n_sp.to_vec()),
            ("n1, n2", vec![config.n1, config.n2]),
            ("k", config.k.to_vec()),
            ("n_t, cd", vec![config.n_t, config.cd]),
            ("g", config.g.to_vec()),
            ("e", config.e.to_vec()),
            ("d", config.d.to_vec()),
            ("n_g", config.n_g.to_vec()),
            ("n_e", config.n_e.to_vec()),
            ("n_d", config.n_d.to_vec()),
            ("n_b, M", vec![config.n_b, config.filters]),
            ("n_u", config.n_u.to_vec()),
        ]
    };
    let mut pairs = sizes(from).into_iter().zip(sizes(to));
    pairs.find_map(|((key, small), (_, large))| {
        let falls = small.iter().zip(&large).any(|(small, large)| small > large);
        falls.then(|| format!("{key} falls from {small:?} to {large:?}"))
    })
}

/// From which configuration to which.
struct Growth<'a> {
    from: &'a Config,
    to: &'a Config,
}

impl Growth<'_> {
    /// `old` within `fresh`: its own channels as they were, deaf to the new ones.
    fn widened(&self, name: &str, old: &Tensor, fresh: &Tensor) -> candle_core::Result<Tensor> {
        if old.dims() == fresh.dims() {
            return Ok(old.clone());
        }
        let rows = old.dim(0)?;
        let above = match *old.dims() {
            [_, inputs, height, width] => {
                let places = self.places(name, inputs);
                let mut columns = vec![None; fresh.dim(1)?];
                for (input, place) in places.into_iter().enumerate() {
                    columns[place] = Some(input);
                }
                let deaf = Tensor::zeros((rows, 1, height, width), old.dtype(), old.device())?;
                let columns = columns.into_iter().map(|column| match column {
                    Some(input) => old.narrow(1, input, 1),
                    None => Ok(deaf.clone()),
                });
                Tensor::cat(&columns.collect::<candle_core::Result<Vec<_>>>()?, 1)?
            }
            _ => old.clone(),
        };
        if rows == fresh.dim(0)? {
            return Ok(above);
        }
        Tensor::cat(&[&above, &fresh.i(rows..)?], 0)?.contiguous()
    }

    /// Where each of a convolution's input channels lies among those of the larger one. They come as
    /// parts side by side, each of which may have grown.
    fn places(&self, name: &str, inputs: usize) -> Vec<usize> {
        let parts = self.parts(name);
        if parts.is_empty() {
            return (0..inputs).collect();
        }
        let mut first = 0;
        let mut places = Vec::with_capacity(inputs);
        for (small, large) in parts {
            places.extend(first..first + small);
            first += large;
        }
        places
    }

    /// Widths of the parts, in the smaller and in the larger network; empty where there is one.
    fn parts(&self, name: &str) -> Vec<(usize, usize)> {
        let (from, to) = (self.from, self.to);
        let guided = |level: usize| {
            let mut parts = vec![(from.d[level], to.d[level]), (from.g[level], to.g[level])];
            if from.has_event_pyramid() {
                parts.push((from.e[level], to.e[level]));
            }
            parts
        };
        let twice = |small: usize, large: usize| vec![(small, large); 2];
        let level = name
            .strip_prefix("rdu.dec")
            .and_then(|rest| rest.split_once('.'))
            .and_then(|(level, part)| Some((level.parse::<usize>().ok()?, part)));
        match (name, level) {
            ("efr.fuse.conv1.weight", _) => twice(from.c[0], to.c[0]),
            ("efr.dec2.merge.weight", _) => twice(from.c[1], to.c[1]),
            // What follows the first part, the coordinates, does not grow.
            ("efr.temporal.mlp1.weight", _) => {
                let coordinates = 6 * from.freqs;
                vec![(from.k[1], to.k[1]), (coordinates, coordinates)]
            }
            ("rdu.bott.conv.weight", _) => guided(4),
            (_, Some((level, "merge.conv.weight"))) => twice(from.d[level], to.d[level]),
            (_, Some((level, "conf.weight" | "garf.coef1.weight"))) => guided(level),
            // Each channel's filtered versions lie side by side.
            (_, Some((level, "garf.mix.weight"))) => {
                vec![(from.filters, to.filters); from.d[level]]
            }
            _ => Vec::new(),
        }
    }
}

#[cfg(test)]
mod tests {
    use candle_core::{DType, Device};

    use super::*;
    use crate::{Network, Norms, Variant};

    /// Weights in which nothing is a no-op: every value of a new network is moved a little, and the
    /// head's rectifiers are open. `raised` has a tenth more.
    fn stirred(config: &Config, raised: &str) -> Weights {
        let start = Weights::initial(config, 3, &Device::Cpu).unwrap();
        let stir = |(at, (name, tensor)): (usize, (&String, &Tensor))| {
            let open = if name == "rdu.head1.bias" { 0.5 } else { 0.0 };
            let wave = |i: usize| ((i * 7 + at * 13) % 11) as f32 / 500.0 - 0.01 + open;
            let wave = (0..tensor.elem_count()).map(wave).collect();
            let wave = Tensor::from_vec(wave, tensor.dims(), &Device::Cpu).unwrap();
            let moved = match name {
                _ if name.ends_with("atoms") => Ok(tensor.clone()),
                _ => tensor + wave,
            };
            let gain = if name == raised { 1.1 } else { 1.0 };
            (name.clone(), (moved.unwrap() * gain).unwrap())
        };
        let tensors = start.tensors().iter().enumerate().map(stir).collect();
        Weights::from_tensors(config, tensors, &Device::Cpu).unwrap()
    }

    fn depth(config: &Config, weights: &Weights) -> Vec<f32> {
        let network = Network::new(config, weights, Norms::Fold).unwrap();
        let wave = |shape: &[usize], scale: f32| {
            let count = shape.iter().product::<usize>();
            let at = |i: usize| ((i * 31 + 7) % 97) as f32 / 97.0 * scale;
            Tensor::from_vec((0..count).map(at).collect::<Vec<_>>(), shape, &Device::Cpu).unwrap()
        };
        let steps = config.steps;
        let sparse = wave(&[1, steps, 1, 32, 32], 60.0);
        let rare = wave(&[1, steps, 1, 32, 32], 1.0).gt(0.9f32).unwrap();
        let sparse = (sparse * rare.to_dtype(DType::F32).unwrap()).unwrap();
        let (blur, voxel) = (
            wave(&[1, 3, 32, 32], 1.0),
            wave(&[1, steps, 5, 32, 32], 0.3),
        );
        let outputs = network.forward(&blur, &voxel, &sparse).unwrap();
        outputs.depth.flatten_all().unwrap().to_vec1().unwrap()
    }

    fn apart(a: &[f32], b: &[f32]) -> f32 {
        let apart = a.iter().zip(b).map(|(a, b)| (a - b).abs() / a);
        apart.fold(0.0, f32::max)
    }

    /// `s`, and with a further residual block wherever restoration has some.
    fn larger(variant: Variant) -> Config {
        let mut large = Config::s().with_steps(2).with_variant(variant);
        (large.n_sp, large.n1, large.n2, large.n_t) = ([1, 2, 2], 2, 2, 2);
        large
    }

    #[test]
    fn the_larger_network_computes_what_the_smaller_one_did() {
        for variant in [Variant::Full, Variant::NoEfr, Variant::NoHgcm] {
            let (small, large) = (
                Config::xs().with_steps(2).with_variant(variant),
                larger(variant),
            );
            let weights = stirred(&small, "");
            let grown = weights.grown(&large, 5).unwrap();
            let before = depth(&small, &weights);
            let worst = apart(&before, &depth(&large, &grown));
            assert!(worst < 1e-5, "{variant:?}: {worst}");
            // The new channels hold something, or they would never learn.
            let stem = &grown.tensors()["rdu.depth.stem.weight"];
            let new = stem.i(8..).unwrap().abs().unwrap().mean_all().unwrap();
            assert!(new.to_scalar::<f32>().unwrap() > 0.01);
            // A small change of what is put together from parts would have been seen.
            let parts = ["rdu.bott.conv", "rdu.dec0.merge.conv", "rdu.dec0.garf.mix"];
            let restored = ["efr.fuse.conv1", "efr.dec2.merge", "efr.temporal.mlp1"];
            let restored = restored.into_iter().filter(|_| small.has_efr());
            for part in parts.into_iter().chain(restored) {
                let other = stirred(&small, &format!("{part}.weight"));
                let seen = apart(&before, &depth(&small, &other));
                assert!(seen > 1e-4, "{variant:?}, {part}: {seen}");
            }
        }
    }

    #[test]
    fn what_does_not_fit_is_refused_with_both_values() {
        let weights = Weights::initial(&Config::s(), 1, &Device::Cpu).unwrap();
        let error = |config: &Config| weights.grown(config, 1).unwrap_err().to_string();
        let narrower = error(&Config::xs());
        assert!(
            narrower.contains("s into xs: c falls from [16, 32, 48] to [8, 16, 32]"),
            "{narrower}"
        );
        let shorter = error(&Config::s().with_steps(4));
        assert!(shorter.contains("[8, 5, 4] steps"), "{shorter}");
        let other = error(&Config::s().with_variant(Variant::NoEfr));
        assert!(other.contains("Full") && other.contains("NoEfr"), "{other}");
    }
}

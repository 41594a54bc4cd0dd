//! The restoration network as a plan (paper, equations 1 to 4).

use candle_core::{Device, Result};
use noctule_kernels::{Activation, Intake, Passes, Store};

use super::draft::{Draft, Layer, Map, Then};
use super::{BEGIN, FIRST, LATER, SETUP, any_step};
use crate::efr::{centre, coordinates};

const LEAKY: Then = Then::new(Activation::LeakyRelu);
const PLAIN: Then = Then::new(Activation::None);

impl Draft<'_> {
    /// Adds everything up to `F_clear`; returns it, and the slice the set-up takes.
    pub(super) fn restoration(&mut self) -> Result<(Map, Vec<f32>)> {
        let size = self.size;
        let c0 = self.config.c[0];
        self.builder.set_passes(Passes::of(&[BEGIN]));
        let blur = Map {
            feature: self.builder.feature(3, size),
            size,
        };
        let from = self.slices.blur;
        self.builder.set_label("blur");
        self.builder.take(from, Intake::Planes, blur.feature);
        let state = self.builder.state(c0, size);
        let clear = Map {
            feature: state,
            size,
        };
        if !self.config.has_efr() {
            self.named("rdu.rgb_stem", &[blur], LEAKY.into(clear))?;
            return Ok((clear, Vec::new()));
        }
        let still = Map {
            feature: self.builder.state(c0, size),
            size,
        };
        self.appearance(blur, still)?;
        let (motion, place) = self.motion()?;
        let (e1, e2) = self.encode(still, clear)?;
        let moved = self.film(motion, e2)?;
        self.decode(moved, e1, clear)?;
        Ok((clear, place))
    }

    /// `F_static`, once per exposure.
    fn appearance(&mut self, blur: Map, still: Map) -> Result<()> {
        let n_sp = self.config.n_sp;
        let at = |name: &str| format!("efr.spatial.{name}");
        let stem = self.named(&at("stem"), &[blur], LEAKY)?;
        let p0 = self.res_e(&at("rb0"), n_sp[0], stem)?;
        let down1 = self.named(&at("down1"), &[p0], LEAKY.halving())?;
        let p1 = self.res_e(&at("rb1"), n_sp[1], down1)?;
        let down2 = self.named(&at("down2"), &[p1], LEAKY.halving())?;
        let p2 = self.res_e(&at("rb2"), n_sp[2], down2)?;
        let spread = PLAIN.stored(Store::Nearest);
        let m1 = self.named(&at("lat2"), &[p2], spread.plus(p1))?;
        let m0 = self.named(&at("lat1"), &[m1], spread.plus(p0))?;
        self.named(&at("out"), &[m0], PLAIN.into(still))?;
        Ok(())
    }

    /// `F_dyn,t`, and what the coordinates of the cells add to its first layer.
    fn motion(&mut self) -> Result<(Map, Vec<f32>)> {
        let at = |name: &str| format!("efr.temporal.{name}");
        let voxel = self.voxel();
        let x = self.named(&at("conv1"), &[voxel], LEAKY.halving())?;
        let x = self.named(&at("conv2"), &[x], LEAKY.halving())?;
        let x = self.res_e(&at("rb"), self.config.n_t, x)?;
        let (layer, share) = self.first_of_motion(&at("mlp1"), x)?;
        let place = Map {
            feature: self.builder.state(self.config.cd, x.size),
            size: x.size,
        };
        let from = self.builder.input(share.len());
        self.builder.set_passes(Passes::of(&[SETUP]));
        self.builder.set_label("coordinates");
        self.builder.take(from, Intake::Planes, place.feature);
        self.builder.set_passes(any_step());
        let x = self.conv(&at("mlp1"), &layer, &[x], LEAKY.plus(place));
        let x = self.named(&at("mlp2"), &[x], LEAKY)?;
        Ok((self.named(&at("mlp3"), &[x], PLAIN)?, share))
    }

    /// The layer that sees the coordinates, without them: a cell's place adds a fixed feature
    /// `[cd, h, w]`, returned beside it, and time becomes one set of biases per step.
    fn first_of_motion(&self, path: &str, x: Map) -> Result<(Layer, Vec<f32>)> {
        let whole = self.layer(path)?;
        let (k2, freqs, steps) = (self.config.k[1], self.config.freqs, self.config.steps);
        let (area, placed) = (x.size.area(), 4 * freqs);
        let rows: Vec<&[f32]> = whole.weight.chunks(whole.inputs).collect();
        let planes = |t: usize| -> Result<Vec<f32>> {
            let tau = centre(t, steps);
            coordinates(x.size.height, x.size.width, tau, freqs, &Device::Cpu)?
                .flatten_all()?
                .to_vec1()
        };
        let mut share = vec![0.0; rows.len() * area];
        let fixed = planes(0)?;
        for (row, out) in rows.iter().zip(share.chunks_mut(area)) {
            for (weight, plane) in row[k2..k2 + placed].iter().zip(fixed.chunks(area)) {
                for (out, value) in out.iter_mut().zip(plane) {
                    *out += weight * value;
                }
            }
        }
        let mut bias = Vec::with_capacity(steps * rows.len());
        for t in 0..steps {
            let waves: Vec<f32> = planes(t)?
                .iter()
                .skip(placed * area)
                .step_by(area)
                .copied()
                .collect();
            for (row, bias_of) in rows.iter().zip(&whole.bias) {
                let weights = row[k2 + placed..].iter();
                bias.push(bias_of + weights.zip(&waves).map(|(w, v)| w * v).sum::<f32>());
            }
        }
        let layer = Layer {
            weight: rows.iter().flat_map(|row| row[..k2].to_vec()).collect(),
            bias,
            inputs: k2,
            kernel: 1,
        };
        Ok((layer, share))
    }

    /// E1 and E2 of what enters: the still feature, corrected by the last clear one (eq. 4).
    fn encode(&mut self, still: Map, clear: Map) -> Result<(Map, Map)> {
        self.builder.set_passes(Passes::of(&[LATER]));
        let h = self.named("efr.fuse.conv1", &[still, clear], LEAKY)?;
        let entering = self.named("efr.fuse.conv2", &[h], PLAIN.plus(still))?;
        let down = LEAKY.halving();
        let x = self.named("efr.enc1.down", &[entering], down)?;
        self.builder.set_passes(Passes::of(&[FIRST]));
        self.named("efr.enc1.down", &[still], down.into(x))?;
        self.builder.set_passes(any_step());
        let e1 = self.res_e("efr.enc1.rb", self.config.n1, x)?;
        let x = self.named("efr.enc2.down", &[e1], down)?;
        let e2 = self.res_e("efr.enc2.rb", self.config.n2, x)?;
        Ok((e1, e2))
    }

    /// `F_st = gamma * E2 + beta` (eq. 2).
    fn film(&mut self, motion: Map, e2: Map) -> Result<Map> {
        let h = self.named("efr.film.trunk", &[motion], LEAKY)?;
        let beta = self.named("efr.film.beta", &[h], PLAIN)?;
        self.named("efr.film.gamma", &[h], PLAIN.times(e2).plus(beta))
    }

    /// `F_clear` (eq. 1 and 3).
    fn decode(&mut self, moved: Map, e1: Map, clear: Map) -> Result<()> {
        let x = self.res_e("efr.dec1.rb", self.config.n2, moved)?;
        let d1 = self.up("efr.dec1.up", x, Activation::LeakyRelu)?;
        let x = self.named("efr.dec2.merge", &[d1, e1], LEAKY)?;
        let x = self.res_e("efr.dec2.rb", self.config.n1, x)?;
        let x = self.up("efr.dec2.up", x, Activation::LeakyRelu)?;
        self.named("efr.dec2.out", &[x], PLAIN.into(clear))?;
        Ok(())
    }
}

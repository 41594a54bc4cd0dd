//! Event-guided feature restoration: one blurred picture and a step's events in, one sharp
//! feature per step out (paper, section 3.2; equations 1 to 4).

mod film;
mod fuse;
mod inr;
mod recon;
mod spatial;
mod temporal;

use candle_core::{Result, Tensor};

use crate::blocks::modulate;
use crate::config::Config;
use crate::params::Params;
use crate::pass::Pass;
use film::Film;
use fuse::Fuse;
use inr::Inr;
use recon::Recon;
use spatial::Spatial;
use temporal::Temporal;

pub(crate) use temporal::{centre, coordinates};

/// The restoration network; weight names start with `efr.`.
pub(crate) struct Efr {
    spatial: Spatial,
    temporal: Temporal,
    film: Film,
    fuse: Fuse,
    inr: Inr,
    recon: Recon,
}

impl Efr {
    pub(crate) fn new(params: &Params<'_>, config: &Config) -> Result<Self> {
        Ok(Self {
            spatial: Spatial::new(&params.at("spatial"), config)?,
            temporal: Temporal::new(&params.at("temporal"), config)?,
            film: Film::new(&params.at("film"), config)?,
            fuse: Fuse::new(&params.at("fuse"), config)?,
            inr: Inr::new(params, config)?,
            recon: Recon::new(&params.at("recon"), config)?,
        })
    }

    /// What the picture alone says, once per exposure: `blur` `[B, 3, H, W]` to `F_static`
    /// `[B, c0, H, W]`.
    pub(crate) fn appearance(&self, blur: &Tensor, pass: &mut Pass) -> Result<Tensor> {
        let still = self.spatial.forward(blur)?;
        pass.keep_single("F_static", &still);
        Ok(still)
    }

    /// Restores step `t` (from 0): `still` and `previous` `[B, c0, H, W]`, `voxel`
    /// `[B, bins, H, W]`; returns `F_clear,t` `[B, c0, H, W]`.
    pub(crate) fn step(
        &self,
        still: &Tensor,
        previous: Option<&Tensor>,
        voxel: &Tensor,
        t: usize,
        pass: &mut Pass,
    ) -> Result<Tensor> {
        let entering = match previous {
            None => still.clone(),
            Some(previous) => self.fuse.forward(still, previous)?, // eq. 4
        };
        let (e1, e2) = self.inr.encode(&entering)?; // [B, c1, H/2, W/2], [B, c2, H/4, W/4]
        let motion = self.temporal.forward(voxel, t)?; // [B, cd, H/4, W/4]
        let (gamma, beta) = self.film.forward(&motion)?; // [B, c2, H/4, W/4]
        let moved = modulate(&gamma, &e2, &beta)?; // eq. 2
        let clear = self.inr.decode(&moved, &e1)?; // eq. 1, 3
        for (name, feature) in [
            ("F_dyn", &motion),
            ("gamma", &gamma),
            ("beta", &beta),
            ("F_st", &moved),
            ("F_clear", &clear),
        ] {
            pass.keep(name, t, feature);
        }
        Ok(clear)
    }

    /// The sharp picture of one step, for the losses of stage 1: `[B, c0, H, W]` and
    /// `[B, 3, H, W]` to `[B, 3, H, W]`.
    pub(crate) fn reconstruct(&self, clear: &Tensor, blur: &Tensor) -> Result<Tensor> {
        self.recon.forward(clear, blur)
    }
}

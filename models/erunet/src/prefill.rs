//! What the residual forms start from: the nearest return of every pixel, how far to trust it, and
//! how much nearer and farther the returns around the pixel reach.
//!
//! The network then says by which factor the nearest return's depth is wrong, so that with nothing
//! learned it equals nearest-neighbour completion.

use candle_core::{Device, Result, Tensor};
use noctule_depth::{Completer, Ground, Levelling, SizeError, Surround};
use rayon::prelude::*;

use crate::config::Form;

/// Depth assumed everywhere where an exposure has not a single return, as a share of the range.
pub const FALLBACK_SHARE: f32 = 0.125;

/// Largest factor, as a natural logarithm, between the nearest return's depth and the network's:
/// depth = nearest * exp(LOG_SPAN * tanh(z / LOG_SPAN)), up to 20 times nearer or farther.
pub const LOG_SPAN: f32 = 3.0;

/// How far around a pixel returns count as its surroundings, pixels in both directions.
pub const SURROUND_PX: usize = 12;

/// The plane that says how much nearer the nearest of the surrounding returns is than the return
/// closest to the pixel, natural logarithm of the ratio.
pub(crate) const DROP: usize = 3;
/// The plane that says how much farther the farthest of them is.
pub(crate) const RISE: usize = 4;
/// The plane that says how much farther than that return the ground lies, if it is known.
const GROUND: usize = 5;
/// The plane that says how high above the ground the pixel is if it has that return's depth, in
/// heights of the camera: 0 on the road, 1 on the horizon. It tells the roof of a car from what
/// is behind it where no ring has hit it.
const HEIGHT: usize = 6;

/// Heights beyond these are held to them, in heights of the camera.
const HEIGHTS: [f32; 2] = [-1.0, 4.0];

/// Completes maps of one size; allocates once.
pub(crate) struct Prefill {
    completer: Completer,
    /// Planes seen.
    planes: usize,
    range_m: f32,
    /// Present in the form that chooses.
    around: Option<Around>,
}

struct Around {
    surround: Surround,
    /// Logarithm of each return's depth; no number where there is none.
    logarithm: Vec<f32>,
    width: usize,
    told: Option<Ground>,
    levelling: Levelling,
    /// Rows by which the road lies lower than told; 0 until returns say otherwise.
    rows_down: f32,
    /// Logarithm of the ground's depth; empty where the ground is unknown.
    ground: Vec<f32>,
    /// The ground's inverse depth, 1/m; empty where the ground is unknown.
    inverse: Vec<f32>,
}

impl Prefill {
    pub(crate) fn new(form: Form, height: usize, width: usize, range_m: f32) -> Result<Self> {
        let completer = Completer::new(width, height).map_err(candle_core::Error::wrap)?;
        let around = (form == Form::Choice)
            .then(|| {
                Surround::new(width, height, SURROUND_PX).map(|surround| Around {
                    surround,
                    logarithm: vec![0.0; height * width],
                    width,
                    told: None,
                    levelling: Levelling::new(),
                    rows_down: 0.0,
                    ground: Vec::with_capacity(height * width),
                    inverse: Vec::with_capacity(height * width),
                })
            })
            .transpose()
            .map_err(candle_core::Error::wrap)?;
        Ok(Self {
            completer,
            planes: form.depth_channels(),
            range_m,
            around,
        })
    }

    /// From now on the ground lies there, or as many rows above or below as a map's returns on the road
    /// say ([`Levelling`]); `None` where nobody knows. Costs nothing while it stays where it was.
    pub(crate) fn stand_on(&mut self, ground: Option<&Ground>) {
        if let Some(around) = &mut self.around
            && around.told.as_ref() != ground
        {
            around.told = ground.copied();
            around.lay(0.0);
        }
    }

    /// From `sparse` `[H, W]` in metres, 0 for no return: `nearest` `[H, W]` in metres, and `seen`
    /// `[3 or 7, H, W]`: the nearest over the range, 1 at a return, `exp(-distance / 8 px)`, and
    /// in the form that chooses [`DROP`], [`RISE`], [`GROUND`] and [`HEIGHT`].
    pub(crate) fn fill(
        &mut self,
        sparse: &[f32],
        nearest: &mut [f32],
        seen: &mut [f32],
    ) -> Result<()> {
        let area = nearest.len();
        let planes = self.planes;
        if seen.len() != planes * area {
            candle_core::bail!("{} values for {planes} planes of {area}", seen.len());
        }
        let (share, rest) = seen.split_at_mut(area);
        let (returned, rest) = rest.split_at_mut(area);
        let (trust, limits) = rest.split_at_mut(area);
        let any = self
            .completer
            .nearest_with_confidence(sparse, nearest, trust)
            .map_err(candle_core::Error::wrap)?;
        if !any {
            nearest.fill(self.range_m * FALLBACK_SHARE);
        }
        for (mask, trust) in returned.iter_mut().zip(&*trust) {
            // Confidence is exactly one at a return and nowhere else.
            *mask = f32::from(u8::from(*trust == 1.0));
        }
        if let Some(around) = &mut self.around {
            let (limits, ground) = limits.split_at_mut((GROUND - DROP) * area);
            if any {
                let found = around.reach(&self.completer, sparse, share, limits);
                found.map_err(candle_core::Error::wrap)?;
            } else {
                limits.fill(0.0);
                share.fill((self.range_m * FALLBACK_SHARE).ln());
            }
            around.level(sparse);
            around.stand(share, nearest, ground);
        }
        for (share, nearest) in share.iter_mut().zip(&*nearest) {
            *share = nearest / self.range_m;
        }
        Ok(())
    }
}

impl Around {
    /// Lays the ground where the returns of a map see the road: a car pitches, by half a degree when it
    /// brakes, and its calibration says nothing of that. Each map speaks for itself alone, so that a
    /// sequence does not depend on the one before it.
    fn level(&mut self, sparse: &[f32]) {
        let Some(told) = &self.told else {
            return;
        };
        let rows_down = self.levelling.rows_down(told, sparse, self.width);
        let rows_down = rows_down.unwrap_or(0.0);
        if rows_down != self.rows_down {
            self.lay(rows_down);
        }
    }

    /// Lays the ground so many rows lower than told.
    fn lay(&mut self, rows_down: f32) {
        self.rows_down = rows_down;
        self.ground.clear();
        self.inverse.clear();
        let Some(ground) = self.told.map(|told| told.lowered(rows_down)) else {
            return;
        };
        for cell in 0..self.logarithm.len() {
            let (column, row) = ((cell % self.width) as f32, (cell / self.width) as f32);
            let inverse = ground.inverse_depth(column, row);
            self.ground.push(-inverse.max(f32::MIN_POSITIVE).ln());
            self.inverse.push(inverse);
        }
    }

    /// [`GROUND`] and [`HEIGHT`] into `planes`, where `own` is the logarithm of `nearest`. The ray
    /// through a pixel falls one height of the camera down to the ground's depth (above the
    /// horizon it rises), so that up to `nearest` it has fallen their ratio.
    fn stand(&self, own: &[f32], nearest: &[f32], planes: &mut [f32]) {
        if self.told.is_none() {
            planes.fill(0.0);
            return;
        }
        let (below, height) = planes.split_at_mut((HEIGHT - GROUND) * nearest.len());
        for ((below, ground), own) in below.iter_mut().zip(&self.ground).zip(own) {
            *below = (ground - own).clamp(-LOG_SPAN, LOG_SPAN);
        }
        let [lowest, highest] = HEIGHTS;
        for ((height, inverse), nearest) in height.iter_mut().zip(&self.inverse).zip(nearest) {
            *height = (1.0 - nearest * inverse).clamp(lowest, highest);
        }
    }

    /// [`DROP`] and [`RISE`] into `limits`, and into `aside` the logarithm of the nearest return's
    /// depth.
    fn reach(
        &mut self,
        completer: &Completer,
        sparse: &[f32],
        aside: &mut [f32],
        limits: &mut [f32],
    ) -> std::result::Result<(), SizeError> {
        for (logarithm, &depth) in self.logarithm.iter_mut().zip(sparse) {
            let is_return = depth > 0.0 && depth.is_finite();
            *logarithm = if is_return { depth.ln() } else { f32::NAN };
        }
        let (drop, rise) = limits.split_at_mut(sparse.len());
        self.surround.extremes(&self.logarithm, drop, rise)?;
        completer.spread(&self.logarithm, aside)?;
        // Windows without a return hold infinities of the sign that becomes 0.
        for ((drop, rise), own) in drop.iter_mut().zip(rise).zip(&*aside) {
            *drop = (own - *drop).max(0.0);
            *rise = (*rise - own).max(0.0);
        }
        Ok(())
    }
}

/// What the depth encoder sees of a batch, `[N, 3 or 7, H, W]`, and the nearest returns
/// `[N, 1, H, W]` in metres, on `device`, from `sparse` `[N, 1, H, W]` on any. Each of `grounds` is
/// that of an equal run of maps; none means nowhere known. Computed on the processor; no gradient
/// passes.
pub(crate) fn prefill(
    sparse: &Tensor,
    grounds: &[Option<Ground>],
    form: Form,
    range_m: f32,
    device: &Device,
) -> Result<(Tensor, Tensor)> {
    let (n, _, h, w) = sparse.dims4()?;
    let (area, planes) = (h * w, form.depth_channels());
    let values: Vec<f32> = sparse.flatten_all()?.to_vec1()?;
    let mut nearest = vec![0.0; n * area];
    let mut seen = vec![0.0; planes * n * area];
    if !grounds.is_empty() && !n.is_multiple_of(grounds.len()) {
        candle_core::bail!("{} grounds for {n} maps", grounds.len());
    }
    let of_map = |map: usize| grounds.get(map * grounds.len() / n)?.as_ref();
    let maps = values.par_chunks(area).zip(nearest.par_chunks_mut(area));
    maps.zip(seen.par_chunks_mut(planes * area))
        .enumerate()
        .try_for_each_init(
            || Prefill::new(form, h, w, range_m),
            |prefill, (map, ((sparse, nearest), seen))| match prefill {
                Ok(prefill) => {
                    prefill.stand_on(of_map(map));
                    prefill.fill(sparse, nearest, seen)
                }
                Err(error) => candle_core::bail!("{error}"),
            },
        )?;
    Ok((
        Tensor::from_vec(seen, (n, planes, h, w), device)?,
        Tensor::from_vec(nearest, (n, 1, h, w), device)?,
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn returns_are_kept_marked_and_trusted() {
        let mut sparse = vec![0.0_f32; 12];
        (sparse[0], sparse[11]) = (10.0, 40.0);
        let sparse = Tensor::from_vec(sparse, (1, 1, 3, 4), &Device::Cpu).unwrap();
        let (seen, nearest) = prefill(&sparse, &[], Form::Residual, 80.0, &Device::Cpu).unwrap();
        let nearest: Vec<f32> = nearest.flatten_all().unwrap().to_vec1().unwrap();
        assert_eq!(
            nearest,
            [10., 10., 10., 40., 10., 10., 40., 40., 10., 40., 40., 40.]
        );
        let seen: Vec<f32> = seen.flatten_all().unwrap().to_vec1().unwrap();
        assert_eq!((seen[0], seen[11]), (0.125, 0.5));
        let marked: Vec<usize> = (0..12).filter(|i| seen[12 + i] == 1.0).collect();
        assert_eq!(marked, [0, 11]);
        assert_eq!(seen[24], 1.0);
        assert_eq!(seen[25], (-0.125_f32).exp());
    }

    #[test]
    fn without_a_return_a_middling_depth_with_no_trust_stands_in() {
        let sparse = Tensor::zeros((2, 1, 2, 2), candle_core::DType::F32, &Device::Cpu).unwrap();
        let (seen, nearest) = prefill(&sparse, &[], Form::Residual, 80.0, &Device::Cpu).unwrap();
        let nearest: Vec<f32> = nearest.flatten_all().unwrap().to_vec1().unwrap();
        assert_eq!(nearest, [10.0; 8]);
        let seen: Vec<f32> = seen.flatten_all().unwrap().to_vec1().unwrap();
        let of_one = [0.125, 0.125, 0.125, 0.125, 0., 0., 0., 0., 0., 0., 0., 0.];
        assert_eq!(seen, [of_one, of_one].concat());
    }

    #[test]
    fn the_surroundings_say_how_much_nearer_and_farther_returns_reach() {
        let (width, height) = (40, 16);
        let mut sparse = vec![0.0_f32; width * height];
        (sparse[0], sparse[10], sparse[36]) = (10.0, 40.0, 5.0);
        let sparse = Tensor::from_vec(sparse, (1, 1, height, width), &Device::Cpu).unwrap();
        let (seen, _) = prefill(&sparse, &[], Form::Choice, 80.0, &Device::Cpu).unwrap();
        let seen: Vec<f32> = seen.flatten_all().unwrap().to_vec1().unwrap();
        let at = |plane: usize, x: usize, y: usize| seen[(plane * height + y) * width + x];
        let four = 4.0_f32.ln();
        assert_eq!(
            (at(DROP, 2, 0), at(RISE, 2, 0)),
            (0.0, four),
            "the far one reaches in"
        );
        assert_eq!(
            (at(DROP, 8, 12), at(RISE, 8, 12)),
            (four, 0.0),
            "the near one does"
        );
        assert_eq!(
            (at(DROP, 2, 13), at(RISE, 2, 13)),
            (0.0, 0.0),
            "13 rows below both"
        );
        let eight = 8.0_f32.ln();
        assert_eq!(
            (at(DROP, 22, 0), at(RISE, 22, 0)),
            (0.0, 0.0),
            "5 is 14 away: {eight}"
        );
        assert_eq!(
            (at(DROP, 24, 0), at(RISE, 24, 0)),
            (0.0, 0.0),
            "40 is 14 away"
        );
        let none = Tensor::zeros((1, 1, 16, 16), candle_core::DType::F32, &Device::Cpu).unwrap();
        let (seen, _) = prefill(&none, &[], Form::Choice, 80.0, &Device::Cpu).unwrap();
        let seen: Vec<f32> = seen.flatten_all().unwrap().to_vec1().unwrap();
        assert!(
            seen[DROP * 256..GROUND * 256]
                .iter()
                .all(|&limit| limit == 0.0)
        );
    }

    #[test]
    fn the_ground_is_told_against_the_nearest_return() {
        let (width, height) = (4, 4);
        let mut sparse = vec![0.0_f32; 2 * width * height];
        sparse[width * height] = 5.0; // in the second map alone
        let sparse = Tensor::from_vec(sparse, (2, 1, height, width), &Device::Cpu).unwrap();
        // At 10 m in row 2, at 5 m in row 3, the horizon in row 1.
        let ground = Ground {
            per_column: 0.0,
            per_row: 0.1,
            first: -0.1,
        };
        let plane = |which: usize, grounds: &[Option<Ground>]| -> Vec<f32> {
            let (seen, _) = prefill(&sparse, grounds, Form::Choice, 80.0, &Device::Cpu).unwrap();
            let rows = seen.narrow(1, which, 1).unwrap().narrow(3, 1, 1).unwrap();
            rows.flatten_all().unwrap().to_vec1().unwrap()
        };
        let told = |grounds: &[Option<Ground>]| plane(GROUND, grounds);
        let close = |found: &[f32], wanted: [f32; 4]| {
            let is_close = found.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 1e-5);
            assert!(is_close, "{found:?}, wanted {wanted:?}");
        };
        let both = told(&[Some(ground)]);
        // Without a return an eighth of the range stands in.
        close(&both[..4], [LOG_SPAN, LOG_SPAN, 0.0, -(2.0_f32.ln())]);
        close(&both[4..], [LOG_SPAN, LOG_SPAN, 2.0_f32.ln(), 0.0]);
        let second = told(&[None, Some(ground)]);
        close(&second[..4], [0.0; 4]);
        close(&second[4..], [LOG_SPAN, LOG_SPAN, 2.0_f32.ln(), 0.0]);
        close(&told(&[])[4..], [0.0; 4]);
        let high = plane(HEIGHT, &[Some(ground)]);
        close(&high[..4], [2.0, 1.0, 0.0, -1.0]);
        close(&high[4..], [1.5, 1.0, 0.5, 0.0]);
        close(&plane(HEIGHT, &[None, Some(ground)])[..4], [0.0; 4]);
        close(&plane(HEIGHT, &[])[4..], [0.0; 4]);
        // A camera of 1 m: heights of it beyond either end are cut.
        let low = Ground {
            per_row: 1.0,
            first: -1.0,
            ..ground
        };
        close(&plane(HEIGHT, &[Some(low)])[4..], [4.0, 1.0, -1.0, -1.0]);
        let odd = [Some(ground), None, None];
        assert!(prefill(&sparse, &odd, Form::Choice, 80.0, &Device::Cpu).is_err());
    }

    #[test]
    fn each_map_is_laid_on_its_own_road() {
        let (height, width) = (64, 48);
        let told = Ground::level(1.5, 200.0, 20.0).unwrap();
        let road = |rows: f32| {
            let truth = told.lowered(rows);
            let mut sparse = vec![0.0; height * width];
            for cell in (26 * width..54 * width).step_by(3) {
                sparse[cell] = 1.0 / truth.inverse_depth(0.0, (cell / width) as f32);
            }
            sparse
        };
        // A post says nothing of the road.
        let mut post = vec![0.0; height * width];
        (0..height).for_each(|row| post[row * width + 5] = 9.0);
        let seen = |prefill: &mut Prefill, sparse: &[f32]| {
            prefill.stand_on(Some(&told));
            let mut nearest = vec![0.0; height * width];
            let mut seen = vec![0.0; Form::Choice.depth_channels() * height * width];
            prefill.fill(sparse, &mut nearest, &mut seen).unwrap();
            seen
        };
        let fresh = || Prefill::new(Form::Choice, height, width, 80.0).unwrap();
        let mut used = fresh();
        for sparse in [road(3.0), road(-2.0), post, road(3.0), road(0.0)] {
            assert!(
                seen(&mut used, &sparse) == seen(&mut fresh(), &sparse),
                "a map is seen as the one before it left the road"
            );
        }
        let ground = GROUND * height * width..;
        let (lower, own) = (seen(&mut used, &road(3.0)), seen(&mut used, &road(0.0)));
        assert_ne!(lower[ground.clone()], own[ground], "the maps differ");
    }
}

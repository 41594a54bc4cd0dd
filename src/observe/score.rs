//! Depth against truth, beside the two completions that need no network.

use noctule_depth::{Completer, edge_band, masked_mae, metrics};
use noctule_recording::{ExposureTruth, Recording, RecordingError};
use serde::Serialize;

use super::record::Kept;
use crate::frame::BundleHeader;

/// Nearest depth that counts, metres.
const DEPTH_M_MIN: f32 = 0.1;

/// Mean errors of one method over all scored maps.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MethodScore {
    /// Which method.
    pub method: String,
    /// Maps scored.
    pub maps: u64,
    /// Root mean square error, millimetres.
    pub rmse_mm: f64,
    /// Mean absolute error, millimetres.
    pub mae_mm: f64,
    /// Root mean square error of inverse depth, 1/km.
    pub irmse_per_km: f64,
    /// Mean absolute relative error.
    pub rel: f64,
    /// Share of pixels within a factor of 1.25, percent.
    pub delta1_pct: f64,
    /// Mean absolute error within 5 px of depth jumps, millimetres.
    pub edge_mae_mm: f64,
}

/// Scores of a run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Scores {
    /// Exposures that truth was found for.
    pub exposures: u64,
    /// Exposures kept, without truth of their own.
    pub without_truth: u64,
    /// One row per method: what ran, nearest, fill.
    pub methods: Vec<MethodScore>,
}

#[derive(Default)]
struct Sum {
    maps: u64,
    values: [f64; 5],
    edge: (f64, u64),
}

impl Sum {
    fn add(&mut self, pred: &[f32], gt: &[f32], band: &[bool], cap: f32) {
        let Ok(m) = metrics(pred, gt, DEPTH_M_MIN, cap) else {
            return;
        };
        self.maps += 1;
        for (sum, value) in
            self.values
                .iter_mut()
                .zip([m.rmse_mm, m.mae_mm, m.irmse_per_km, m.rel, m.delta1_pct])
        {
            *sum += value;
        }
        if let Ok(Some(edge)) = masked_mae(pred, gt, band, DEPTH_M_MIN, cap) {
            self.edge.0 += edge.mae_mm;
            self.edge.1 += 1;
        }
    }

    #[expect(clippy::cast_precision_loss, reason = "counts of maps")]
    fn finish(self, method: &str) -> MethodScore {
        let [rmse_mm, mae_mm, irmse_per_km, rel, delta1_pct] =
            self.values.map(|v| v / self.maps.max(1) as f64);
        MethodScore {
            method: method.to_owned(),
            maps: self.maps,
            rmse_mm,
            mae_mm,
            irmse_per_km,
            rel,
            delta1_pct,
            edge_mae_mm: self.edge.0 / self.edge.1.max(1) as f64,
        }
    }
}

/// The true exposure that a bundle shows: the one whose middle lies in it.
#[must_use]
pub fn truth_of<'a>(kept: &Kept, truths: &'a [ExposureTruth]) -> Option<&'a ExposureTruth> {
    truth_at(&kept.header, truths)
}

/// As [`truth_of`], from the bundle's header alone.
#[must_use]
pub fn truth_at<'a>(
    header: &BundleHeader,
    truths: &'a [ExposureTruth],
) -> Option<&'a ExposureTruth> {
    let middle = |open: u64, close: u64| open + close.saturating_sub(open) / 2;
    let (open, close) = (header.open_tai_ns, header.close_tai_ns);
    truths.iter().find(|t| {
        let centre = middle(t.open_tai.as_nanos(), t.close_tai.as_nanos());
        (open..close).contains(&centre)
    })
}

/// Scores every kept exposure that the recording has truth for; `None` without any truth.
///
/// # Errors
/// When truth is there and cannot be read.
pub fn score<'a>(
    recording: &Recording,
    kept: impl Iterator<Item = &'a Kept>,
    cap_m: f32,
) -> Result<Option<Scores>, RecordingError> {
    let Ok(truths) = recording.exposures_truth() else {
        return Ok(None);
    };
    let truths: Vec<ExposureTruth> = truths.collect::<Result<_, _>>()?;
    let samples = recording.samples()?;
    let (mut model, mut nearest, mut fill) = (Sum::default(), Sum::default(), Sum::default());
    let (mut exposures, mut without_truth) = (0, 0);
    let mut model_name = String::new();
    for kept in kept {
        let truth = truth_of(kept, &truths).filter(|t| samples.contains(&t.index));
        let Some(truth) = truth else {
            without_truth += 1;
            continue;
        };
        let sample = recording.sample_truth(truth.index)?;
        let (width, height) = (kept.header.width as usize, kept.header.height as usize);
        let Ok(mut completer) = Completer::new(width, height) else {
            continue;
        };
        let size = completer.size();
        let plane = width * height;
        let (mut map, mut aside, mut band) =
            (vec![0.0; plane], vec![0.0; plane], vec![false; plane]);
        exposures += 1;
        for (&step, (header, depth)) in &kept.depth {
            let gt = sample.gt(step + 1)?;
            if gt.data.len() != plane || edge_band(&gt.data, size, &mut band).is_err() {
                continue;
            }
            model.add(depth, &gt.data, &band, cap_m);
            model_name = crate::frame::ModelId::from_u32(header.model)
                .map_or("unknown", crate::frame::ModelId::name)
                .to_owned();
            let sparse = &kept.sparse[step as usize * plane..][..plane];
            if completer.nearest(sparse, &mut map, &mut aside).is_ok() {
                nearest.add(&map, &gt.data, &band, cap_m);
            }
            if completer.fill(sparse, &mut map, &mut aside).is_ok() {
                fill.add(&map, &gt.data, &band, cap_m);
            }
        }
    }
    let methods = vec![
        model.finish(&format!("this run ({model_name})")),
        nearest.finish("nearest"),
        fill.finish("fill"),
    ];
    Ok(Some(Scores {
        exposures,
        without_truth,
        methods,
    }))
}

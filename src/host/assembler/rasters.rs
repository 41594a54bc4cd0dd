//! The planes of a bundle: voxels as events pass, sparse depth as passes end, the image as it comes.

use noctule_raster::{
    EgoPolicy, EventHistory, Exposure as RasterExposure, Grid, ImagePlanes, ImageView, Retimed,
    Samples, SparseRaster, VoxelRaster,
};
use noctule_sensor::{Evk4, Stamp, Tai};

use super::{Assembler, SETTLED_NS, STRAGGLE_US};
use crate::frame::{BundleLayout, STEPS_MAX};
use crate::host::bay::{Berth, Times};
use crate::host::blocks::ImageBlock;
use crate::host::outlet::{Outlet, Slot};
use crate::host::report::RasterReport;
use crate::sync::{BundleDecision, MapSource, Timeline};

impl<O: Outlet> Assembler<O> {
    /// Rasters new events of the open exposure.
    pub(super) fn advance_voxels(&mut self) {
        let Some(id) = self.rastering else { return };
        if let (Some(voxels), Some(berth)) = (&mut self.voxels, self.bay.get(id))
            && berth.voxels.is_none()
            && let Some(planes) = berth.slot.planes(&self.layout)
        {
            // Fails only for memory of another size, which a slot never has.
            let _ = voxels.advance(&self.history, planes.voxels);
        }
    }

    /// Finishes the voxels of closed exposures whose events are all here.
    pub(super) fn finish_passed_voxels(&mut self) {
        let (Some(voxels), Some(passed)) = (&mut self.voxels, self.events_passed) else {
            return;
        };
        for berth in self.bay.iter_mut() {
            if berth.voxels.is_none() && berth.close.is_some_and(|close| close <= passed) {
                let was_open = self.rastering == Some(berth.id);
                finish_voxels(
                    voxels,
                    &self.history,
                    &self.layout,
                    berth,
                    was_open,
                    &mut self.raster,
                );
                self.rastering = self.rastering.filter(|_| !was_open);
            }
        }
    }

    /// Finishes the exposure under way when the next one opens: every event of it that precedes
    /// this edge in the stream is here, and none follows that far behind.
    pub(super) fn finish_voxels_before(&mut self, open: Stamp<Evk4>) {
        let Some(id) = self.rastering else { return };
        let (Some(voxels), Some(berth)) = (&mut self.voxels, self.bay.get(id)) else {
            return;
        };
        let straggle_ns = i64::try_from(STRAGGLE_US * 1000).unwrap_or(i64::MAX);
        if berth
            .close
            .is_some_and(|close| close.offset_nanos(straggle_ns) <= open)
        {
            finish_voxels(
                voxels,
                &self.history,
                &self.layout,
                berth,
                true,
                &mut self.raster,
            );
            self.rastering = None;
        }
    }

    pub(super) fn draw_passed_sparse(&mut self, passed: Stamp<Tai>) {
        let Some(sparse) = &mut self.sparse else {
            return;
        };
        for berth in self.bay.iter_mut() {
            if berth.close.is_none() || berth.sparse_drawn {
                continue;
            }
            if berth.times.is_none() {
                berth.times = times(&self.timeline, &self.layout, berth);
            }
            if berth.times.is_some_and(|t| t.close <= passed) {
                draw_sparse(sparse, &self.layout, berth, &mut self.raster);
                berth.inputs_received_ns = berth.inputs_received_ns.max(self.received_ns);
            }
        }
    }

    /// Rasters what is still missing of a bundle that goes out now.
    pub(super) fn complete(
        &mut self,
        berth: &mut Berth<O::Slot>,
        decision: &BundleDecision,
        was_open: bool,
    ) {
        let exposure = &decision.exposure;
        if (berth.open, berth.close) != (exposure.open, Some(exposure.close)) {
            (berth.open, berth.close) = (exposure.open, Some(exposure.close));
            (berth.times, berth.sparse_drawn) = (None, false);
        }
        if let Some(voxels) = &mut self.voxels
            && berth.voxels != Some((exposure.open, exposure.close))
        {
            let was_open = was_open && berth.voxels.is_none();
            finish_voxels(
                voxels,
                &self.history,
                &self.layout,
                berth,
                was_open,
                &mut self.raster,
            );
            // A raster of another exposure that was under way has been abandoned for this one.
            self.rastering = None;
        }
        if berth.times.is_none() {
            berth.times = times(&self.timeline, &self.layout, berth);
        }
        if let (Some(sparse), false) = (&mut self.sparse, berth.sparse_drawn) {
            draw_sparse(sparse, &self.layout, berth, &mut self.raster);
        }
    }
}

pub(super) fn first_event(history: &EventHistory, open: Stamp<Evk4>) -> u64 {
    let from = open.as_micros().saturating_sub(STRAGGLE_US);
    // Packed times are the low 32 bits.
    #[expect(clippy::cast_possible_truncation, reason = "packed times wrap")]
    history.first_since(from as u32)
}

pub(super) fn write_image(
    writer: &ImagePlanes,
    size: Grid,
    image: &ImageBlock,
    out: &mut [f32],
) -> bool {
    let view = ImageView {
        data: &image.rgb,
        size,
        stride_bytes: size.width as usize * 3,
        samples: Samples::U8,
    };
    writer.write(&view, out).is_ok()
}

/// Steps of a berth's exposure on TAI, as the clocks say now.
fn times<L>(timeline: &Timeline, layout: &BundleLayout, berth: &Berth<L>) -> Option<Times> {
    let (map, source) = timeline.evk4_to_tai()?;
    let close = berth.close?;
    let width = close.diff_nanos(berth.open);
    let steps = i64::try_from(layout.steps).unwrap_or(1);
    let mut centres = [Stamp::ZERO; STEPS_MAX];
    for (k, centre) in (0..steps).zip(&mut centres) {
        *centre = map.apply(berth.open.offset_nanos(width * (2 * k + 1) / (2 * steps)));
    }
    let uncertainty_ns = map
        .uncertainty_at(berth.open)
        .max(map.uncertainty_at(close));
    Some(Times {
        open: map.apply(berth.open),
        close: map.apply(close),
        centres,
        uncertainty_ns,
        is_settled: source == MapSource::Offset || uncertainty_ns <= SETTLED_NS,
    })
}

fn draw_sparse<L: Slot>(
    sparse: &mut SparseRaster,
    layout: &BundleLayout,
    berth: &mut Berth<L>,
    report: &mut RasterReport,
) {
    let Some(times) = berth.times else { return };
    let Some(planes) = berth.slot.planes(layout) else {
        return;
    };
    berth.sparse_drawn = true;
    (berth.returns, berth.has_pass, berth.has_motion) = (0, false, true);
    for (centre, out) in times
        .centres
        .iter()
        .zip(planes.sparse.chunks_exact_mut(layout.plane()))
    {
        let moved = sparse.draw(*centre, EgoPolicy::Compensate, out);
        let drawn = match moved {
            Ok(drawn) => Some(drawn),
            Err(_) => {
                berth.has_motion = false;
                report.steps_without_motion += 1;
                sparse.draw(*centre, EgoPolicy::Still, out).ok()
            }
        };
        match drawn {
            Some(drawn) if drawn.pass.is_some() => {
                berth.has_pass = true;
                berth.returns += drawn.drawn;
            }
            _ => report.steps_without_pass += 1,
        }
    }
}

fn finish_voxels<L: Slot>(
    voxels: &mut VoxelRaster,
    history: &EventHistory,
    layout: &BundleLayout,
    berth: &mut Berth<L>,
    was_open: bool,
    report: &mut RasterReport,
) {
    let Some(close) = berth.close else { return };
    let Some(planes) = berth.slot.planes(layout) else {
        return;
    };
    let out = planes.voxels;
    let Ok(exposure) = RasterExposure::new(berth.open, close) else {
        out.fill(0.0);
        berth.voxels = Some((berth.open, close));
        return;
    };
    if !was_open {
        voxels.begin(exposure, first_event(history, berth.open));
    }
    match voxels.finish(exposure, history, out) {
        Ok(done) => {
            match done.retimed {
                Retimed::Exact if was_open => report.exact += 1,
                Retimed::Delta { .. } => report.delta += 1,
                _ => report.full += 1,
            }
            report.events += done.tally.rastered;
            report.events_forgotten += done.forgotten;
            berth.events = done.tally.rastered;
            berth.events_outside = done.tally.outside_grid;
            berth.events_forgotten = done.forgotten;
        }
        // More events in a step than a sum can hold: nothing of it can be trusted.
        Err(_) => out.fill(0.0),
    }
    berth.voxels = Some((berth.open, close));
}

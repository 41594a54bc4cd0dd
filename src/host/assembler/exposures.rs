//! What happens to a bundle under way as its exposure opens, closes and gets its image.

use noctule_raster::Exposure as RasterExposure;
use noctule_sensor::{Evk4, Realtime, Stamp};

use super::rasters::{first_event, write_image};
use super::{Assembler, FIRST_WIDTH_NS};
use crate::host::outlet::{Outlet, Slot};
use crate::sync::ExposureEvent;

impl<O: Outlet> Assembler<O> {
    /// Acts on what the exposure source said.
    pub(super) fn hear(&mut self, now: Stamp<Realtime>) {
        let mut index = 0;
        while let Some(&event) = self.said.get(index) {
            index += 1;
            match event {
                ExposureEvent::Opened {
                    id,
                    open,
                    close_predicted,
                    ..
                } => {
                    self.opened(id, open, close_predicted);
                }
                ExposureEvent::Closed(exposure) => {
                    if let Some(berth) = self.bay.get(exposure.id) {
                        (berth.open, berth.close) = (exposure.open, Some(exposure.close));
                        berth.close_received_ns = self.received_ns;
                        berth.inputs_received_ns = self.received_ns;
                    }
                    // The next exposure may open within the same transfer.
                    self.finish_passed_voxels();
                }
                ExposureEvent::Imaged { exposure, pair } => {
                    if let Some(pair) = pair {
                        self.timeline.strobe_pair(pair.edge, pair.driver);
                    }
                    self.imaged(exposure.id, exposure.open, exposure.close, exposure.image);
                }
                ExposureEvent::ImageMissing(exposure) => {
                    if let Some(berth) = self.bay.get(exposure.id) {
                        (berth.open, berth.close) = (exposure.open, Some(exposure.close));
                    }
                }
                ExposureEvent::Discarded { id, .. } => {
                    self.bundles.discarded += 1;
                    self.rastering = self.rastering.filter(|&r| r != id);
                    drop(self.bay.take(id));
                }
                ExposureEvent::ImageLeftOut { sequence, .. } => {
                    self.bundles.images_left_out += 1;
                    self.release(sequence);
                }
            }
            let map = self.timeline.evk4_to_tai().map(|(map, _)| map);
            self.closer
                .exposure(&event, map.as_ref(), now, &mut |d| self.decided.push(d));
        }
        self.said.clear();
    }

    pub(super) fn opened(
        &mut self,
        id: u64,
        open: Stamp<Evk4>,
        close_predicted: Option<Stamp<Evk4>>,
    ) {
        self.bundles.exposures += 1;
        self.finish_voxels_before(open);
        if self.bay.is_full() {
            self.bundles.without_memory += 1;
            return;
        }
        let Some(slot) = self.outlet.lend() else {
            self.bundles.without_memory += 1;
            return;
        };
        let close = close_predicted.unwrap_or_else(|| open.offset_nanos(FIRST_WIDTH_NS));
        if let (Some(voxels), Ok(predicted)) = (&mut self.voxels, RasterExposure::new(open, close))
        {
            voxels.begin(predicted, first_event(&self.history, open));
            self.rastering = Some(id);
        }
        self.bay.add(id, slot, open);
    }

    pub(super) fn imaged(
        &mut self,
        id: u64,
        open: Stamp<Evk4>,
        close: Stamp<Evk4>,
        image: Option<u64>,
    ) {
        let Some(sequence) = image else { return };
        let lease = self
            .images
            .iter()
            .position(|i| u64::from(i.stamp.sequence) == sequence);
        if let Some(berth) = self.bay.get(id) {
            if berth.close != Some(close) || berth.open != open {
                berth.times = None;
                berth.sparse_drawn = false;
            }
            (berth.open, berth.close) = (open, Some(close));
            berth.inputs_received_ns = berth.inputs_received_ns.max(self.received_ns);
            if let (Some((writer, size)), Some(lease), Some(planes)) =
                (&self.planes, lease, berth.slot.planes(&self.layout))
                && write_image(writer, *size, &self.images[lease], planes.image)
            {
                berth.image = u32::try_from(sequence).ok();
                self.bundles.images_matched += 1;
            }
        }
        self.release(sequence);
    }

    pub(super) fn release(&mut self, sequence: u64) {
        if let Some(index) = self
            .images
            .iter()
            .position(|i| u64::from(i.stamp.sequence) == sequence)
        {
            let image = self.images.remove(index);
            self.returned.push(image);
        }
    }
}

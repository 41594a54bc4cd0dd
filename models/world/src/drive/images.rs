//! The camera's pictures, and the truth of each exposure on the network's grid.

use noctule_camera::FrameStamp;
use noctule_recording::{RecordingWriter, SampleWriter, TruthWriter, WriteError};
use rayon::prelude::*;

use super::DriveOptions;
use super::lidar::LidarStream;
use crate::camera::{Camera, FULL_WELL, Light};
use crate::error::WorldError;
use crate::optics::Optics;
use crate::render::{Frame, render};
use crate::sample::{Truth, accumulate};
use crate::scene::Scene;
use crate::shutter::{Opening, STEPS};
use crate::snapshot::{Horizon, Snapshot};
use crate::timeline::{TimedExposure, Timeline, tai};

/// Gathers light while the shutter is open, and develops it when it closes.
pub(super) struct ImageStream<'a> {
    scene: &'a Scene,
    camera: Camera,
    size: usize,
    grid: Optics,
    mean: Light,
    images: Vec<(u32, FrameStamp)>,
}

impl<'a> ImageStream<'a> {
    pub(super) fn new(options: &DriveOptions, scene: &'a Scene, timeline: &Timeline) -> Self {
        let mut images: Vec<_> = timeline
            .images
            .iter()
            .map(|i| (i.exposure, i.stamp))
            .collect();
        images.reverse();
        Self {
            scene,
            camera: Camera::new(options.seed),
            size: options.rig.size,
            grid: Optics::new(options.rig.grid),
            mean: Frame::new(options.rig.size).rgb,
            images,
        }
    }

    /// Adds `share` of a frame to the open exposure.
    pub(super) fn gather(&mut self, frame: &Frame, share: f32) {
        accumulate(&mut self.mean, &frame.rgb, share);
    }

    /// Ends the exposure: writes its image, if it reached the host, and its truth.
    pub(super) fn develop(
        &mut self,
        timed: &TimedExposure,
        lidar: &mut LidarStream<'_>,
        recording: &mut RecordingWriter,
        truth: &mut TruthWriter,
    ) -> Result<(), WorldError> {
        let opening = timed.opening;
        let electrons = Camera::expose(&self.mean, self.size, opening.seconds());
        self.mean.iter_mut().for_each(|plane| plane.fill(0.0));
        let white = self.camera.white(&electrons);
        let planes = self
            .camera
            .develop(&electrons, white, self.size, opening.index);
        if self
            .images
            .last()
            .is_some_and(|(exposure, _)| *exposure == timed.truth.index)
            && let Some((_, stamp)) = self.images.pop()
        {
            let gain_db = 20.0 * (FULL_WELL / white).log10();
            let rgb8 = interleave(&planes, self.size);
            recording.image(FrameStamp { gain_db, ..stamp }, self.size, self.size, &rgb8)?;
        }
        truth.exposure(&timed.truth)?;
        let blur = halve(&planes, self.size, self.grid.size);
        self.write_truth(
            &opening,
            white,
            &blur,
            lidar,
            &truth.sample(timed.truth.index)?,
        )
    }

    fn write_truth(
        &self,
        opening: &Opening,
        white: f32,
        blur: &[u8],
        lidar: &mut LidarStream<'_>,
        writer: &SampleWriter,
    ) -> Result<(), WorldError> {
        let side = self.grid.size;
        let steps: Vec<Frame> = (0..STEPS)
            .map(|k| {
                let mut frame = Frame::new(side);
                let snapshot = Snapshot::new(self.scene, opening.step_centre(k), Horizon::CAMERA);
                render(self.scene, &snapshot, &self.grid, &mut frame);
                frame
            })
            .collect();
        let all = Truth::of_steps(self.scene, opening, &self.grid, &steps, white);
        let centres = (0..STEPS).map(|k| tai((opening.step_centre(k) * 1e9).round() as u64));
        let sparse = lidar.sparse(centres)?;
        writer.blur(side, side, blur)?;
        let cells = side * side;
        (0..STEPS).into_par_iter().try_for_each(|k| {
            let step = k as u32 + 1;
            let mask = |all: &[u8]| -> Vec<bool> {
                all[k * cells..][..cells].iter().map(|&m| m != 0).collect()
            };
            writer.gt(step, side, side, &all.depth[k * cells..][..cells])?;
            writer.sparse(step, side, side, &sparse[k * cells..][..cells])?;
            writer.sharp(
                step,
                side,
                side,
                &interleave(&all.sharp[k * 3 * cells..][..3 * cells], side),
            )?;
            writer.mover(step, side, side, &mask(&all.movers))?;
            writer.thin(step, side, side, &mask(&all.thin))?;
            if k + 1 < STEPS {
                writer.flow(step, side, side, &all.flow[k * 2 * cells..][..2 * cells])?;
            }
            Ok::<(), WriteError>(())
        })?;
        Ok(())
    }
}

/// `[3, H, W]` to packed pixels.
fn interleave(planes: &[u8], size: usize) -> Vec<u8> {
    let cells = size * size;
    (0..cells)
        .flat_map(|i| [planes[i], planes[cells + i], planes[2 * cells + i]])
        .collect()
}

/// The picture on the network's grid, packed: each pixel the mean of those it covers.
fn halve(planes: &[u8], size: usize, side: usize) -> Vec<u8> {
    let factor = size / side;
    let mut out = Vec::with_capacity(3 * side * side);
    for y in 0..side {
        for x in 0..side {
            for c in 0..3 {
                let mut sum = 0;
                for dy in 0..factor {
                    let row = (c * size + y * factor + dy) * size + x * factor;
                    sum += planes[row..row + factor]
                        .iter()
                        .map(|&p| usize::from(p))
                        .sum::<usize>();
                }
                out.push(((sum + factor * factor / 2) / (factor * factor)) as u8);
            }
        }
    }
    out
}

//! One contact sheet per exposure: what went in, what came out, how wrong it is.

use std::path::Path;

use noctule_depth::{
    Canvas, ContactSheet, DepthPngError, Legend, PictureError, PngError, Scale, Size, SizeError,
    depth_to_rgb, error_to_rgb, events_to_rgb, save_depth_png16, sparse_to_rgb,
};
use noctule_recording::SampleTruth;

use super::record::Kept;
use crate::frame::{ModelId, flag};

/// Error that the colour scale's ends stand for, metres.
const ERROR_M_FULL: f32 = 5.0;
/// Voxel sum that the event colours' ends stand for.
const EVENTS_FULL: f32 = 0.5;

/// Why a sheet could not be drawn.
#[derive(Debug, thiserror::Error)]
pub enum SheetError {
    /// The picture.
    #[error(transparent)]
    Picture(#[from] PictureError),
    /// The file.
    #[error(transparent)]
    Png(#[from] PngError),
    /// A depth map's file.
    #[error(transparent)]
    Depth(#[from] DepthPngError),
    /// A plane of the wrong size.
    #[error(transparent)]
    Size(#[from] SizeError),
    /// A folder.
    #[error("{path}: {cause}")]
    Folder {
        /// Which.
        path: std::path::PathBuf,
        /// Why.
        cause: std::io::Error,
    },
}

/// Draws one exposure; with `truth`, errors too.
///
/// # Errors
/// When the picture cannot be drawn or written.
pub fn draw_sheet(kept: &Kept, truth: Option<&SampleTruth>, path: &Path) -> Result<(), SheetError> {
    let header = &kept.header;
    let size = Size::new(header.width as usize, header.height as usize)?;
    let scale = Scale::DRIVE;
    let mut sheet = ContactSheet::new(
        &format!("exposure {}", header.sequence),
        size.width(),
        size.height(),
        1,
    )?;
    sheet.note(&note(kept));
    let plane = size.pixels();
    let tile = |paint: &mut dyn FnMut(&mut [u8]) -> Result<(), SizeError>| {
        let mut canvas = Canvas::new(size.width(), size.height(), [0, 0, 0])?;
        paint(canvas.rgb_mut())?;
        Ok::<_, SheetError>(canvas)
    };
    let at = |planes: &[f32], step: usize| planes[step * plane..][..plane].to_vec();
    let steps = header.steps as usize;

    sheet.row("blurred image, events of the whole exposure");
    sheet.tile(
        "image",
        tile(&mut |rgb| {
            image_to_rgb(&kept.image, rgb);
            Ok(())
        })?,
    )?;
    let all = tile(&mut |rgb| events_to_rgb(&kept.events, steps, 2.0 * EVENTS_FULL, rgb))?;
    sheet.tile("events", all)?;
    if let Some(sharp) = truth.and_then(|t| t.sharp(header.steps).ok()) {
        let fits = sharp.data.len() == 3 * plane;
        if fits {
            sheet.tile(
                "true image, last step",
                Canvas::from_rgb(size.width(), size.height(), sharp.data)?,
            )?;
        }
    }

    sheet.row("events per step");
    for step in 0..steps {
        let events = at(&kept.events, step);
        sheet.tile(
            &label(kept, step),
            tile(&mut |rgb| events_to_rgb(&events, 1, EVENTS_FULL, rgb))?,
        )?;
    }
    sheet.row("sparse depth per step");
    for step in 0..steps {
        let sparse = at(&kept.sparse, step);
        let returns = sparse.iter().filter(|&&d| d > 0.0).count();
        let canvas = tile(&mut |rgb| sparse_to_rgb(&sparse, size, 1, scale, rgb))?;
        sheet.tile(&format!("{returns} returns"), canvas)?;
    }
    sheet.row("dense depth per step");
    for (step, (depth_header, depth)) in &kept.depth {
        let model = ModelId::from_u32(depth_header.model).map_or("unknown", ModelId::name);
        let canvas = tile(&mut |rgb| depth_to_rgb(depth, scale, rgb))?;
        sheet.tile(&format!("step {} ({model})", step + 1), canvas)?;
    }
    if let Some(truth) = truth {
        let maps: Vec<_> = kept
            .depth
            .iter()
            .filter_map(|(step, (_, depth))| {
                let gt = truth
                    .gt(step + 1)
                    .ok()
                    .filter(|gt| gt.data.len() == plane)?;
                Some((*step, depth, gt.data))
            })
            .collect();
        sheet.row("true depth per step");
        for (step, _, gt) in &maps {
            let canvas = tile(&mut |rgb| depth_to_rgb(gt, scale, rgb))?;
            sheet.tile(&format!("step {}", step + 1), canvas)?;
        }
        sheet.row("error per step");
        for (_, depth, gt) in &maps {
            let canvas = tile(&mut |rgb| error_to_rgb(depth, gt, ERROR_M_FULL, rgb))?;
            sheet.tile(&mae(depth, gt), canvas)?;
        }
        sheet.legend(Legend::error(ERROR_M_FULL));
    }
    sheet.legend(Legend::depth(scale));
    sheet.legend(Legend::events());
    sheet.render()?.save_png(path)?;
    Ok(())
}

/// Writes an exposure's depth maps as 16-bit PNG (metres times 256), one file per step.
///
/// # Errors
/// When the folder or a file cannot be written.
pub fn write_depth(kept: &Kept, folder: &Path) -> Result<(), SheetError> {
    let folder = folder.join(format!("{:06}", kept.header.sequence));
    std::fs::create_dir_all(&folder).map_err(|cause| SheetError::Folder {
        path: folder.clone(),
        cause,
    })?;
    let (width, height) = (kept.header.width as usize, kept.header.height as usize);
    for (step, (_, depth)) in &kept.depth {
        save_depth_png16(
            folder.join(format!("{}.png", step + 1)),
            width,
            height,
            depth,
        )?;
    }
    Ok(())
}

fn note(kept: &Kept) -> String {
    let header = &kept.header;
    #[expect(clippy::cast_precision_loss, reason = "shown with one decimal")]
    let width_ms = header.close_tai_ns.saturating_sub(header.open_tai_ns) as f64 / 1e6;
    #[expect(clippy::cast_precision_loss, reason = "shown with one decimal")]
    let bound_us = header.uncertainty_ns as f64 / 1e3;
    let names = flag::names(header.flags);
    let flags = if names.is_empty() {
        "none".to_owned()
    } else {
        names.join(" ")
    };
    format!(
        "{width_ms:.1} ms, {} events, {} returns, times within {bound_us:.1} us, flags: {flags}",
        header.events, header.returns
    )
}

fn label(kept: &Kept, step: usize) -> String {
    let header = &kept.header;
    #[expect(clippy::cast_precision_loss, reason = "shown with one decimal")]
    let ms = header.step_tai_ns[step].saturating_sub(header.open_tai_ns) as f64 / 1e6;
    format!("step {} at {ms:.1} ms", step + 1)
}

fn mae(depth: &[f32], gt: &[f32]) -> String {
    noctule_depth::metrics(depth, gt, 0.1, 80.0).map_or_else(
        |_| "no truth".to_owned(),
        |m| format!("mean {:.2} m", m.mae_mm / 1e3),
    )
}

fn image_to_rgb(planes: &[f32], rgb: &mut [u8]) {
    let plane = planes.len() / 3;
    for (i, pixel) in rgb.chunks_exact_mut(3).enumerate() {
        for (c, value) in pixel.iter_mut().enumerate() {
            // Clamped to a byte.
            #[expect(
                clippy::cast_possible_truncation,
                clippy::cast_sign_loss,
                reason = "clamped"
            )]
            let byte = (planes[c * plane + i].clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
            *value = byte;
        }
    }
}

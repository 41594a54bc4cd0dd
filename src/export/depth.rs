//! Depth maps to pictures: in colour, or in 16 bits as the KITTI depth benchmark stores them.

use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};

use noctule_depth::{
    Canvas, DepthImage, DepthPngError, Scale, depth_to_rgb, load_depth_png16, write_depth_png16,
};
use noctule_recording::{Recording, SampleTruth};

use super::output::Output;
use super::{ExportError, Exported, Request, Stream, Target};
use crate::inspect::{InspectError, Kind};

/// How a depth map is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum DepthFormat {
    /// RGB of 8 bits: near light, far dark, nothing grey.
    #[default]
    Colour,
    /// Grey of 16 bits: metres times 256, 0 where there is nothing.
    Png16,
}

/// Which depth of a synthetic recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Layer {
    /// The true depth of every step.
    #[default]
    Truth,
    /// What the LiDAR saw, moved to every step.
    Sparse,
}

/// How depth is exported.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthOptions {
    /// The pictures.
    pub format: DepthFormat,
    /// Which depth of a recording.
    pub layer: Layer,
    /// Depths at the two ends of the colours, metres.
    pub near_m: f32,
    /// As above.
    pub far_m: f32,
}

impl Default for DepthOptions {
    fn default() -> Self {
        Self {
            format: DepthFormat::Colour,
            layer: Layer::Truth,
            near_m: Scale::DRIVE.near_m(),
            far_m: Scale::DRIVE.far_m(),
        }
    }
}

/// One map to be: where it comes from, and the name it gets in a folder.
enum Map {
    File {
        path: PathBuf,
        name: OsString,
    },
    Step {
        truth: SampleTruth,
        step: u32,
        name: OsString,
    },
}

impl Map {
    fn file(path: PathBuf) -> Self {
        let name = path.file_name().unwrap_or_default().to_owned();
        Self::File { path, name }
    }

    const fn name(&self) -> &OsString {
        match self {
            Self::File { name, .. } | Self::Step { name, .. } => name,
        }
    }

    fn read(&self, layer: Layer) -> Result<DepthImage, ExportError> {
        let picture = match (self, layer) {
            (Self::File { path, .. }, _) => return Ok(load_depth_png16(path)?),
            (Self::Step { truth, step, .. }, Layer::Truth) => truth.gt(*step)?,
            (Self::Step { truth, step, .. }, Layer::Sparse) => truth.sparse(*step)?,
        };
        Ok(DepthImage {
            width: picture.width,
            height: picture.height,
            depth_m: picture.data,
        })
    }
}

pub(super) fn export(
    request: &Request,
    target: Target,
    progress: &dyn Fn(u64),
) -> Result<Exported, ExportError> {
    let DepthOptions { near_m, far_m, .. } = request.depth;
    let scale = Scale::log(near_m, far_m)?;
    let maps = maps(&request.from)?;
    let to = &request.to;
    match target {
        Target::Png if maps.len() > 1 => {
            let (path, maps) = (to.clone(), maps.len());
            return Err(ExportError::NeedsFolder { path, maps });
        }
        Target::Png => {}
        Target::Folder => fs::create_dir_all(to).map_err(ExportError::output(to))?,
        Target::Csv | Target::Npy | Target::Pcd => {
            let (path, stream) = (to.clone(), Stream::Depth);
            return Err(ExportError::Unsuitable {
                path,
                target,
                stream,
            });
        }
    }
    for map in &maps {
        let path = if target == Target::Png {
            to.clone()
        } else {
            to.join(map.name())
        };
        if let Map::File { path: from, .. } = map {
            refuse_same(from, &path)?;
            progress(fs::metadata(from).map_or(0, |m| m.len()));
        }
        let image = map.read(request.depth.layer)?;
        write(&image, &path, request.depth.format, scale)?;
    }
    Ok(Exported {
        written: maps.len() as u64,
        unit: "depth maps",
        undecoded: Vec::new(),
        faults: Vec::new(),
    })
}

/// The maps of a source, in order; at least one.
fn maps(from: &Path) -> Result<Vec<Map>, ExportError> {
    let no_maps = || ExportError::NoMaps {
        path: from.to_owned(),
    };
    if !from.is_dir() {
        if is_png(from) {
            return Ok(vec![Map::file(from.to_owned())]);
        }
        // Says what is wrong with a file that is not there or empty.
        Kind::of(from)?;
        return Err(no_maps());
    }
    let maps = if from.join("meta.json").is_file() {
        steps(from)?
    } else {
        files(from)?
    };
    if maps.is_empty() {
        Err(no_maps())
    } else {
        Ok(maps)
    }
}

/// Every step of every sample of a recording.
fn steps(dir: &Path) -> Result<Vec<Map>, ExportError> {
    let recording = Recording::open(dir)?;
    let mut maps = Vec::new();
    for sample in recording.samples()? {
        let truth = recording.sample_truth(sample)?;
        maps.extend((1..=recording.meta().steps).map(|step| Map::Step {
            truth: truth.clone(),
            step,
            name: format!("{sample:06}_{step}.png").into(),
        }));
    }
    Ok(maps)
}

/// Whether a path is named like a PNG.
pub(super) fn is_png(path: &Path) -> bool {
    path.extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("png"))
}

/// The PNG files of a folder by name.
fn files(dir: &Path) -> Result<Vec<Map>, ExportError> {
    let mut paths = Vec::new();
    for entry in fs::read_dir(dir).map_err(InspectError::io(dir, 0))? {
        let path = entry.map_err(InspectError::io(dir, 0))?.path();
        if is_png(&path) {
            paths.push(path);
        }
    }
    paths.sort();
    Ok(paths.into_iter().map(Map::file).collect())
}

fn write(
    image: &DepthImage,
    path: &Path,
    format: DepthFormat,
    scale: Scale,
) -> Result<(), ExportError> {
    let (width, height, depth_m) = (image.width, image.height, &image.depth_m);
    let mut png = Vec::new();
    match format {
        DepthFormat::Png16 => {
            write_depth_png16(&mut png, width, height, depth_m).map_err(|source| {
                DepthPngError::File {
                    path: path.to_owned(),
                    source: Box::new(source),
                }
            })?
        }
        DepthFormat::Colour => {
            let mut canvas = Canvas::new(width, height, [0; 3])?;
            depth_to_rgb(depth_m, scale, canvas.rgb_mut()).map_err(DepthPngError::from)?;
            canvas.write_png(&mut png)?;
        }
    }
    let mut output = Output::create(path)?;
    output.put(&png);
    output.finish()
}

/// Depth that is drawn over its own file is gone.
fn refuse_same(from: &Path, to: &Path) -> Result<(), ExportError> {
    match (fs::canonicalize(from), fs::canonicalize(to)) {
        (Ok(a), Ok(b)) if a == b => Err(ExportError::Same {
            path: from.to_owned(),
        }),
        _ => Ok(()),
    }
}

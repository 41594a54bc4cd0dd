//! What a synthetic recording knows beyond its sensors: exposures, clocks, and per exposure the
//! depth, pictures, flow and masks of every step.

use std::fs;
use std::path::{Path, PathBuf};

use crate::flow::{read_flow, write_flow};
use crate::layout;
use crate::picture::{read_depth, read_mask, read_rgb8, write_depth, write_mask, write_rgb8};
use crate::table::OutFile;
use crate::writer::{create_dir, write_file};
use crate::{ExposureTruth, Picture, RecordingError, TruthClocks, WriteError};

/// Writes the truth of a recording, beside what a [`RecordingWriter`](crate::RecordingWriter)
/// writes.
#[derive(Debug)]
pub struct TruthWriter {
    dir: PathBuf,
    steps: u32,
    exposures: OutFile,
}

impl TruthWriter {
    /// Starts the truth of the recording in `dir`, with `steps` steps per exposure.
    ///
    /// # Errors
    /// When truth is there already or a file cannot be created.
    pub fn create(dir: &Path, steps: u32) -> Result<Self, WriteError> {
        for name in [layout::TRUTH, layout::DERIVED] {
            let path = dir.join(name);
            if path.exists() {
                return Err(WriteError::Exists { path });
            }
            create_dir(&path)?;
        }
        let path = dir.join(layout::TRUTH_EXPOSURES);
        Ok(Self {
            dir: dir.to_owned(),
            steps,
            exposures: OutFile::table(path, layout::EXPOSURE_COLUMNS)?,
        })
    }

    /// Writes how the clocks truly ran.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn clocks(&mut self, clocks: &TruthClocks) -> Result<(), WriteError> {
        let path = self.dir.join(layout::TRUTH_CLOCKS);
        let text =
            toml::to_string(clocks).map_err(|e| WriteError::io(&path, std::io::Error::other(e)))?;
        write_file(&path, text.as_bytes())
    }

    /// Appends one exposure.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn exposure(&mut self, truth: &ExposureTruth) -> Result<(), WriteError> {
        let sequence = truth
            .image_sequence
            .map_or(String::new(), |s| s.to_string());
        self.exposures.line(format_args!(
            "{},{},{},{},{},{sequence},{},{},{}",
            truth.index,
            truth.open_tai.as_nanos(),
            truth.close_tai.as_nanos(),
            truth.open_evk4.as_nanos(),
            truth.close_evk4.as_nanos(),
            u8::from(truth.image_dropped),
            truth.open_edge.name(),
            truth.close_edge.name(),
        ))
    }

    /// Starts the sample of exposure `index`. Samples are independent of one another: threads may
    /// write several at once.
    ///
    /// # Errors
    /// When its folders cannot be created.
    pub fn sample(&self, index: u32) -> Result<SampleWriter, WriteError> {
        let dir = layout::sample(&self.dir, index);
        for kind in Kind::PER_STEP {
            create_dir(&dir.join(kind.name()))?;
        }
        Ok(SampleWriter {
            dir,
            steps: self.steps,
        })
    }

    /// Writes out what is buffered.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn finish(mut self) -> Result<(), WriteError> {
        self.exposures.flush()
    }
}

/// What a sample holds per step; the names are its folders.
#[derive(Debug, Clone, Copy)]
enum Kind {
    Sparse,
    Gt,
    Sharp,
    Mover,
    Thin,
    Flow,
}

impl Kind {
    const PER_STEP: [Self; 6] = [
        Self::Sparse,
        Self::Gt,
        Self::Sharp,
        Self::Mover,
        Self::Thin,
        Self::Flow,
    ];

    const fn name(self) -> &'static str {
        match self {
            Self::Sparse => "sparse",
            Self::Gt => "gt",
            Self::Sharp => "sharp",
            Self::Mover => "mover",
            Self::Thin => "thin",
            Self::Flow => "flow",
        }
    }

    fn path(self, sample: &Path, step: u32) -> PathBuf {
        let extension = match self {
            Self::Flow => "npy",
            _ => "png",
        };
        sample.join(self.name()).join(format!("{step}.{extension}"))
    }
}

fn blur_path(sample: &Path) -> PathBuf {
    sample.join("blur.png")
}

/// Writes one sample, on the network's grid; steps count from 1.
#[derive(Debug)]
pub struct SampleWriter {
    dir: PathBuf,
    steps: u32,
}

impl SampleWriter {
    fn path(&self, kind: Kind, step: u32) -> Result<PathBuf, WriteError> {
        let steps = self.steps;
        if !(1..=steps).contains(&step) {
            return Err(WriteError::Step { step, steps });
        }
        Ok(kind.path(&self.dir, step))
    }

    /// The blurred image, packed RGB8 in the recording's encoding.
    ///
    /// # Errors
    /// When the length does not fit the size or the file cannot be written.
    pub fn blur(&self, width: usize, height: usize, rgb8: &[u8]) -> Result<(), WriteError> {
        write_rgb8(&blur_path(&self.dir), width, height, rgb8)
    }

    /// The sharp image at a step's centre, packed RGB8 in the recording's encoding.
    ///
    /// # Errors
    /// As for all of these: a step outside `1..=steps`, a length that does not fit the size, a file
    /// that cannot be written.
    pub fn sharp(
        &self,
        step: u32,
        width: usize,
        height: usize,
        rgb8: &[u8],
    ) -> Result<(), WriteError> {
        write_rgb8(&self.path(Kind::Sharp, step)?, width, height, rgb8)
    }

    /// The LiDAR's depth at a step's centre, metres, 0 where there is none.
    ///
    /// # Errors
    /// As [`sharp`](Self::sharp).
    pub fn sparse(
        &self,
        step: u32,
        width: usize,
        height: usize,
        depth_m: &[f32],
    ) -> Result<(), WriteError> {
        write_depth(&self.path(Kind::Sparse, step)?, width, height, depth_m)
    }

    /// The true depth at a step's centre, metres, 0 where there is none.
    ///
    /// # Errors
    /// As [`sharp`](Self::sharp).
    pub fn gt(
        &self,
        step: u32,
        width: usize,
        height: usize,
        depth_m: &[f32],
    ) -> Result<(), WriteError> {
        write_depth(&self.path(Kind::Gt, step)?, width, height, depth_m)
    }

    /// Pixels of objects that move on their own.
    ///
    /// # Errors
    /// As [`sharp`](Self::sharp).
    pub fn mover(
        &self,
        step: u32,
        width: usize,
        height: usize,
        mask: &[bool],
    ) -> Result<(), WriteError> {
        write_mask(&self.path(Kind::Mover, step)?, width, height, mask)
    }

    /// Pixels of objects under 0.3 m wide.
    ///
    /// # Errors
    /// As [`sharp`](Self::sharp).
    pub fn thin(
        &self,
        step: u32,
        width: usize,
        height: usize,
        mask: &[bool],
    ) -> Result<(), WriteError> {
        write_mask(&self.path(Kind::Thin, step)?, width, height, mask)
    }

    /// True flow from a step's centre to the next step's, pixels: all horizontal components (to
    /// the right), then all vertical (down).
    ///
    /// # Errors
    /// As [`sharp`](Self::sharp).
    pub fn flow(
        &self,
        step: u32,
        width: usize,
        height: usize,
        flow_px: &[f32],
    ) -> Result<(), WriteError> {
        write_flow(&self.path(Kind::Flow, step)?, width, height, flow_px)
    }
}

/// One sample's truth; every part is read when it is asked for, and an error names its file when
/// it is not there. Steps count from 1.
#[derive(Debug, Clone)]
pub struct SampleTruth {
    dir: PathBuf,
}

impl SampleTruth {
    pub(crate) fn open(recording: &Path, index: u32) -> Result<Self, RecordingError> {
        let path = layout::sample(recording, index);
        if !path.is_dir() {
            let what = "sample of this number";
            return Err(RecordingError::Absent { path, what });
        }
        Ok(Self { dir: path })
    }

    /// The sample's folder.
    #[must_use]
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// The blurred image, packed RGB8 in the recording's encoding.
    ///
    /// # Errors
    /// When the file is not there or not what belongs there.
    pub fn blur(&self) -> Result<Picture<u8>, RecordingError> {
        rgb8(&blur_path(&self.dir))
    }

    /// The sharp image at a step's centre, packed RGB8 in the recording's encoding.
    ///
    /// # Errors
    /// As [`blur`](Self::blur).
    pub fn sharp(&self, step: u32) -> Result<Picture<u8>, RecordingError> {
        rgb8(&Kind::Sharp.path(&self.dir, step))
    }

    /// The LiDAR's depth at a step's centre, metres, 0 where there is none.
    ///
    /// # Errors
    /// As [`blur`](Self::blur).
    pub fn sparse(&self, step: u32) -> Result<Picture<f32>, RecordingError> {
        read_depth(&Kind::Sparse.path(&self.dir, step))
    }

    /// The true depth at a step's centre, metres, 0 where there is none.
    ///
    /// # Errors
    /// As [`blur`](Self::blur).
    pub fn gt(&self, step: u32) -> Result<Picture<f32>, RecordingError> {
        read_depth(&Kind::Gt.path(&self.dir, step))
    }

    /// Pixels of objects that move on their own.
    ///
    /// # Errors
    /// As [`blur`](Self::blur).
    pub fn mover(&self, step: u32) -> Result<Picture<bool>, RecordingError> {
        read_mask(&Kind::Mover.path(&self.dir, step))
    }

    /// Pixels of objects under 0.3 m wide.
    ///
    /// # Errors
    /// As [`blur`](Self::blur).
    pub fn thin(&self, step: u32) -> Result<Picture<bool>, RecordingError> {
        read_mask(&Kind::Thin.path(&self.dir, step))
    }

    /// True flow to the next step, pixels, two values per pixel: all horizontal components (to the
    /// right), then all vertical (down).
    ///
    /// # Errors
    /// As [`blur`](Self::blur).
    pub fn flow(&self, step: u32) -> Result<Picture<f32>, RecordingError> {
        read_flow(&Kind::Flow.path(&self.dir, step))
    }
}

fn rgb8(path: &Path) -> Result<Picture<u8>, RecordingError> {
    let mut data = Vec::new();
    let (width, height) = read_rgb8(path, &mut data)?;
    Ok(Picture {
        width,
        height,
        data,
    })
}

/// Numbers of the samples there are, in order.
pub(crate) fn samples(recording: &Path) -> Result<Vec<u32>, RecordingError> {
    let dir = recording.join(layout::DERIVED);
    if !dir.is_dir() {
        return Ok(Vec::new());
    }
    let io = |e| RecordingError::io(&dir, e);
    let mut indices = Vec::new();
    for entry in fs::read_dir(&dir).map_err(io)? {
        let name = entry.map_err(io)?.file_name();
        let index = name
            .to_str()
            .filter(|n| n.bytes().all(|b| b.is_ascii_digit()));
        indices.extend(index.and_then(|n| n.parse::<u32>().ok()));
    }
    indices.sort_unstable();
    Ok(indices)
}

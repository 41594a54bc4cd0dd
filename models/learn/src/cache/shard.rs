//! Shards: a few examples in one safetensors file, each field read alone when it is wanted.

use std::collections::HashMap;
use std::fs::{self, File};
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use noctule_depth::Ground;
use noctule_raster::PackedEvent;
use noctule_world::STEPS;
use safetensors::Dtype;
use safetensors::tensor::{Metadata, TensorView};

use super::codec;
use super::error::CacheError;
use super::example::{Example, Origin, night_ground};

/// Longest header read, bytes; a shard's is a few kilobytes.
const HEADER_BYTES_MAX: u64 = 1 << 20;
/// Version of the fields and their codecs; stored in every shard and part of the cache's key.
pub(super) const FORMAT: &str = "2";

/// Writes a shard under a temporary name, then moves it to `path`.
pub(super) fn write(path: &Path, examples: &[Example]) -> Result<(), CacheError> {
    let mut fields: Vec<(String, Dtype, Vec<usize>, Vec<u8>)> = Vec::new();
    for example in examples {
        let mut field = |name: &str, dtype, shape: Vec<usize>, bytes: Vec<u8>| {
            fields.push((format!("{}.{name}", example.seed), dtype, shape, bytes));
        };
        let mut packed =
            |name: &str, bytes: Vec<u8>| field(name, Dtype::U8, vec![bytes.len()], bytes);
        packed("events", codec::pack_events(&example.events));
        packed("depth", codec::pack_depth(&example.depth));
        packed("sharp", codec::pack_smooth(&example.sharp));
        packed("movers", codec::pack_mask(&example.movers));
        packed("thin", codec::pack_mask(&example.thin));
        let side = example.size;
        field("blur", Dtype::U8, vec![3, side, side], example.blur.clone());
        let (cells, depths) = returns(&example.sparse);
        field("return_cell", Dtype::U32, vec![cells.len() / 4], cells);
        field("return_depth_m", Dtype::F32, vec![depths.len() / 4], depths);
        let width = example.exposure_us.to_le_bytes().to_vec();
        field("exposure_us", Dtype::U32, vec![1], width);
        if let (Origin::Kitti, Some(ground)) = (example.origin, &example.ground) {
            let bytes = ground
                .numbers()
                .iter()
                .flat_map(|n| n.to_le_bytes())
                .collect();
            field("ground", Dtype::F32, vec![3], bytes);
        }
    }
    let fault = |e: safetensors::SafeTensorError| CacheError::Shard {
        path: path.into(),
        fault: e.to_string(),
    };
    let views = fields
        .iter()
        .map(|(name, dtype, shape, bytes)| {
            Ok((
                name.as_str(),
                TensorView::new(*dtype, shape.clone(), bytes)?,
            ))
        })
        .collect::<Result<Vec<_>, _>>()
        .map_err(fault)?;
    let table = HashMap::from([("format".to_owned(), FORMAT.to_owned())]);
    let bytes = safetensors::serialize(views, Some(table)).map_err(fault)?;
    write_whole(path, &bytes).map_err(|source| CacheError::File {
        path: path.into(),
        source,
    })
}

/// Writes a file so that no reader ever sees half of it.
pub(crate) fn write_whole(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut partial = path.as_os_str().to_owned();
    partial.push(".partial");
    let out = File::create(&partial)?;
    io::Write::write_all(&mut &out, bytes)?;
    out.sync_all()?;
    fs::rename(&partial, path)
}

/// Cells with a return and their depths, both as little-endian bytes.
fn returns(sparse: &[f32]) -> (Vec<u8>, Vec<u8>) {
    let (mut cells, mut depths) = (Vec::new(), Vec::new());
    for (cell, depth) in (0u32..).zip(sparse).filter(|(_, depth)| **depth > 0.0) {
        cells.extend_from_slice(&cell.to_le_bytes());
        depths.extend_from_slice(&depth.to_le_bytes());
    }
    (cells, depths)
}

/// An open shard.
#[derive(Debug)]
pub(super) struct Shard {
    path: PathBuf,
    file: File,
    metadata: Metadata,
    data_start: u64,
    origin: Origin,
    size: usize,
}

impl Shard {
    /// Opens a shard and reads its table of contents.
    pub(super) fn open(path: &Path, origin: Origin, size: usize) -> Result<Self, CacheError> {
        let in_file = |source| CacheError::File {
            path: path.into(),
            source,
        };
        let file = File::open(path).map_err(in_file)?;
        let mut length = [0; 8];
        file.read_exact_at(&mut length, 0).map_err(in_file)?;
        let header = u64::from_le_bytes(length);
        let fault = |fault: String| CacheError::Shard {
            path: path.into(),
            fault,
        };
        if header > HEADER_BYTES_MAX {
            return Err(fault(format!(
                "header of {header} bytes, allowed {HEADER_BYTES_MAX}"
            )));
        }
        let mut head = vec![0; header as usize];
        file.read_exact_at(&mut head, 8).map_err(in_file)?;
        let metadata: Metadata = serde_json::from_slice(&head).map_err(|e| fault(e.to_string()))?;
        let bytes = file.metadata().map_err(in_file)?.len();
        let needed = 8 + header + metadata.data_len() as u64;
        if bytes != needed {
            return Err(fault(format!(
                "file has {bytes} bytes, its header says {needed}"
            )));
        }
        let format = metadata
            .metadata()
            .as_ref()
            .and_then(|table| table.get("format"));
        if format.map(String::as_str) != Some(FORMAT) {
            return Err(fault(format!("format is {format:?}, wanted {FORMAT:?}")));
        }
        Ok(Self {
            path: path.into(),
            file,
            metadata,
            data_start: 8 + header,
            origin,
            size,
        })
    }

    fn fault(&self, field: &str) -> CacheError {
        CacheError::Shard {
            path: self.path.clone(),
            fault: format!("{field} is missing or damaged"),
        }
    }

    fn bytes(&self, name: &str) -> Result<Vec<u8>, CacheError> {
        let info = self.metadata.info(name).ok_or_else(|| self.fault(name))?;
        let (start, end) = info.data_offsets;
        let mut bytes = vec![0; end.checked_sub(start).ok_or_else(|| self.fault(name))?];
        self.file
            .read_exact_at(&mut bytes, self.data_start + start as u64)
            .map_err(|source| CacheError::File {
                path: self.path.clone(),
                source,
            })?;
        Ok(bytes)
    }

    fn words(&self, name: &str) -> Result<Vec<u32>, CacheError> {
        let bytes = self.bytes(name)?;
        let (words, rest) = bytes.as_chunks::<4>();
        if !rest.is_empty() {
            return Err(self.fault(name));
        }
        Ok(words.iter().map(|word| u32::from_le_bytes(*word)).collect())
    }

    /// Reads one example, its sharp images only when asked for.
    pub(super) fn read(&self, seed: u64, with_sharp: bool) -> Result<Example, CacheError> {
        let name = |field: &str| format!("{seed}.{field}");
        let area = self.size * self.size;
        let field = |field: &str, unpack: fn(&[u8], usize) -> Option<Vec<bool>>, len| {
            unpack(&self.bytes(&name(field))?, len).ok_or_else(|| self.fault(field))
        };
        let events: Vec<PackedEvent> = codec::unpack_events(&self.bytes(&name("events"))?)
            .ok_or_else(|| self.fault("events"))?;
        let depth = codec::unpack_depth(&self.bytes(&name("depth"))?, STEPS * area)
            .ok_or_else(|| self.fault("depth"))?;
        let sharp = if with_sharp {
            codec::unpack_smooth(&self.bytes(&name("sharp"))?, STEPS * 3 * area)
                .ok_or_else(|| self.fault("sharp"))?
        } else {
            Vec::new()
        };
        let blur = self.bytes(&name("blur"))?;
        if blur.len() != 3 * area {
            return Err(self.fault("blur"));
        }
        let exposure_us = self.words(&name("exposure_us"))?;
        Ok(Example {
            seed,
            origin: self.origin,
            size: self.size,
            exposure_us: *exposure_us
                .first()
                .ok_or_else(|| self.fault("exposure_us"))?,
            ground: self.ground(&name("ground"))?,
            blur,
            events,
            sparse: self.sparse(&name("return_cell"), &name("return_depth_m"), STEPS * area)?,
            depth,
            sharp,
            movers: field("movers", codec::unpack_mask, STEPS * area)?,
            thin: field("thin", codec::unpack_mask, STEPS * area)?,
        })
    }

    /// Nights all have the same; real drives keep theirs.
    fn ground(&self, name: &str) -> Result<Option<Ground>, CacheError> {
        if self.origin != Origin::Kitti {
            return Ok(night_ground(self.size));
        }
        if self.metadata.info(name).is_none() {
            return Ok(None);
        }
        let numbers: Result<[u32; 3], _> = self.words(name)?.try_into();
        let numbers = numbers.map_err(|_| self.fault("ground"))?;
        Ok(Ground::from_numbers(numbers.map(f32::from_bits)))
    }

    fn sparse(&self, cells: &str, depths: &str, len: usize) -> Result<Vec<f32>, CacheError> {
        let (cells, depths) = (self.words(cells)?, self.words(depths)?);
        let mut sparse = vec![0.0; len];
        if cells.len() != depths.len() {
            return Err(self.fault("return_cell"));
        }
        for (cell, depth) in cells.iter().zip(depths) {
            let place = sparse.get_mut(*cell as usize);
            *place.ok_or_else(|| self.fault("return_cell"))? = f32::from_bits(depth);
        }
        Ok(sparse)
    }
}

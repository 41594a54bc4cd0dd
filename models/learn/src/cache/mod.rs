//! World samples rendered once and kept: seeded nights in shards on disk.
//!
//! A shard's path names everything its content depends on: a fingerprint of what the generator
//! draws, the format of the fields, the grid, the tier and the seeds. A generator that draws
//! otherwise finds an empty cache.

mod codec;
mod error;
mod example;
mod kitti;
mod shard;

use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use noctule_world::{Sample, Tier};
use rayon::prelude::*;
use sha2::{Digest, Sha256};

pub use error::CacheError;
pub use example::{Example, Origin, night_ground};
pub use kitti::{KittiClips, Part};
use shard::Shard;
pub(crate) use shard::write_whole;

/// Examples of one shard; the last of a range may hold fewer.
pub const SHARD_LEN: u64 = 16;
/// Side of the small samples that identify the generator.
const PROBE_SIZE: usize = 32;

/// Some drives of one tier.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Nights {
    /// How hard they are.
    pub tier: Tier,
    /// Their seeds.
    pub seeds: Range<u64>,
}

impl Nights {
    fn shards(&self) -> impl Iterator<Item = Self> + '_ {
        let starts = self.seeds.clone().step_by(SHARD_LEN as usize);
        starts.map(|start| Self {
            tier: self.tier,
            seeds: start..(start + SHARD_LEN).min(self.seeds.end),
        })
    }
}

/// Where examples of one grid are kept.
#[derive(Debug, Clone)]
pub struct Cache {
    root: PathBuf,
    folder: PathBuf,
    size: usize,
}

/// How far [`Cache::prepare`] is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Prepared {
    /// Examples that are on disk now.
    pub done: u64,
    /// Of them, rendered by this call.
    pub rendered: u64,
    /// Examples asked for.
    pub total: u64,
}

impl Cache {
    /// The cache under `root` for this generator and grids of `size` by `size` pixels.
    ///
    /// # Errors
    /// [`CacheError::Size`], when packed events cannot address the grid.
    pub fn new(root: &Path, size: usize) -> Result<Self, CacheError> {
        if size == 0 || size > 256 || !size.is_multiple_of(16) {
            return Err(CacheError::Size(size));
        }
        let folder = root.join(format!("{}-{}-{size}", generator(), shard::FORMAT));
        Ok(Self {
            root: root.into(),
            folder,
            size,
        })
    }

    /// The folder the shards lie in.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    fn path(&self, nights: &Nights) -> PathBuf {
        let Range { start, end } = nights.seeds;
        let letter = nights.tier.letter();
        self.folder
            .join(format!("{letter}-{start:06}-{end:06}.safetensors"))
    }

    /// Renders what is missing, a shard at a time, on the current rayon pool. Tiers take turns, so
    /// that a half-finished cache is a fair one. Stops between samples when `stop` is set.
    ///
    /// # Errors
    /// [`CacheError::Interrupted`] when stopped; finished shards stay and are not rendered again.
    pub fn prepare(
        &self,
        nights: &[Nights],
        stop: &AtomicBool,
        progress: &mut dyn FnMut(Prepared),
    ) -> Result<(), CacheError> {
        fs::create_dir_all(&self.folder).map_err(|source| CacheError::File {
            path: self.folder.clone(),
            source,
        })?;
        let mut queues: Vec<_> = nights
            .iter()
            .map(|n| n.shards().collect::<Vec<_>>())
            .collect();
        let longest = queues.iter().map(Vec::len).max().unwrap_or(0);
        queues.iter_mut().for_each(|queue| queue.reverse());
        let mut state = Prepared {
            done: 0,
            rendered: 0,
            total: nights
                .iter()
                .map(|n| n.seeds.end.saturating_sub(n.seeds.start))
                .sum(),
        };
        for _ in 0..longest {
            for shard in queues.iter_mut().filter_map(Vec::pop) {
                let path = self.path(&shard);
                let count = shard.seeds.end - shard.seeds.start;
                if !path.exists() {
                    shard::write(&path, &self.render(&shard, stop)?)?;
                    state.rendered += count;
                }
                state.done += count;
                progress(state);
            }
        }
        Ok(())
    }

    fn render(&self, nights: &Nights, stop: &AtomicBool) -> Result<Vec<Example>, CacheError> {
        let tier = nights.tier;
        let seeds: Vec<u64> = nights.seeds.clone().collect();
        seeds
            .into_par_iter()
            .map(|seed| {
                if stop.load(Ordering::Relaxed) {
                    return Err(CacheError::Interrupted);
                }
                Example::render(seed, tier, self.size).map_err(|source| CacheError::Raster {
                    seed,
                    tier: tier.letter(),
                    source,
                })
            })
            .collect()
    }

    /// Opens every shard of `nights` for reading.
    ///
    /// # Errors
    /// [`CacheError::File`] for a shard that is not there, [`CacheError::Shard`] for a damaged one.
    pub fn open(&self, nights: &[Nights]) -> Result<Examples, CacheError> {
        let mut examples = Examples::default();
        for shard in nights.iter().flat_map(Nights::shards) {
            let origin = Origin::Night(shard.tier);
            let held = Shard::open(&self.path(&shard), origin, self.size)?;
            examples.add(held, origin, shard.seeds);
        }
        Ok(examples)
    }
}

/// Examples on disk, in the order of the nights they were opened with.
#[derive(Debug, Default)]
pub struct Examples {
    places: Vec<(Origin, u64)>,
    /// Where each lies.
    shard_of: Vec<usize>,
    shards: Vec<Shard>,
    /// How many at the end are mixed in, and their share of what is trained on.
    mixed_in: (usize, f64),
}

impl Examples {
    fn add(&mut self, shard: Shard, origin: Origin, seeds: impl IntoIterator<Item = u64>) {
        let index = self.shards.len();
        self.shards.push(shard);
        for seed in seeds {
            self.places.push((origin, seed));
            self.shard_of.push(index);
        }
    }

    /// These, and others behind them that make up `share` of what is trained on, however many they
    /// are. Examples that are mixed already stay so no longer: one share is kept.
    #[must_use]
    pub fn mixed_with(mut self, others: Self, share: f64) -> Self {
        let before = self.shards.len();
        self.mixed_in = (others.len(), share);
        self.places.extend(others.places);
        let shards = others.shard_of.iter().map(|shard| before + shard);
        self.shard_of.extend(shards);
        self.shards.extend(others.shards);
        self
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.places.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.places.is_empty()
    }

    /// How many at the end are mixed in, and their share of what is trained on.
    pub(crate) fn mixed_in(&self) -> (usize, f64) {
        self.mixed_in
    }

    /// Origin and seed of each.
    pub fn places(&self) -> &[(Origin, u64)] {
        &self.places
    }

    /// Reads example `index`; its sharp images only when asked for.
    ///
    /// # Errors
    /// [`CacheError`], when the shard cannot be read or is damaged.
    ///
    /// # Panics
    /// When `index` is not below [`len`](Self::len).
    pub fn read(&self, index: usize, with_sharp: bool) -> Result<Example, CacheError> {
        let (_, seed) = self.places[index];
        self.shards[self.shard_of[index]].read(seed, with_sharp)
    }
}

/// Twelve hexadecimal digits that change when the generator draws anything otherwise: a hash of
/// small samples, one per tier.
pub fn generator() -> String {
    let mut hash = Sha256::new();
    for tier in Tier::ALL {
        let sample = Sample::render(1, tier, PROBE_SIZE);
        let floats = |values: &[f32], hash: &mut Sha256| {
            values.iter().for_each(|v| hash.update(v.to_le_bytes()));
        };
        hash.update(&sample.blur);
        hash.update(&sample.sharp);
        hash.update(&sample.movers);
        hash.update(&sample.thin);
        floats(&sample.depth, &mut hash);
        floats(&sample.sparse, &mut hash);
        hash.update(sample.opening.open_ns.to_le_bytes());
        hash.update(sample.opening.close_ns.to_le_bytes());
        for event in &sample.events {
            hash.update(event.t.as_micros().to_le_bytes());
            hash.update([event.x as u8, event.y as u8, u8::from(event.on)]);
        }
    }
    let digest = hash.finalize();
    digest[..6]
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect()
}

//! One number for everything a run produced: equal digests mean equal bytes.
//!
//! Every bundle and depth map is hashed by itself, stage stamps left out; the digest of the run
//! hashes those in the order of (sequence, step, model), so arrival order plays no part.

use std::collections::BTreeMap;

use serde::Serialize;
use sha2::{Digest, Sha256};

use crate::frame::{Block, BundleHeader, DepthHeader, ModelId};

type Hash = [u8; 32];

/// Which frame a hash belongs to; bundles come before the depth maps made from them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Key {
    sequence: u64,
    /// `None` for the bundle itself.
    depth: Option<(u32, u32)>,
}

/// One frame's hash, for comparing two runs frame by frame.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct FrameDigest {
    /// The bundle's sequence number.
    pub sequence: u64,
    /// Step, absent for the bundle itself.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub step: Option<u32>,
    /// Model, absent for the bundle itself.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub model: Option<&'static str>,
    /// SHA-256 of header without stage stamps, then payload.
    pub sha256: String,
}

/// Hashes of all frames of a run.
#[derive(Debug, Default)]
pub struct RunDigest {
    frames: BTreeMap<Key, Hash>,
}

impl RunDigest {
    /// Adds a bundle.
    pub fn bundle(&mut self, header: &BundleHeader, payload: &[Block]) {
        let key = Key {
            sequence: header.sequence,
            depth: None,
        };
        self.frames.insert(
            key,
            hash(bytemuck::bytes_of(&header.without_stages()), payload),
        );
    }

    /// Adds a depth map.
    pub fn depth(&mut self, header: &DepthHeader, payload: &[Block]) {
        let key = Key {
            sequence: header.sequence,
            depth: Some((header.step, header.model)),
        };
        self.frames.insert(
            key,
            hash(bytemuck::bytes_of(&header.without_stages()), payload),
        );
    }

    /// The digest of everything added, in hexadecimal.
    #[must_use]
    pub fn finish(&self) -> String {
        let mut all = Sha256::new();
        for (key, hash) in &self.frames {
            all.update(key.sequence.to_le_bytes());
            let (step, model) = key.depth.unwrap_or((u32::MAX, u32::MAX));
            all.update(step.to_le_bytes());
            all.update(model.to_le_bytes());
            all.update(hash);
        }
        hex(&all.finalize().into())
    }

    /// Every frame's own hash.
    #[must_use]
    pub fn frames(&self) -> Vec<FrameDigest> {
        let digest = |(key, hash): (&Key, &Hash)| FrameDigest {
            sequence: key.sequence,
            step: key.depth.map(|(step, _)| step),
            model: key
                .depth
                .map(|(_, id)| ModelId::from_u32(id).map_or("unknown", ModelId::name)),
            sha256: hex(hash),
        };
        self.frames.iter().map(digest).collect()
    }
}

fn hash(header: &[u8], payload: &[Block]) -> Hash {
    let mut hash = Sha256::new();
    hash.update(header);
    hash.update(bytemuck::cast_slice::<Block, u8>(payload));
    hash.finalize().into()
}

fn hex(hash: &Hash) -> String {
    hash.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::HostStages;

    fn depth(step: u32, value: f32) -> (DepthHeader, [Block; 1]) {
        let header = DepthHeader {
            sequence: 4,
            step,
            frame: u64::from(step),
            ..Default::default()
        };
        (header, [Block { lanes: [value; 16] }])
    }

    #[test]
    fn order_and_stamps_play_no_part_but_every_bit_does() {
        let (mut a, mut b, mut c) = (
            RunDigest::default(),
            RunDigest::default(),
            RunDigest::default(),
        );
        for step in [0, 1] {
            let (header, payload) = depth(step, 2.0);
            a.depth(&header, &payload);
        }
        for step in [1, 0] {
            let (mut header, payload) = depth(step, 2.0);
            header.host = HostStages {
                sent_ns: 99,
                ..Default::default()
            };
            header.frame += 10;
            b.depth(&header, &payload);
            let (header, payload) = depth(step, if step == 0 { 2.000_000_2 } else { 2.0 });
            c.depth(&header, &payload);
        }
        assert_eq!(a.finish(), b.finish());
        assert_ne!(a.finish(), c.finish());
        assert_eq!(a.frames()[0], b.frames()[0]);
    }

    #[test]
    fn a_missing_frame_changes_the_digest() {
        let mut run = RunDigest::default();
        let empty = run.finish();
        let (header, payload) = depth(0, 1.0);
        run.depth(&header, &payload);
        assert_ne!(run.finish(), empty);
        assert_eq!(run.frames()[0].step, Some(0));
    }
}

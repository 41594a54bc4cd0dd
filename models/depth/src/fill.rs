//! Surfaces through the returns (first cut: the nearest return's depth).

use crate::nearest::NearestField;
use crate::size::Size;

pub(crate) struct Filler {
    _size: Size,
}

impl Filler {
    pub(crate) fn new(size: Size) -> Self {
        Self { _size: size }
    }

    pub(crate) fn fill(&mut self, field: &NearestField, sparse: &[f32], depth: &mut [f32]) {
        for (depth, &source) in depth.iter_mut().zip(&field.source) {
            *depth = sparse[source as usize];
        }
    }
}

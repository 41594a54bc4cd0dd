//! Scores of many images, kept row by row, so that shards merge to exactly the unsharded mean.
//!
//! A running sum depends on who summed what first. Rows are kept under the image's index instead,
//! and summed in index order when asked.

use crate::metrics::Metrics;
use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use thiserror::Error;

/// What is measured on one image (or one step of a sequence).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Score {
    /// Errors over all pixels with truth.
    pub metrics: Metrics,
    /// Mean absolute error in the edge band, millimetres; `None` where there is no edge.
    pub edge_band_mae_mm: Option<f64>,
    /// Mean absolute error on objects that move on their own, millimetres.
    pub mover_mae_mm: Option<f64>,
    /// Mean absolute error on objects under 0.3 m wide, millimetres.
    pub thin_mae_mm: Option<f64>,
    /// Change along the flow beyond the truth's own, millimetres.
    pub temporal_excess_mm: Option<f64>,
}

impl From<Metrics> for Score {
    /// A score without the optional parts.
    fn from(metrics: Metrics) -> Self {
        Self {
            metrics,
            edge_band_mae_mm: None,
            mover_mae_mm: None,
            thin_mae_mm: None,
            temporal_excess_mm: None,
        }
    }
}

/// Two rows claimed the same image.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("image {index} is scored twice")]
pub struct ScoredTwice {
    /// The image's index.
    pub index: u64,
}

/// Scores by image index.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ScoreTable {
    rows: BTreeMap<u64, Score>,
}

impl ScoreTable {
    /// An empty table.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds one image; errs, and changes nothing, if its index is taken.
    pub fn insert(&mut self, index: u64, score: Score) -> Result<(), ScoredTwice> {
        match self.rows.entry(index) {
            Entry::Occupied(_) => Err(ScoredTwice { index }),
            Entry::Vacant(slot) => {
                slot.insert(score);
                Ok(())
            }
        }
    }

    /// Takes over the rows of another shard; errs, and changes nothing, if an index is in both.
    pub fn merge(&mut self, shard: Self) -> Result<(), ScoredTwice> {
        if let Some(&index) = shard
            .rows
            .keys()
            .find(|index| self.rows.contains_key(index))
        {
            return Err(ScoredTwice { index });
        }
        self.rows.extend(shard.rows);
        Ok(())
    }

    /// The rows in index order.
    pub fn rows(&self) -> impl ExactSizeIterator<Item = (u64, &Score)> {
        self.rows.iter().map(|(&index, score)| (index, score))
    }

    /// Mean over the images, each of equal weight; optional parts over the images that have them,
    /// `pixels` summed. `None` for an empty table.
    pub fn mean(&self) -> Option<Score> {
        let mean = |part: fn(&Score) -> Option<f64>| {
            let (mut sum, mut count) = (0.0, 0_u64);
            for value in self.rows.values().filter_map(part) {
                sum += value;
                count += 1;
            }
            (count > 0).then(|| sum / count as f64)
        };
        Some(Score {
            metrics: Metrics {
                rmse_mm: mean(|score| Some(score.metrics.rmse_mm))?,
                mae_mm: mean(|score| Some(score.metrics.mae_mm))?,
                irmse_per_km: mean(|score| Some(score.metrics.irmse_per_km))?,
                rel: mean(|score| Some(score.metrics.rel))?,
                delta1_pct: mean(|score| Some(score.metrics.delta1_pct))?,
                pixels: self.rows.values().map(|score| score.metrics.pixels).sum(),
            },
            edge_band_mae_mm: mean(|score| score.edge_band_mae_mm),
            mover_mae_mm: mean(|score| score.mover_mae_mm),
            thin_mae_mm: mean(|score| score.thin_mae_mm),
            temporal_excess_mm: mean(|score| score.temporal_excess_mm),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn score(rmse_mm: f64, mover_mae_mm: Option<f64>) -> Score {
        let metrics = Metrics {
            rmse_mm,
            mae_mm: rmse_mm / 3.0,
            irmse_per_km: 1.0 / (1.0 + rmse_mm),
            rel: 0.1,
            delta1_pct: 90.0,
            pixels: 10,
        };
        Score {
            mover_mae_mm,
            ..Score::from(metrics)
        }
    }

    #[test]
    fn images_weigh_the_same_and_absent_parts_do_not_count() {
        let mut table = ScoreTable::new();
        assert_eq!(table.mean(), None);
        table.insert(4, score(100.0, Some(7.0))).expect("free");
        table.insert(2, score(300.0, None)).expect("free");
        let mean = table.mean().expect("two rows");
        assert_eq!((mean.metrics.rmse_mm, mean.metrics.pixels), (200.0, 20));
        assert_eq!((mean.mover_mae_mm, mean.thin_mae_mm), (Some(7.0), None));
        assert_eq!(
            table.rows().map(|(index, _)| index).collect::<Vec<_>>(),
            [2, 4]
        );
    }

    #[test]
    fn an_image_cannot_be_scored_twice() {
        let mut table = ScoreTable::new();
        table.insert(1, score(1.0, None)).expect("free");
        let before = table.clone();
        assert_eq!(
            table.insert(1, score(2.0, None)),
            Err(ScoredTwice { index: 1 })
        );
        let mut shard = ScoreTable::new();
        shard.insert(0, score(3.0, None)).expect("free");
        shard.insert(1, score(4.0, None)).expect("free");
        assert_eq!(table.merge(shard), Err(ScoredTwice { index: 1 }));
        assert_eq!(table, before);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// Whatever the split and the order, the mean is the same to the last bit.
        #[test]
        fn shards_merge_to_the_unsharded_mean(
            rows in prop::collection::vec((0.0_f64..1e5, prop::option::of(0.0_f64..1e5), 0_usize..4), 1..60),
        ) {
            let mut whole = ScoreTable::new();
            let mut shards: Vec<ScoreTable> = vec![ScoreTable::new(); 4];
            for (index, &(rmse_mm, mover_mae_mm, shard)) in rows.iter().enumerate() {
                let score = score(rmse_mm, mover_mae_mm);
                whole.insert(index as u64, score).expect("free");
                shards[shard].insert(index as u64, score).expect("free");
            }
            let mut merged = ScoreTable::new();
            for shard in shards.into_iter().rev() {
                merged.merge(shard).expect("disjoint");
            }
            prop_assert_eq!(merged.mean(), whole.mean());
        }
    }
}

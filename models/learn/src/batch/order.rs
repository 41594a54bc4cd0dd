//! Which examples make up which batch: a pure function of the run's seed and the batch's number.

use crate::chance::Chance;

/// Salt of the shuffle, so that it shares no numbers with augmentation.
const SHUFFLE: u64 = 1;

/// The endless sequence of shuffled epochs that batches are cut from.
#[derive(Debug, Clone, Copy)]
pub(super) struct Order {
    /// Examples in an epoch, not 0.
    pub examples: usize,
    /// Examples in a batch.
    pub batch: usize,
    /// Distinguishes runs and stages.
    pub seed: [u64; 2],
}

impl Order {
    /// Indices of the examples of batch `number`; epochs follow one another without a gap.
    pub(super) fn of_batch(&self, number: u64) -> Vec<usize> {
        let length = self.examples as u64;
        let first = number * self.batch as u64;
        let mut shuffled: Option<(u64, Vec<usize>)> = None;
        (first..first + self.batch as u64)
            .map(|place| {
                let (epoch, within) = (place / length, (place % length) as usize);
                if shuffled.as_ref().is_none_or(|(held, _)| *held != epoch) {
                    let mut chance = Chance::of(&[SHUFFLE, self.seed[0], self.seed[1], epoch]);
                    shuffled = Some((epoch, chance.order(self.examples)));
                }
                shuffled.as_ref().map_or(0, |(_, order)| order[within])
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_epoch_shows_every_example_once_and_the_next_in_another_order() {
        let order = Order {
            examples: 10,
            batch: 4,
            seed: [7, 0],
        };
        let all: Vec<usize> = (0..5).flat_map(|n| order.of_batch(n)).collect();
        let (mut first, mut second) = (all[..10].to_vec(), all[10..].to_vec());
        assert_ne!(first, second);
        first.sort_unstable();
        second.sort_unstable();
        assert_eq!(first, (0..10).collect::<Vec<_>>());
        assert_eq!(first, second);
        let other = Order {
            seed: [8, 0],
            ..order
        };
        assert_ne!(order.of_batch(0), other.of_batch(0));
    }
}

//! Which examples make up which batch: a pure function of the run's seed and the batch's number.

use crate::chance::Chance;

/// Salt of the shuffle, so that it shares no numbers with augmentation.
const SHUFFLE: u64 = 1;

/// The endless sequence of shuffled epochs that batches are cut from, or two of them in turns.
#[derive(Debug, Clone, Copy)]
pub(super) struct Order {
    /// Examples in an epoch, not 0 in all.
    pub examples: usize,
    /// How many of them, at the end, are mixed in, and their share of all batches. These and the
    /// others have epochs of their own.
    pub mixed_in: (usize, f64),
    /// Examples in a batch.
    pub batch: usize,
    /// Distinguishes runs and stages.
    pub seed: [u64; 2],
}

impl Order {
    /// Indices of the examples of batch `number`; epochs follow one another without a gap.
    pub(super) fn of_batch(&self, number: u64) -> Vec<usize> {
        let first = number * self.batch as u64;
        let mut shuffled = [None, None];
        (first..first + self.batch as u64)
            .map(|place| self.index(place, &mut shuffled))
            .collect()
    }

    /// The example at a place of the whole sequence; `shuffled` keeps the epochs last looked at.
    fn index(&self, place: u64, shuffled: &mut [Option<(u64, Vec<usize>)>; 2]) -> usize {
        let (mixed, share) = self.mixed_in;
        let plain = self.examples - mixed;
        // Of the places before, the mixed-in ones: as many as the share makes full.
        let before = |place: u64| match (plain, mixed) {
            (_, 0) => 0,
            (0, _) => place,
            _ => (place as f64 * share).floor() as u64,
        };
        let is_mixed = before(place + 1) > before(place);
        let (pool, length, start, place) = match is_mixed {
            true => (1, mixed, plain, before(place)),
            false => (0, plain, 0, place - before(place)),
        };
        let (epoch, within) = (place / length as u64, (place % length as u64) as usize);
        let held = &mut shuffled[pool];
        if held.as_ref().is_none_or(|(held, _)| *held != epoch) {
            let [run, stage] = self.seed;
            let mut chance = match pool {
                0 => Chance::of(&[SHUFFLE, run, stage, epoch]),
                _ => Chance::of(&[SHUFFLE, run, stage, epoch, 1]),
            };
            *held = Some((epoch, chance.order(length)));
        }
        start + held.as_ref().map_or(0, |(_, order)| order[within])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_epoch_shows_every_example_once_and_the_next_in_another_order() {
        let order = Order {
            examples: 10,
            mixed_in: (0, 0.0),
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

    #[test]
    fn what_is_mixed_in_has_its_share_and_epochs_of_its_own() {
        let order = Order {
            examples: 10,
            mixed_in: (4, 0.4),
            batch: 5,
            seed: [7, 0],
        };
        let all: Vec<usize> = (0..12).flat_map(|n| order.of_batch(n)).collect();
        let (mut plain, mut mixed): (Vec<usize>, Vec<usize>) = all.iter().partition(|i| **i < 6);
        assert_eq!((plain.len(), mixed.len()), (36, 24));
        for epoch in plain.chunks_mut(6) {
            epoch.sort_unstable();
            assert_eq!(epoch, [0, 1, 2, 3, 4, 5]);
        }
        for epoch in mixed.chunks_mut(4) {
            epoch.sort_unstable();
            assert_eq!(epoch, [6, 7, 8, 9]);
        }
        // Two of every five, and any batch alone is what it is in the sequence.
        for number in [0, 3, 11] {
            let batch = order.of_batch(number);
            assert_eq!(batch.iter().filter(|i| **i >= 6).count(), 2);
            assert_eq!(batch, all[5 * number as usize..][..5]);
        }
        let alone = Order {
            mixed_in: (10, 1.0),
            ..order
        };
        let mut epoch = [alone.of_batch(0), alone.of_batch(1)].concat();
        epoch.sort_unstable();
        assert_eq!(epoch, (0..10).collect::<Vec<_>>());
    }
}

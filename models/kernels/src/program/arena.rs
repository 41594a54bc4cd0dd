//! Which part of one stretch of memory each buffer gets: buffers alive at different times share.

use std::ops::{Range, RangeInclusive};

/// A buffer to be placed.
#[derive(Debug, Clone)]
pub(crate) struct Demand {
    pub(crate) bytes: usize,
    /// First and last operation, in order, that need it.
    pub(crate) alive: RangeInclusive<usize>,
}

/// Places every buffer, the largest first, at the lowest address free throughout its life.
/// Returns the ranges, each starting on a cache line, and the size of the whole.
pub(crate) fn place(demands: &[Demand]) -> (Vec<Range<usize>>, usize) {
    let mut order: Vec<usize> = (0..demands.len()).collect();
    order.sort_by_key(|&i| std::cmp::Reverse(demands[i].bytes));
    let mut placed: Vec<(usize, Range<usize>)> = Vec::new();
    for index in order {
        let demand = &demands[index];
        let mut taken: Vec<&Range<usize>> = placed
            .iter()
            .filter(|(other, _)| overlap(&demands[*other].alive, &demand.alive))
            .map(|(_, range)| range)
            .collect();
        taken.sort_by_key(|range| range.start);
        let bytes = demand.bytes.next_multiple_of(64);
        let mut start = 0;
        for range in taken {
            if start + bytes <= range.start {
                break;
            }
            start = start.max(range.end);
        }
        placed.push((index, start..start + bytes));
    }
    let end = placed.iter().map(|(_, range)| range.end).max();
    placed.sort_by_key(|(index, _)| *index);
    let ranges = placed.into_iter().map(|(_, range)| range).collect();
    (ranges, end.unwrap_or(0))
}

fn overlap(a: &RangeInclusive<usize>, b: &RangeInclusive<usize>) -> bool {
    a.start() <= b.end() && b.start() <= a.end()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn buffers_of_different_times_share() {
        let demand = |bytes, alive| Demand { bytes, alive };
        let demands = [demand(100, 0..=1), demand(128, 1..=2), demand(64, 2..=3)];
        let (ranges, len) = place(&demands);
        assert_eq!(ranges, [128..256, 0..128, 128..192]);
        assert_eq!(len, 256);
    }

    proptest! {
        #[test]
        fn buffers_alive_together_never_overlap(
            sizes in prop::collection::vec((1usize..500, 0usize..20, 0usize..6), 0..30)
        ) {
            let demands: Vec<Demand> = sizes
                .iter()
                .map(|&(bytes, from, len)| Demand { bytes, alive: from..=from + len })
                .collect();
            let (ranges, len) = place(&demands);
            for (i, a) in demands.iter().enumerate() {
                prop_assert!(ranges[i].len() >= a.bytes && ranges[i].end <= len);
                prop_assert_eq!(ranges[i].start % 64, 0);
                for (j, b) in demands.iter().enumerate().skip(i + 1) {
                    let apart = ranges[i].end <= ranges[j].start || ranges[j].end <= ranges[i].start;
                    prop_assert!(apart || !overlap(&a.alive, &b.alive), "{i} {j}");
                }
            }
        }
    }
}

//! When each laser fires, relative to its block.

use super::Model;
use super::nominal;
use super::table::{self, Column, TableError};

/// Firing time of each laser after the start of its block, in whole nanoseconds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FireTimes {
    model: Model,
    blocks: bool,
    channel_ns: Vec<i32>,
}

impl FireTimes {
    /// Reads a vendor table: rows of channel (from 1, any order) and time in microseconds.
    ///
    /// # Errors
    /// The first thing wrong, with its line.
    pub fn from_csv(model: Model, text: &str) -> Result<Self, TableError> {
        const COLUMNS: [Column; 1] = [Column {
            what: "fire time in microseconds",
            min: -10_000.0,
            max: 10_000.0,
        }];
        let channel_ns = table::parse(text, model.channels(), &COLUMNS)?
            .into_iter()
            .map(|[micros]| nanos(micros))
            .collect();
        Ok(Self {
            model,
            blocks: true,
            channel_ns,
        })
    }

    /// The vendor's times for the model.
    ///
    /// QT128 and Pandar64 have none built in: their returns carry the packet's time, without a
    /// block or channel term, until a table is given.
    #[must_use]
    pub fn nominal(model: Model) -> Self {
        let channel_ns = match model {
            Model::Qt64 => nominal::QT64_FIRE_NS.to_vec(),
            Model::Xt32 => nominal::even_times(32, 368, 1_512, 32),
            Model::Xt16 => nominal::even_times(16, 368, 3_024, 16),
            Model::Xt32m => nominal::even_times(32, 368, 2_888, 16),
            Model::Pandar40p => nominal::PANDAR40P_FIRE_NS.to_vec(),
            Model::Qt128 | Model::Pandar64 => vec![0; model.channels()],
        };
        Self {
            model,
            blocks: !model.spec().packet_time_only,
            channel_ns,
        }
    }

    /// The model whose lasers these are.
    #[must_use]
    pub fn model(&self) -> Model {
        self.model
    }

    /// Time after the start of the block, nanoseconds, channel 0 first.
    #[must_use]
    pub fn channel_ns(&self) -> &[i32] {
        &self.channel_ns
    }

    /// Whether blocks have times of their own; otherwise all carry the packet's.
    #[must_use]
    pub fn has_blocks(&self) -> bool {
        self.blocks
    }
}

#[expect(
    clippy::cast_possible_truncation,
    reason = "bounded to 10,000 us by the table's column"
)]
fn nanos(micros: f64) -> i32 {
    (micros * 1000.0).round() as i32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_whole_nanoseconds_whatever_the_order_of_rows() {
        let mut text = String::from("Channel,fire time(us)\n");
        for (index, ns) in nominal::QT64_FIRE_NS.iter().enumerate().rev() {
            text += &format!("{},{}.{:03}\n", index + 1, ns / 1000, ns % 1000);
        }
        assert_eq!(
            FireTimes::from_csv(Model::Qt64, &text),
            Ok(FireTimes::nominal(Model::Qt64))
        );
    }

    #[test]
    fn formulas_give_the_manual_s_numbers() {
        let last = |model| FireTimes::nominal(model).channel_ns.last().copied();
        assert_eq!(last(Model::Xt32), Some(47_240));
        assert_eq!(last(Model::Xt16), Some(45_728));
        assert_eq!(last(Model::Xt32m), Some(43_688));
        assert_eq!(last(Model::Qt64), Some(136_450));
        assert_eq!(FireTimes::nominal(Model::Pandar40p).channel_ns[3], -3_620);
        assert!(!FireTimes::nominal(Model::Pandar64).has_blocks());
    }

    #[test]
    fn a_table_for_a_model_timed_by_packet_brings_its_block_times() {
        let text: String = (1..=64).map(|c| format!("{c},-{c}\n")).collect();
        let times = FireTimes::from_csv(Model::Pandar64, &text).unwrap();
        assert!(times.has_blocks());
        assert_eq!(times.channel_ns[63], -64_000);
    }
}

//! What was wrong with a stream, by kind, and the proof that nothing went missing.

/// Errors seen so far, by kind; all counts are of words unless said otherwise.
///
/// A word is counted under the first kind that applies, in the order of
/// [`before_first_time_high`](Self::before_first_time_high),
/// [`reserved_word`](Self::reserved_word), [`missing_y`](Self::missing_y),
/// [`missing_vect_base`](Self::missing_vect_base), [`out_of_bounds`](Self::out_of_bounds),
/// [`time_backwards`](Self::time_backwards).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ErrorCounts {
    /// *Events* outside the sensor, not delivered. One vector word can hold several, beside
    /// others that are inside and were delivered; [`WordTally::out_of_bounds`] counts words.
    pub out_of_bounds: u64,
    /// Words skipped because the time was not known: before the first `TIME_HIGH` of the stream,
    /// or before the first one after a gap.
    pub before_first_time_high: u64,
    /// Event words that came before any row address.
    pub missing_y: u64,
    /// Vector words that came before any base column.
    pub missing_vect_base: u64,
    /// Time words that step back without being a wrap; their value is taken as is, not clamped.
    pub time_backwards: u64,
    /// Words of a type that the sensor does not send (padding, IMU, undefined types).
    pub reserved_word: u64,
    /// *Bytes* at the end of the stream, or before a gap, that do not fill a word.
    pub trailing_bytes: u64,
}

impl ErrorCounts {
    /// Every count with the name it has in reports.
    #[must_use]
    pub const fn by_kind(&self) -> [(&'static str, u64); 7] {
        [
            ("out_of_bounds", self.out_of_bounds),
            ("before_first_time_high", self.before_first_time_high),
            ("missing_y", self.missing_y),
            ("missing_vect_base", self.missing_vect_base),
            ("time_backwards", self.time_backwards),
            ("reserved_word", self.reserved_word),
            ("trailing_bytes", self.trailing_bytes),
        ]
    }

    /// Whether nothing was wrong.
    #[must_use]
    pub fn is_clean(&self) -> bool {
        *self == Self::default()
    }
}

/// Where every word of a stream went.
///
/// Conservation, at any moment: `words` equals [`accounted`](Self::accounted), and the bytes
/// taken are `words` times the word size, plus the trailing bytes counted, plus the bytes of a
/// word still waiting for its rest.
///
/// A word counts as decoded when its type is known and its content was used, or is known to carry
/// nothing for us (`OTHERS`, `CONTINUED`): state words, event words whose every event was
/// delivered, triggers. Words that step back in time are counted as that error instead, though
/// their value is used.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct WordTally {
    /// Whole words taken.
    pub words: u64,
    /// Words decoded without fault.
    pub decoded: u64,
    /// Event words of which at least one event lay outside the sensor.
    pub out_of_bounds: u64,
}

impl WordTally {
    /// Words decoded plus words counted under exactly one kind of `errors`.
    #[must_use]
    pub const fn accounted(&self, errors: &ErrorCounts) -> u64 {
        self.decoded
            + self.out_of_bounds
            + errors.before_first_time_high
            + errors.missing_y
            + errors.missing_vect_base
            + errors.time_backwards
            + errors.reserved_word
    }
}

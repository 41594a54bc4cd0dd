//! When a clock is no longer the one that was fitted: causes, counts, and the run of suspects
//! that has to agree with itself before the old fit is given up.

/// What ended an epoch.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum EpochCause {
    /// The sensor's clock went back: it was restarted, reset or wrapped.
    Backwards,
    /// The offset between the clocks changed by more than noise, delay and skew allow.
    Step,
    /// Nothing was heard for longer than the old fit can vouch for.
    Silence,
    /// The caller gave the fit up.
    Reset,
}

/// What became of one reading.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Observation {
    /// It contributes to the fit.
    Used,
    /// It repeats or precedes one already used, as duplicated and overtaken packets do.
    Late,
    /// It contradicts the fit. Stamps near it must not be mapped until the next `Used` or
    /// `NewEpoch`.
    Suspect,
    /// It opened a new epoch: every earlier reading and map is void.
    NewEpoch(EpochCause),
}

/// Readings by what became of them, and epochs by what caused them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct FitCounts {
    /// Readings that contributed.
    pub used: u64,
    /// Readings that repeated or preceded one already used.
    pub late: u64,
    /// Readings that contradicted the fit.
    pub outliers: u64,
    /// Epochs opened because the sensor's clock went back.
    pub backwards: u32,
    /// Epochs opened because the offset jumped.
    pub steps: u32,
    /// Epochs opened after silence.
    pub silences: u32,
    /// Epochs opened on the caller's word.
    pub resets: u32,
}

impl FitCounts {
    pub(super) fn epoch(&mut self, cause: EpochCause) {
        match cause {
            EpochCause::Backwards => self.backwards += 1,
            EpochCause::Step => self.steps += 1,
            EpochCause::Silence => self.silences += 1,
            EpochCause::Reset => self.resets += 1,
        }
    }
}

/// How a suspect contradicts the fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Contradiction {
    /// Its sensor time lies before the last one.
    Backwards,
    /// It arrived before it was sent.
    Early,
    /// It arrived much too late.
    Late,
}

/// A run of consecutive suspects that contradict the fit in the same way and agree with one
/// another.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Suspects {
    first: Option<(u64, u64, Contradiction)>,
    pub run: u32,
    /// Sensor time covered by the run, nanoseconds.
    pub span_ns: i64,
}

impl Suspects {
    pub fn clear(&mut self) {
        *self = Self::default();
    }

    /// Adds a suspect; one that disagrees with the run's first by more than `tolerance_ns` starts
    /// a new run.
    pub fn push(&mut self, a: u64, b: u64, kind: Contradiction, tolerance_ns: i64) {
        if let Some((a0, b0, kind0)) = self.first {
            let da = i128::from(a) - i128::from(a0);
            let db = i128::from(b) - i128::from(b0);
            if kind == kind0 && da >= 0 && (db - da).abs() <= i128::from(tolerance_ns) {
                self.run += 1;
                self.span_ns = i64::try_from(da).unwrap_or(i64::MAX);
                return;
            }
        }
        *self = Self {
            first: Some((a, b, kind)),
            run: 1,
            span_ns: 0,
        };
    }
}

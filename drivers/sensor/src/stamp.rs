//! An instant that knows which clock read it.

use core::fmt;
use core::marker::PhantomData;
use core::time::Duration;

use crate::Clock;

/// An instant read off clock `C`, in nanoseconds since that clock's zero.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(transparent)]
pub struct Stamp<C: Clock> {
    nanos: u64,
    clock: PhantomData<C>,
}

impl<C: Clock> Stamp<C> {
    /// The clock's zero.
    pub const ZERO: Self = Self::from_nanos(0);
    /// Later than every instant a clock will read.
    pub const MAX: Self = Self::from_nanos(u64::MAX);

    /// The instant `nanos` nanoseconds after the clock's zero.
    #[inline]
    #[must_use]
    pub const fn from_nanos(nanos: u64) -> Self {
        Self {
            nanos,
            clock: PhantomData,
        }
    }

    /// The instant `micros` microseconds after the clock's zero; saturates after 584 years.
    #[inline]
    #[must_use]
    pub const fn from_micros(micros: u64) -> Self {
        Self::from_nanos(micros.saturating_mul(1000))
    }

    /// Nanoseconds since the clock's zero.
    #[inline]
    #[must_use]
    pub const fn as_nanos(self) -> u64 {
        self.nanos
    }

    /// Whole microseconds since the clock's zero.
    #[inline]
    #[must_use]
    pub const fn as_micros(self) -> u64 {
        self.nanos / 1000
    }

    /// Time from `earlier` to `self`; `None` if `earlier` is in fact later.
    #[must_use]
    pub fn since(self, earlier: Self) -> Option<Duration> {
        self.nanos
            .checked_sub(earlier.nanos)
            .map(Duration::from_nanos)
    }

    /// Signed nanoseconds from `other` to `self`, saturating at 292 years either way.
    #[inline]
    #[must_use]
    pub fn diff_nanos(self, other: Self) -> i64 {
        if self.nanos >= other.nanos {
            i64::try_from(self.nanos - other.nanos).unwrap_or(i64::MAX)
        } else {
            i64::try_from(other.nanos - self.nanos).map_or(i64::MIN, |n| -n)
        }
    }

    /// The instant `nanos` later (earlier when negative), saturating at both ends.
    #[inline]
    #[must_use]
    pub const fn offset_nanos(self, nanos: i64) -> Self {
        Self::from_nanos(self.nanos.saturating_add_signed(nanos))
    }

    /// The instant `duration` later, saturating.
    #[must_use]
    pub fn after(self, duration: Duration) -> Self {
        Self::from_nanos(
            self.nanos
                .saturating_add(u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)),
        )
    }
}

impl<C: Clock> Default for Stamp<C> {
    fn default() -> Self {
        Self::ZERO
    }
}

impl<C: Clock> fmt::Debug for Stamp<C> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{} {}.{:09} s",
            C::NAME,
            self.nanos / 1_000_000_000,
            self.nanos % 1_000_000_000
        )
    }
}

impl<C: Clock> fmt::Display for Stamp<C> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(self, f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Evk4;

    type T = Stamp<Evk4>;

    #[test]
    fn differences_keep_their_sign_and_saturate() {
        let (a, b) = (T::from_micros(5), T::from_micros(7));
        assert_eq!(b.diff_nanos(a), 2_000);
        assert_eq!(a.diff_nanos(b), -2_000);
        assert_eq!(a.since(b), None);
        assert_eq!(b.since(a), Some(Duration::from_micros(2)));
        assert_eq!(T::MAX.diff_nanos(T::ZERO), i64::MAX);
        assert_eq!(T::ZERO.diff_nanos(T::MAX), i64::MIN);
    }

    #[test]
    fn offsets_saturate_at_both_ends() {
        assert_eq!(T::ZERO.offset_nanos(-1), T::ZERO);
        assert_eq!(T::MAX.offset_nanos(1), T::MAX);
        assert_eq!(T::from_nanos(10).offset_nanos(-3), T::from_nanos(7));
        assert_eq!(T::from_micros(u64::MAX), T::MAX);
    }
}

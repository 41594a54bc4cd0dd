//! The only thing that crosses clock domains: a fitted affine map with its uncertainty.

use crate::{Clock, Stamp};

const PPB: i128 = 1_000_000_000;

/// A value with the 99 % bound on its error.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Uncertain<T> {
    /// The value.
    pub value: T,
    /// 99 % of errors are at most this, in nanoseconds.
    pub uncertainty_ns: u64,
}

/// Affine map from clock `A` to clock `B`, fitted over a window of paired readings.
///
/// Arithmetic is in integers throughout, so a map gives the same nanosecond on every machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ClockMap<A: Clock, B: Clock> {
    /// One pair of simultaneous readings; the map is exact here.
    pub anchor: (Stamp<A>, Stamp<B>),
    /// How much more `B` advances than `A`, in parts per billion of `A`'s advance; negative when
    /// `A` runs fast.
    pub rate_ppb: i64,
    /// 99 % bound on the map's error at the anchor, nanoseconds, net of constant delays that the
    /// readings cannot show.
    pub uncertainty_ns: u64,
    /// Growth of that bound with distance from the anchor, nanoseconds per second (= ppb).
    pub growth_ppb: u64,
    /// Counts the steps, resets and restarts seen so far; maps of different epochs never mix.
    pub epoch: u32,
}

impl<A: Clock, B: Clock> ClockMap<A, B> {
    /// A map that is exact: `a` and `b` are the same instant and both clocks run alike.
    #[must_use]
    pub const fn exact(a: Stamp<A>, b: Stamp<B>) -> Self {
        Self {
            anchor: (a, b),
            rate_ppb: 0,
            uncertainty_ns: 0,
            growth_ppb: 0,
            epoch: 0,
        }
    }

    /// The instant on `B` that corresponds to `a`, saturating at the ends of `B`.
    #[must_use]
    pub fn apply(&self, a: Stamp<A>) -> Stamp<B> {
        let dt = i128::from(a.as_nanos()) - i128::from(self.anchor.0.as_nanos());
        let dt = dt + div_round(dt * i128::from(self.rate_ppb), PPB);
        offset(self.anchor.1, dt)
    }

    /// As [`apply`](Self::apply), with the map's 99 % error bound at that instant.
    #[must_use]
    pub fn apply_uncertain(&self, a: Stamp<A>) -> Uncertain<Stamp<B>> {
        Uncertain {
            value: self.apply(a),
            uncertainty_ns: self.uncertainty_at(a),
        }
    }

    /// The 99 % bound on the map's error at `a`.
    #[must_use]
    pub fn uncertainty_at(&self, a: Stamp<A>) -> u64 {
        let distance = a.diff_nanos(self.anchor.0).unsigned_abs();
        let growth = u128::from(distance) * u128::from(self.growth_ppb) / PPB.unsigned_abs();
        self.uncertainty_ns
            .saturating_add(u64::try_from(growth).unwrap_or(u64::MAX))
    }

    /// The map the other way round, exact to a nanosecond near the anchor.
    #[must_use]
    pub fn inverse(&self) -> ClockMap<B, A> {
        let rate = i128::from(self.rate_ppb);
        let inverse = div_round(-rate * PPB, PPB + rate);
        ClockMap {
            anchor: (self.anchor.1, self.anchor.0),
            rate_ppb: i64::try_from(inverse).unwrap_or(0),
            uncertainty_ns: self.uncertainty_ns,
            growth_ppb: self.growth_ppb,
            epoch: self.epoch,
        }
    }

    /// This map followed by `next`; bounds add up, epochs too.
    #[must_use]
    pub fn then<C: Clock>(&self, next: &ClockMap<B, C>) -> ClockMap<A, C> {
        let (r, s) = (i128::from(self.rate_ppb), i128::from(next.rate_ppb));
        ClockMap {
            anchor: (self.anchor.0, next.apply(self.anchor.1)),
            rate_ppb: i64::try_from(r + s + div_round(r * s, PPB)).unwrap_or(0),
            uncertainty_ns: self
                .uncertainty_ns
                .saturating_add(next.uncertainty_at(self.anchor.1)),
            growth_ppb: self.growth_ppb.saturating_add(next.growth_ppb),
            epoch: self.epoch.wrapping_add(next.epoch),
        }
    }
}

/// Rounds half away from zero, so that a map and its mirror image agree.
fn div_round(n: i128, d: i128) -> i128 {
    let half = d / 2;
    if n >= 0 {
        (n + half) / d
    } else {
        (n - half) / d
    }
}

fn offset<C: Clock>(anchor: Stamp<C>, dt: i128) -> Stamp<C> {
    let t = i128::from(anchor.as_nanos()) + dt;
    Stamp::from_nanos(if t < 0 {
        0
    } else {
        u64::try_from(t).unwrap_or(u64::MAX)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Evk4, Realtime, Tai};

    fn fast_by_50_ppm() -> ClockMap<Evk4, Realtime> {
        ClockMap {
            anchor: (
                Stamp::from_nanos(1_000_000_000),
                Stamp::from_nanos(7_000_000_000),
            ),
            rate_ppb: -50_000,
            uncertainty_ns: 2_000,
            growth_ppb: 100,
            epoch: 3,
        }
    }

    #[test]
    fn skew_counts_away_from_the_anchor_in_both_directions() {
        let map = fast_by_50_ppm();
        assert_eq!(
            map.apply(Stamp::from_nanos(1_000_000_000)).as_nanos(),
            7_000_000_000
        );
        assert_eq!(
            map.apply(Stamp::from_nanos(2_000_000_000)).as_nanos(),
            7_999_950_000
        );
        assert_eq!(map.apply(Stamp::ZERO).as_nanos(), 6_000_050_000);
        assert_eq!(map.uncertainty_at(Stamp::from_nanos(11_000_000_000)), 3_000);
    }

    #[test]
    fn there_and_back_is_the_same_nanosecond() {
        let map = fast_by_50_ppm();
        for nanos in [0, 1, 999_999_999, 123_456_789_012, 86_400_000_000_000] {
            let back = map.inverse().apply(map.apply(Stamp::from_nanos(nanos)));
            let error = back.diff_nanos(Stamp::from_nanos(nanos)).unsigned_abs();
            // The inverse rate is rounded to 1 ppb: half a nanosecond per second from the anchor.
            assert!(error <= 1 + nanos / 1_000_000_000, "{error} ns at {nanos}");
        }
    }

    #[test]
    fn a_chain_adds_rates_and_bounds() {
        let tai: ClockMap<Realtime, Tai> = ClockMap {
            anchor: (Stamp::ZERO, Stamp::from_nanos(37_000_000_000)),
            rate_ppb: 0,
            uncertainty_ns: 10,
            growth_ppb: 0,
            epoch: 1,
        };
        let map = fast_by_50_ppm().then(&tai);
        assert_eq!(
            map.apply(Stamp::from_nanos(2_000_000_000)).as_nanos(),
            44_999_950_000
        );
        assert_eq!((map.uncertainty_ns, map.epoch), (2_010, 4));
    }
}

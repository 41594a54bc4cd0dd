//! Exposures where there is no strobe: one per LiDAR sweep, per image, or per configured period.

use noctule_sensor::{Evk4, Stamp};

use super::exposure::{Exposure, ExposureEvent, ExposureFlags};

/// Makes exposures up, each flagged `VIRTUAL`.
#[derive(Debug, Clone, Copy, Default)]
pub struct VirtualExposures {
    next_id: u64,
}

impl VirtualExposures {
    /// None made up yet.
    #[must_use]
    pub const fn new() -> Self {
        Self { next_id: 0 }
    }

    /// One exposure over `[open, close)`, as of a sweep or of an image's stamps, announced, closed
    /// and done with. Nothing when the interval is empty.
    pub fn interval(
        &mut self,
        open: Stamp<Evk4>,
        close: Stamp<Evk4>,
        image: Option<u64>,
        emit: &mut impl FnMut(ExposureEvent),
    ) {
        if close <= open {
            return;
        }
        let id = self.next_id;
        self.next_id += 1;
        let flags = ExposureFlags::VIRTUAL;
        emit(ExposureEvent::Opened {
            id,
            open,
            close_predicted: Some(close),
            flags,
        });
        self.end(
            Exposure {
                id,
                open,
                close,
                image,
                flags,
            },
            emit,
        );
    }

    fn end(&self, exposure: Exposure, emit: &mut impl FnMut(ExposureEvent)) {
        emit(ExposureEvent::Closed(Exposure {
            image: None,
            ..exposure
        }));
        emit(match exposure.image {
            Some(_) => ExposureEvent::Imaged {
                exposure,
                pair: None,
            },
            None => ExposureEvent::ImageMissing(Exposure {
                flags: exposure.flags | ExposureFlags::IMAGE_MISSING,
                ..exposure
            }),
        });
    }
}

/// Exposures at a fixed period of the event camera's counter.
#[derive(Debug, Clone, Copy)]
pub struct PeriodicExposures {
    exposures: VirtualExposures,
    period_ns: i64,
    width_ns: i64,
    /// The exposure announced and not closed, and when it opened.
    open: Option<(u64, Stamp<Evk4>)>,
    next_open: Option<Stamp<Evk4>>,
}

impl PeriodicExposures {
    /// One exposure of `width_ns` every `period_ns`; the width is cut to the period.
    ///
    /// `None` unless both are positive.
    #[must_use]
    pub fn new(period_ns: i64, width_ns: i64) -> Option<Self> {
        (period_ns > 0 && width_ns > 0).then(|| Self {
            exposures: VirtualExposures::new(),
            period_ns,
            width_ns: width_ns.min(period_ns),
            open: None,
            next_open: None,
        })
    }

    /// The stream has come as far as `watermark`; the first call sets the phase. A watermark that
    /// goes back, or ahead by more than a hundred periods, starts afresh.
    pub fn advance(&mut self, watermark: Stamp<Evk4>, emit: &mut impl FnMut(ExposureEvent)) {
        const PERIODS_MAX: i64 = 100;
        let next = *self.next_open.get_or_insert(watermark);
        let ahead = watermark.diff_nanos(next);
        let too_far = ahead > self.period_ns.saturating_mul(PERIODS_MAX);
        if too_far || ahead < -self.period_ns {
            self.close(emit);
            self.next_open = Some(watermark);
        }
        loop {
            if let Some((_, open)) = self.open {
                if watermark.diff_nanos(open) < self.width_ns {
                    return;
                }
                self.close(emit);
            }
            let Some(open) = self.next_open.filter(|&open| open <= watermark) else {
                return;
            };
            let id = self.exposures.next_id;
            self.exposures.next_id += 1;
            self.open = Some((id, open));
            let next = open.offset_nanos(self.period_ns);
            self.next_open = (next > open).then_some(next);
            emit(ExposureEvent::Opened {
                id,
                open,
                close_predicted: Some(open.offset_nanos(self.width_ns)),
                flags: ExposureFlags::VIRTUAL,
            });
        }
    }

    fn close(&mut self, emit: &mut impl FnMut(ExposureEvent)) {
        let Some((id, open)) = self.open.take() else {
            return;
        };
        let close = open.offset_nanos(self.width_ns);
        let flags = ExposureFlags::VIRTUAL;
        self.exposures.end(
            Exposure {
                id,
                open,
                close,
                image: None,
                flags,
            },
            emit,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn periods_follow_the_stream_and_every_exposure_ends() {
        let mut periodic = PeriodicExposures::new(10_000_000, 8_000_000).unwrap();
        let mut events = Vec::new();
        for us in (5_000..105_000).step_by(700) {
            periodic.advance(Stamp::from_micros(us), &mut |e| events.push(e));
        }
        let closed: Vec<Exposure> = events
            .iter()
            .filter_map(|e| {
                if let ExposureEvent::Closed(x) = e {
                    Some(*x)
                } else {
                    None
                }
            })
            .collect();
        assert_eq!(closed.len(), 10);
        for (i, exposure) in closed.iter().enumerate() {
            assert_eq!(exposure.open.as_micros(), 5_000 + 10_000 * i as u64);
            assert_eq!(exposure.width_ns(), 8_000_000);
            assert!(exposure.flags.contains(ExposureFlags::VIRTUAL));
        }
    }

    #[test]
    fn a_restart_closes_what_is_open_and_begins_again() {
        let mut periodic = PeriodicExposures::new(10_000_000, 10_000_000).unwrap();
        let mut events = Vec::new();
        for us in [50_000, 55_000, 100, 5_000, 10_200] {
            periodic.advance(Stamp::from_micros(us), &mut |e| events.push(e));
        }
        let opens: Vec<u64> = events
            .iter()
            .filter_map(|e| match e {
                ExposureEvent::Opened { open, .. } => Some(open.as_micros()),
                _ => None,
            })
            .collect();
        assert_eq!(opens, [50_000, 100, 10_100]);
        periodic.advance(Stamp::MAX, &mut |e| events.push(e));
        assert!(
            events.len() < 20,
            "a stamp from nowhere must not make up centuries"
        );
    }

    #[test]
    fn empty_intervals_and_periods_are_refused() {
        let mut events = 0;
        let t = Stamp::from_micros(5);
        VirtualExposures::new().interval(t, t, None, &mut |_| events += 1);
        assert_eq!(events, 0);
        assert!(PeriodicExposures::new(0, 1).is_none());
    }
}

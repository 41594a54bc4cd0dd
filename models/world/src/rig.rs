//! The rig of a drive: where its sensors sit, how their clocks run, and how late things arrive.

use noctule_recording::{Calibration, ClockTruth, EventLens, Lens, Rectangle, TruthClocks};
use noctule_sensor::{Clock, ClockMap, Evk4, Lidar, Monotonic, Realtime, Stamp, Tai};

use crate::chance::{Dice, Purpose};
use crate::optics::Optics;
use crate::shutter::{Shutter, Tier};

/// TAI at the start of every drive: 2026-01-15 20:00:37 TAI, 20:00:00 UTC.
pub const DRIVE_START_TAI: Stamp<Tai> = Stamp::from_nanos(1_768_507_237_000_000_000);
/// TAI - UTC, seconds.
pub const TAI_OFFSET_S: i32 = 37;
/// Largest skew a sensor's oscillator gets by default, parts per billion.
const SKEW_PPB_MAX: f64 = 50_000.0;
/// Columns and rows of the EVK4.
pub(crate) const SENSOR: (usize, usize) = (1280, 720);

/// How every clock of the rig truly runs against TAI.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RigClocks {
    /// The event camera's counter.
    pub evk4: ClockMap<Evk4, Tai>,
    /// The LiDAR's clock.
    pub lidar: ClockMap<Lidar, Tai>,
    /// The host's `CLOCK_MONOTONIC`.
    pub monotonic: ClockMap<Monotonic, Tai>,
    /// The host's `CLOCK_REALTIME`.
    pub realtime: ClockMap<Realtime, Tai>,
}

impl RigClocks {
    /// Random offsets, and skews within 50 ppm for the sensors. The host's clocks share one
    /// disciplined oscillator and run with TAI.
    #[must_use]
    pub fn of_seed(seed: u64) -> Self {
        let mut dice = Dice::new(seed, Purpose::Clocks);
        let mut skew = || dice.range(-SKEW_PPB_MAX, SKEW_PPB_MAX) as i64;
        let (evk4_ppb, lidar_ppb) = (skew(), skew());
        // The event camera was started shortly before the drive.
        let running_us = dice.range(0.5e6, 4e6) as u64;
        let utc_ns =
            DRIVE_START_TAI.as_nanos() - TAI_OFFSET_S.unsigned_abs() as u64 * 1_000_000_000;
        let lidar_error_ns = dice.range(-0.5e9, 0.5e9) as i64;
        let uptime_ns = dice.range(1e12, 9e12) as u64;
        Self {
            evk4: running(Stamp::from_micros(running_us), evk4_ppb),
            lidar: running(
                Stamp::from_nanos(utc_ns.saturating_add_signed(lidar_error_ns)),
                lidar_ppb,
            ),
            monotonic: running(Stamp::from_nanos(uptime_ns), 0),
            realtime: running(Stamp::from_nanos(utc_ns), 0),
        }
    }

    /// As the recording's truth file has them.
    #[must_use]
    pub fn to_truth(&self) -> TruthClocks {
        TruthClocks {
            evk4: truth(&self.evk4),
            lidar: truth(&self.lidar),
            monotonic: truth(&self.monotonic),
            realtime: truth(&self.realtime),
            phc: None,
        }
    }
}

/// A clock that reads `at_start` when the drive starts; TAI advances `rate_ppb` more than it.
fn running<C: Clock>(at_start: Stamp<C>, rate_ppb: i64) -> ClockMap<C, Tai> {
    ClockMap {
        rate_ppb,
        ..ClockMap::exact(at_start, DRIVE_START_TAI)
    }
}

fn truth<C: Clock>(map: &ClockMap<C, Tai>) -> ClockTruth {
    ClockTruth {
        clock_ns: map.anchor.0.as_nanos(),
        tai_ns: map.anchor.1.as_nanos(),
        rate_ppb: map.rate_ppb,
    }
}

/// What a stamp reads: `map`'s clock at a TAI instant.
pub(crate) fn reading<C: Clock>(map: &ClockMap<C, Tai>, tai: Stamp<Tai>) -> Stamp<C> {
    map.inverse().apply(tai)
}

/// Means of the exponential parts of the delays, nanoseconds; the fixed parts are the
/// calibration's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Jitter {
    /// USB transfers of the event camera.
    pub usb_ns: f64,
    /// LiDAR datagrams.
    pub udp_ns: f64,
    /// Arrival of camera frames.
    pub frame_ns: f64,
    /// The driver's stamp of camera frames, behind the instant it marks.
    pub frame_stamp_ns: f64,
    /// CAN frames.
    pub can_ns: f64,
}

impl Default for Jitter {
    fn default() -> Self {
        Self {
            usb_ns: 1_000_000.0,
            udp_ns: 30_000.0,
            frame_ns: 200_000.0,
            frame_stamp_ns: 20_000.0,
            can_ns: 50_000.0,
        }
    }
}

/// Everything about a rig that a recording depends on besides the world.
#[derive(Debug, Clone, PartialEq)]
pub struct Rig {
    /// Lenses, poses and fixed delays.
    pub calibration: Calibration,
    /// How the clocks truly run.
    pub clocks: RigClocks,
    /// How arrivals scatter.
    pub jitter: Jitter,
    /// The camera's exposures.
    pub shutter: Shutter,
    /// Time between USB transfers, microseconds on the event camera's counter.
    pub transfer_us: u64,
    /// Columns and rows of the camera and of the event camera's region of interest.
    pub size: usize,
    /// Columns and rows of the network's grid, on which truth is given.
    pub grid: usize,
}

impl Rig {
    /// The default rig with the clocks of `seed` and the exposures of `tier`.
    #[must_use]
    pub fn new(seed: u64, tier: Tier) -> Self {
        Self::with_size(seed, tier, 512)
    }

    /// The same rig with smaller images (a multiple of 32, at most 704): the field of view stays.
    ///
    /// # Panics
    /// When `size` is none of these.
    #[must_use]
    pub fn with_size(seed: u64, tier: Tier, size: usize) -> Self {
        assert!(
            size.is_multiple_of(32) && (32..=704).contains(&size),
            "image size is {size}"
        );
        let mut calibration = Calibration::default_rig();
        if calibration.camera.width as usize != size {
            let optics = Optics::new(size);
            calibration.camera = lens(&optics, (size, size));
            let roi = Rectangle {
                x: ((SENSOR.0 - size) / 2) as u32,
                y: ((SENSOR.1 - size) / 2) as u32,
                width: size as u32,
                height: size as u32,
            };
            calibration.events = EventLens {
                lens: lens(&optics, SENSOR),
                roi,
            };
        }
        Self {
            calibration,
            clocks: RigClocks::of_seed(seed),
            jitter: Jitter::default(),
            shutter: Shutter::new(seed, tier),
            transfer_us: 1000,
            size,
            grid: size / 2,
        }
    }
}

fn lens(optics: &Optics, (width, height): (usize, usize)) -> Lens {
    let focal = f64::from(optics.focal_px);
    Lens {
        width: width as u32,
        height: height as u32,
        fx: focal,
        fy: focal,
        cx: (width as f64 - 1.0) / 2.0,
        cy: (height as f64 - 1.0) / 2.0,
        distortion: noctule_recording::Distortion::default(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_calibration_is_the_camera_that_renders() {
        let rig = Rig::new(1, Tier::B);
        let (optics, lens) = (Optics::new(rig.size), rig.calibration.camera);
        assert!((lens.fx - f64::from(optics.focal_px)).abs() < 1e-4);
        assert!((lens.cx - f64::from(optics.centre_px)).abs() < 1e-9);
        let roi = rig.calibration.events.roi;
        assert_eq!((roi.x, roi.y, roi.width, roi.height), (384, 104, 512, 512));
        let small = Rig::with_size(1, Tier::B, 64).calibration;
        small.validate().expect("a smaller rig is a rig");
    }

    #[test]
    fn clocks_differ_and_stay_within_50_ppm() {
        for seed in 0..50 {
            let clocks = RigClocks::of_seed(seed);
            assert!(clocks.evk4.rate_ppb.abs() <= 50_000 && clocks.lidar.rate_ppb.abs() <= 50_000);
            let later = Stamp::from_nanos(DRIVE_START_TAI.as_nanos() + 10_000_000_000);
            let read = reading(&clocks.evk4, later);
            assert!(clocks.evk4.apply(read).diff_nanos(later).abs() <= 10);
            assert_eq!(
                reading(&clocks.realtime, later).as_nanos() % 1_000_000_000,
                0
            );
        }
    }
}
